"""Parallel tempering with any of the kernels.

Reading order: tempering, kernel, density.
"""
