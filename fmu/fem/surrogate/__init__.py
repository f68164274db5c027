"""Surrogates of slow models: Gaussian processes of what is paired, learnt from a few solves.

Reading order: coordinates, process, close_pairs, feasibility, surrogate_model.
"""
