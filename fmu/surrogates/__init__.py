"""From a slow model to a surrogate with a certificate, and to exact draws: which theta are solved, and how many.

Reading order: learning, selection, error_limits; second_stage, delayed_acceptance.
"""
