"""Recovery of K(θ) and M(θ) from matrices that another program exports at a few parameter values.

Reading order: from_exports, recovery, entries.
"""
