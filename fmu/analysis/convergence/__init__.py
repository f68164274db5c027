"""Whether a run has converged: R-hat, effective sample size, verdict and remedy.

Reading order: effective, candidates, diagnostics, remedies, diagnosis.
"""
