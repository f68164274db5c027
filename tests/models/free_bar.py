"""A free bar of trilinear hexahedra, the first specimen of any laboratory: double modes, one E and one density."""

import numpy as np
import scipy.sparse as sp
from skfem import Basis, BilinearForm, ElementHex1, ElementVector, MeshHex
from skfem.helpers import dot
from skfem.models.elasticity import lame_parameters, linear_elasticity

from tests.models.written import Planted, dense_frequencies, write_problem

LENGTH, WIDTH, E, NU, RHO = 0.3, 0.05, 2.1e11, 0.3, 7850.0
TRUTH = {"E": 1.04, "rho": 0.97}
PRIOR = 'prior = { distribution = "normal", mean = 1.0, sd = 0.05 }'
SD = 2e-3
"""Relative standard deviation of a measured frequency."""


def matrices(n=(12, 5, 5)):
    """Return K, M and the degrees of freedom (node, direction) of the bar of n elements."""
    ends = (LENGTH, WIDTH, WIDTH)
    mesh = MeshHex.init_tensor(*(np.linspace(0.0, end, m + 1) for end, m in zip(ends, n, strict=True)))
    basis = Basis(mesh, ElementVector(ElementHex1()))
    K = E * linear_elasticity(*lame_parameters(1.0, NU)).assemble(basis)
    M = RHO * BilinearForm(lambda u, v, _: dot(u, v)).assemble(basis)
    dofs = [None] * K.shape[0]
    for row, direction in enumerate("xyz"):
        for node, i in enumerate(basis.nodal_dofs[row]):
            dofs[i] = (node, direction)
    return sp.csr_array(0.5 * (K + K.T)), sp.csr_array(0.5 * (M + M.T)), dofs


def write(folder, n=(12, 5, 5), prior="", top='pairing = "index"', n_modes=4):
    """Write the problem, whose lowest elastic modes are measured, and return it."""
    K, M, dofs = matrices(n)
    unit = dense_frequencies(K, M, n_modes)

    def frequencies(theta):
        return unit * np.sqrt(theta["E"] / theta["rho"])

    measured = frequencies(TRUTH)
    path = write_problem(
        folder,
        "free-bar",
        {"stiffness": [(K, {"E": 1})], "mass": [(M, {"rho": 1})]},
        dofs,
        TRUTH,
        {"E": (0.8, 1.2), "rho": (0.8, 1.2)},
        measured,
        SD * measured,
        model="free = true",
        top=top,
        prior=prior,
    )
    return Planted(path, TRUTH, frequencies)
