"""Build surrogates with certificates, and make exact draws with a surrogate by delayed acceptance.

Reading order: learning, selection, error_limits; second_stage, delayed_acceptance.
"""
