"""Surrogates of slow models: Gaussian processes of the paired modes, fitted to a few solves.

Reading order: coordinates, process, close_pairs, feasibility, surrogate_model.
"""
