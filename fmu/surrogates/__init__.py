"""Building surrogates with certificates, and delayed acceptance, which gives exact draws.

Reading order: learning, selection, error_limits; second_stage, delayed_acceptance.
"""
