"""Conditional densities of a hierarchical posterior: scores given the main parameters, and the reverse.

The main parameters are all parameters of theta but the scores.
"""
