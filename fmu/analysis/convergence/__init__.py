"""Convergence of a run: R-hat, effective sample size (ESS), the verdict, and remedies.

Reading order: effective, candidates, diagnostics, remedies, diagnosis.
"""
