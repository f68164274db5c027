"""Parallel tempering with any local sampler.

Reading order: tempering, kernel, density.
"""
