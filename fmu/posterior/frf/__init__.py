"""Updating with measured frequency response functions: error models, damping models and the likelihood."""
