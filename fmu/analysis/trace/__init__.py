"""Traces in the format of ArviZ: how they are made from a run, read, saved and identified.

Reading order: conversion, misfit, reading, provenance, modal_states, failure_ledger.
"""
