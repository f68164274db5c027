"""Traces in ArviZ format: convert a run, read and store a trace, and record its provenance.

Reading order: conversion, misfit, reading, provenance, modal_states, failure_ledger.
"""
