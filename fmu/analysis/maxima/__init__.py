"""Maxima of the posterior, their probabilities, and tests that reveal a maximum that a run missed.

The mass of a maximum is the integral of prior times likelihood around it. Divided by the total mass of all maxima,
it gives the posterior probability of the maximum, called its share. Reading order: results, search, mode_weights,
missed, starts.
"""
