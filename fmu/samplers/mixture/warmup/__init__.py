"""The warm-up of the mixture sampler: choice of steps, fits of the mixture, and search for missed maxima.

Reading order: `local_draws`, `unknown_maxima`, `rounds`; then `tuner`.
"""
