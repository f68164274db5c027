"""Modes of structures: assembly of K and M at theta, the eigenproblem, and the modes' derivatives.

Reading order: terms, separable, solver, eigensolver, block, modal, full_block, derivatives. changes describes
known changes to a structure, and static computes displacements, mass and centre of gravity.
"""
