"""What `fmu check` shows before sampling: model, modes at the start, gradient and prior prediction.

Reading order: initial_modes, pairing_doubts, gradient_check, prior_prediction, model_words, check.
"""
