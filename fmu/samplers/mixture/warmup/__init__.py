"""Warm-up of the mixture sampler: it fits the mixture, searches for missed maxima, and chooses the kind of steps.

Reading order: `local_draws`, `unknown_maxima`, `rounds`; then `tuner`.
"""
