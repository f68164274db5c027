"""Densities of a hierarchical posterior: the scores given the main parameters, and these without the scores.

The main parameters are all parameters of theta but the scores.
"""
