"""Two densities of a hierarchical posterior: scores given the main parameters, and the main parameters alone.

The main parameters are all parameters in theta except the scores (`fmu.posterior.joint`).
"""
