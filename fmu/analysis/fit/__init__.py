"""Whether the model fits the data: the checks, each with what it would have shown, and the verdict.

Reading order: checks, model_fit.
"""
