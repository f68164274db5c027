"""Surrogates for slow models: Gaussian processes for the paired modes, fitted to a few solves.

Reading order: coordinates, process, close_pairs, feasibility, surrogate_model.
"""
