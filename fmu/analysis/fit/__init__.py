"""Checks of whether the model fits the data: each check, the misfit that it would have revealed, and the verdict.

Reading order: check, checks, model_fit.
"""
