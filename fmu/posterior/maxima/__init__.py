"""Local maxima of a posterior.

Reading order: ascent, local_maxima.
"""
