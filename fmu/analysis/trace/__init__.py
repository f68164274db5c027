"""From a run's result to an ArviZ trace, with what is needed to understand it later.

Reading order: conversion, reading, provenance, modal_states, failure_ledger.
"""
