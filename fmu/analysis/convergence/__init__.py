"""Convergence of a run: R-hat, effective sample size, verdict and remedy.

Reading order: effective, candidates, diagnostics, remedies, diagnosis.
"""
