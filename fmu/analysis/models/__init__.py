"""Several models of the same data: which one the data prefer, and how a discrepancy changes what they say.

Reading order: comparison, scatter, variants.
"""
