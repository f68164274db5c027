"""Compare several models of the same data: which one the data prefer, and how a discrepancy changes the posterior.

Reading order: comparison, scatter, prediction.
"""
