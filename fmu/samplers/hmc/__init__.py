"""Hamiltonian Monte Carlo: trajectories, the metric, reflection at bounds.

Reading order: hmc, metric, reflection, gradient.
"""
