"""Several models of the same data: which of them the data prefer, and how a discrepancy changes the posterior.

Reading order: comparison, scatter, prediction.
"""
