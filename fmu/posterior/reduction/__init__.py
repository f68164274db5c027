"""The reduced model of a problem: its tolerance, where it must be accurate, and its training.

Reading order: tolerance, region, train_reduced.
"""
