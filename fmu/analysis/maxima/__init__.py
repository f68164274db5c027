"""The maxima of the posterior with their probability, and the runs that missed one.

Reading order: results, search, mode_weights, missed, starts.
"""
