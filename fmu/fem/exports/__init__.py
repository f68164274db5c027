"""K(θ) and M(θ) from the matrices that another program exports at a few values of the parameters.

Reading order: from_exports, recovery, entries.
"""
