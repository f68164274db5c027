"""From theta to K and M, to modes and to their derivatives.

Reading order: terms, separable, solver, eigensolver, block, modal, full_block, derivatives.
"""
