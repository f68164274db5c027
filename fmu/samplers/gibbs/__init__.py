"""Gibbs sampling of posteriors with populations over several tests.

Reading order: gibbs, main_parameters.
"""
