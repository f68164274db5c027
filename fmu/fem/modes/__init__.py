"""Modes of structures: assembly of K and M at theta, the eigenproblem, and derivatives of the modes.

Reading order: terms, separable, solver, eigensolver, block, modal, full_block, derivatives.
"""
