"""From theta to K and M, to modes and to their derivatives.

Reading order: terms, separable, eigensolver (with null_space), modal, derivatives, blocks.
"""
