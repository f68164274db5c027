"""Prior distributions of the parameters.

Reading order: base, one_sided, scipy_distributions.
"""
