"""Model discrepancy: errors that occur because the model is wrong, in addition to measurement errors.

Reading order: embedded, modes, latent, model_errors, likelihood (which uses curvature, draws and one_test),
given_errors.
"""
