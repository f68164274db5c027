"""Conditional densities of a hierarchical posterior: scores given main parameters, and main parameters alone.

The main parameters are all parameters in theta except the scores (`fmu.posterior.joint`).
"""
