"""How warm-up learns a mixture: which steps are made, what is fitted to them, and which maxima join.

Reading order: `local_draws`, `unknown_maxima`, `rounds`; then `tuner`.
"""
