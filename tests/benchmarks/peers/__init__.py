"""Samplers of fmu and of other libraries on the same posteriors, with all costs counted."""
