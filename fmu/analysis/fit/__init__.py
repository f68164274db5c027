"""Whether the model fits the data: the checks, each with the misfit that it would have noticed, and the verdict.

Reading order: check, checks, model_fit.
"""
