"""Convergence of a run: R-hat, effective sample size (ESS), the verdict, and remedies for a failed test.

Reading order: effective, candidates, diagnostics, remedies, diagnosis.
"""
