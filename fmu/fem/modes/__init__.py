"""Modes of structures: from theta to K and M, to the modes and to their derivatives.

Reading order: terms, separable, solver, eigensolver, block, modal, full_block, derivatives.
"""
