"""Constraints between degrees of freedom: equations read from other programs, and the matrix T in u = T q.

Reading order: equations, transformation, rigid; then one file per program (nastran, calculix, ansys).
"""
