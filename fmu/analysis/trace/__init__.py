"""Traces in ArviZ format: converting a run, reading, storing, and recording provenance.

Reading order: conversion, misfit, reading, provenance, modal_states, failure_ledger.
"""
