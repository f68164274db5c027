"""Which computed mode answers to a measured one.

Reading order: rules, prediction, paired_model; paired_black_box for a user's function, failed_solves for reasons.
"""
