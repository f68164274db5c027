"""Traces in the format of ArviZ: conversion from a run, reading, storage and provenance.

Reading order: conversion, misfit, reading, provenance, modal_states, failure_ledger.
"""
