"""Constraints between degrees of freedom: equations read from other programs, and the matrix T in u = T q.

Reading order: equations, transformation, rigid; then the programs (nastran; calculix with calculix_keywords and
calculix_bodies; ansys).
"""
