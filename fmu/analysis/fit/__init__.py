"""Checks of whether the model fits the data: each check, the misfit that it could have revealed, and the verdict.

Reading order: check, checks, model_fit.
"""
