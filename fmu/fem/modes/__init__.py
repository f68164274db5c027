"""Modes of structures: assembly of K and M at theta, the eigenproblem, and the modes' derivatives.

Reading order: terms, separable, solver, eigensolver, block, modal, full_block, derivatives.
"""
