"""Constraints between degrees of freedom: linear equations from other programs, and the matrix T of u = T q.

Reading order: equations, transformation, rigid; then one file per program (nastran, calculix, ansys).
"""
