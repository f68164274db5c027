"""The warm-up of the mixture sampler: choice of the steps, fits of the mixture, and the search for missed maxima.

Reading order: `local_draws`, `unknown_maxima`, `rounds`; then `tuner`.
"""
