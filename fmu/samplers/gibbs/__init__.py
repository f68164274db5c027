"""Gibbs sampling for parameters whose values in the different tests are draws from a population.

Read the modules in this order: gibbs, main_parameters, errors_of_model.
"""
