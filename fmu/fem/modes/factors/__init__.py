"""Factors of sparse symmetric matrices by LAPACK, SuperLU and PARDISO; `fmu.fem.modes.solver` chooses."""
