"""Checks of whether the model fits the data: each check, the misfit that it would have shown, and the verdict.

Reading order: check, checks, model_fit.
"""
