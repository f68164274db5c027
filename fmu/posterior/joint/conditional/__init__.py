"""Densities of a hierarchical posterior: scores given the main parameters, and main parameters without the scores.

The main parameters are all parameters of theta except the scores (`fmu.posterior.joint`).
"""
