"""Surrogates with certificates, and draws from the model's own posterior by delayed acceptance.

Reading order: learning, selection, error_limits; second_stage, delayed_acceptance.
"""
