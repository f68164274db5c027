"""The maxima of the posterior, their probabilities, and the runs that missed a maximum.

Reading order: results, search, mode_weights, missed, starts.
"""
