"""Reduce a problem's model: its tolerance, the region in which it must be accurate, and its training.

Reading order: tolerance, region, train_reduced.
"""
