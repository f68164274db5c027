"""Parallel tempering with any of the kernels.

Reading order: rungs, ladder, density, replicas, kernel, tempering.
"""
