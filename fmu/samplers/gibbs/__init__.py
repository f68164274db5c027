"""Gibbs sampling of posteriors with populations of parameters over several tests.

Reading order: gibbs, main_parameters.
"""
