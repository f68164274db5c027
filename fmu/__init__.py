"""Bayesian finite-element model updating."""
