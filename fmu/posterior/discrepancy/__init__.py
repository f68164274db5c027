"""Errors of a model that is wrong, beside the errors of the measurement.

Reading order: embedded, modes, latent, model_errors, likelihood; curvature, draws and frequencies serve the last.
"""
