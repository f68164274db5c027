"""What `fmu check` reports: the model, its modes at the starting point, the gradient, and the prior prediction.

Reading order: initial_modes, pairing_doubts, gradient_check, prior_prediction, model_words, check.
"""
