"""The parts of a check before sampling: the model, its modes at the start, the gradient, the prior prediction.

Reading order: initial_modes, pairing_doubts, gradient_check, prior_prediction, model_words, check.
"""
