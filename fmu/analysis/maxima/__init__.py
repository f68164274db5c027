"""Maxima of the posterior, their probabilities, and the runs that missed one.

A maximum's mass is the integral of the unnormalised posterior around it; its share is its fraction of the total
mass. Reading order: results, search, mode_weights, missed, starts.
"""
