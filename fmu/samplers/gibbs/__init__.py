"""Gibbs sampling for parameters that vary between tests as populations.

Reading order: gibbs, main_parameters, errors_of_model.
"""
