"""Checks of whether the model fits the data, the misfit that each check could have revealed, and the verdict.

Reading order: check, checks, model_fit.
"""
