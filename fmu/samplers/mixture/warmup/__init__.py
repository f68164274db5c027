"""Warm-up of the mixture sampler, which chooses steps, fits the mixture, and searches for missed maxima.

Reading order: `local_draws`, `unknown_maxima`, `rounds`; then `tuner`.
"""
