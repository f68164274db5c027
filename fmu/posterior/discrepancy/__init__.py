"""Model discrepancy: errors of a wrong model, in addition to measurement errors.

Reading order: embedded, modes, latent, model_errors, likelihood. The last uses curvature, draws and frequencies.
"""
