"""Parallel tempering with any of the kernels.

Reading order: rungs, ladder, density, replicas, tempering, ladder_tuner.
"""
