"""The shell elements of the wing box: exact in states of constant strain and curvature, and a beam as a whole."""

import numpy as np
import pytest
import scipy.sparse as sp
from numpy.testing import assert_allclose

from fmu.fem.modes.eigensolver import eigen
from fmu.fem.modes.modal import frequency_hz
from tests.validation.wing_box import (
    CHORD,
    HEIGHT,
    LENGTH,
    NU,
    RHO,
    SKIN,
    SPAR,
    E,
    element_stiffness,
    matrices,
    wing_box,
)

A, B, T = 0.3, 0.2, 0.01
CORNERS = np.array([(0.0, 0.0), (A, 0.0), (A, B), (0.0, B)]) - (0.5 * A, 0.5 * B)


def energy(displacement):
    """Return uᵀ K u of an element whose nodes move as a function of x and y says: u v w θx θy θz."""
    u = np.concatenate([displacement(x, y) for x, y in CORNERS])
    return u @ element_stiffness(A, B, T) @ u


@pytest.mark.parametrize(
    ("displacement", "exact"),
    [
        (lambda x, y: [x, -NU * y, 0, 0, 0, 0], T * A * B),
        (lambda x, y: [y, x, 0, 0, 0, 0], 2.0 * T * A * B / (1.0 + NU)),
        (lambda x, y: [x * y, -0.5 * (x * x + NU * y * y), 0, 0, 0, 0], T * B**3 / 12.0 * A),
        (lambda x, y: [0, 0, 0.5 * x * x, 0, -x, 0], T**3 / 12.0 / (1.0 - NU**2) * A * B),
        (lambda x, y: [0, 0, x * y, x, -y, 0], T**3 / 6.0 / (1.0 + NU) * A * B),
        (lambda x, y: [0, 0, 1.0 + x - y, -1, -1, 0], 0.0),
        (lambda x, y: [1.0 - y, x, 0, 0, 0, 0], 0.0),
    ],
    ids=[
        "tension",
        "shear",
        "bending in the plane",
        "bending",
        "twist",
        "rigid out of the plane",
        "rigid in the plane",
    ],
)
def test_states_of_constant_strain_are_exact(displacement, exact):
    assert_allclose(energy(displacement), exact, rtol=1e-10, atol=1e-16)


def test_the_box_bends_as_a_beam():
    nodes, groups = wing_box((48, 12, 4))
    stiffness, mass, free = matrices(nodes, groups)
    frequencies = frequency_hz(eigen(sp.csr_array(E * sum(stiffness.values())), mass, 3)[0])
    shape = nodes[np.unique(free // 6)]
    assert len(shape) == len(nodes) - np.sum(nodes[:, 0] == 0.0)
    inertia = 2.0 * (CHORD * SKIN * (0.5 * HEIGHT) ** 2 + SPAR * HEIGHT**3 / 12.0)
    per_length = mass.diagonal()[::6].sum() / LENGTH  # ribs too
    beam = 1.8751**2 / (2.0 * np.pi * LENGTH**2) * np.sqrt(E * inertia / per_length)
    assert per_length > RHO * 2.0 * (CHORD * SKIN + HEIGHT * SPAR)
    # a box of thin walls loses some stiffness to shear and shear lag
    assert 0.93 * beam < frequencies[0] < beam
