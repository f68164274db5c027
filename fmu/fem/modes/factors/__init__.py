"""Factorisation of sparse symmetric matrices with LAPACK, SuperLU or PARDISO.

`fmu.fem.modes.solver` chooses one of them for each matrix.
"""
