"""From theta to K and M, to modes and to their derivatives.

Reading order: separable, solver, eigensolver, modal, full_block, derivatives.
"""
