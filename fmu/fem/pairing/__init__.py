"""Which computed mode answers a measured one.

Reading order: rules, candidates, prediction, paired_model; paired_black_box for a user's function.
"""
