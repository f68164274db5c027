"""Errors of a wrong model, in addition to the errors of the measurement.

Reading order: embedded, modes, latent, model_errors, likelihood; curvature, draws and frequencies serve the last.
"""
