"""From theta to K and M, to modes and to their derivatives.

Reading order: separable, eigensolver, modal, full_block, derivatives.
"""
