"""The maxima of the posterior with their probabilities, and the runs that missed one.

Reading order: results, search, mode_weights, missed, starts.
"""
