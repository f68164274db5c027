"""Frequencies of uniform beams against their closed forms, and the rates at which they converge."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import brentq

from fmu.fem.frame.components import DIRECTIONS, ElementGroup, Material, PointMass, Section
from fmu.fem.frame.frame import Frame
from fmu.fem.modes.eigensolver import eigen
from fmu.fem.modes.modal import frequency_hz

L, E, NU, RHO = 1.5, 2e11, 0.25, 8000.0
COMPACT = Section(A=4e-3, Iy=2e-6, Iz=5e-6, J=3e-6)


def straight(n_elements, section, supports, material=None, masses=()):
    """Return a model of a straight beam along x."""
    nodes = np.zeros((n_elements + 1, 3))
    nodes[:, 0] = np.linspace(0.0, L, n_elements + 1)
    elements = np.stack([np.arange(n_elements), np.arange(1, n_elements + 1)], axis=1)
    group = ElementGroup("beam", elements, section, material or Material(E, NU, RHO))
    return Frame(nodes, [group], supports, masses).separable()


def plane_frequencies(model, directions, count):
    """Return the lowest frequencies of motion in the given directions, which must not couple with others."""
    here = np.array([i for i, (_, d) in enumerate(model.dofs) if d in directions])
    rest = np.setdiff1d(np.arange(model.n_dof), here)
    K, M = model.K([]), model.M([])
    assert abs(K[here][:, rest]).max() == abs(M[here][:, rest]).max() == 0.0
    return frequency_hz(eigen(K[here][:, here], M[here][:, here], count)[0])


def without_rotary_inertia(EI):
    """Return section and material of a beam whose EI is given but whose rho·I is 1e-14 of rho·A·L²."""
    A, I = 1e-3, 1e-14 * 1e-3 * L**2  # noqa: E741
    return Section(A=A, Iy=I, Iz=I, J=I), Material(E=EI / I, nu=NU, rho=RHO)


def clamped_free_roots(count):
    def characteristic(x):
        return np.cos(x) + 1.0 / np.cosh(x)

    return np.array([brentq(characteristic, k * np.pi, (k + 1) * np.pi, xtol=1e-14) for k in range(count)])


@pytest.mark.parametrize("directions", [("z", "ry"), ("y", "rz")])
def test_euler_bernoulli_cantilever(directions):
    EI = 3e4
    section, material = without_rotary_inertia(EI)
    exact = (clamped_free_roots(5) / L) ** 2 * np.sqrt(EI / (RHO * section.A)) / (2 * np.pi)

    def error(n_elements):
        model = straight(n_elements, section, {0: DIRECTIONS}, material)
        return plane_frequencies(model, directions, 5) / exact - 1.0

    assert np.all(np.abs(error(50)) < 1e-5)
    coarse, fine = error(12)[1:], error(24)[1:]
    assert np.all(fine > 0.0)  # a Rayleigh–Ritz method comes from above
    assert_allclose(np.log2(coarse / fine), 4.0, atol=0.1)
    # Hermite elements with consistent mass: f_h/f = 1 + (kh)⁴/1440 to leading order.
    assert_allclose(fine, (clamped_free_roots(5)[1:] / 24) ** 4 / 1440, rtol=0.05)


@pytest.mark.parametrize(
    ("directions", "wave_speed"),
    [
        (("x",), np.sqrt(E / RHO)),
        (("rx",), np.sqrt(E / (2 * (1 + NU)) * COMPACT.J / (RHO * (COMPACT.Iy + COMPACT.Iz)))),
    ],
    ids=["bar", "torsion"],
)
def test_bar_and_torsion(directions, wave_speed):
    k = (2 * np.arange(1, 5) - 1) * np.pi / (2 * L)
    exact = k * wave_speed / (2 * np.pi)

    def error(n_elements):
        return plane_frequencies(straight(n_elements, COMPACT, {0: DIRECTIONS}), directions, 4) / exact - 1.0

    coarse, fine = error(20), error(40)
    assert_allclose(np.log2(coarse / fine), 2.0, atol=0.03)
    assert_allclose(fine, (k * L / 40) ** 2 / 24, rtol=0.02)


@pytest.mark.parametrize(("directions", "I"), [(("z", "ry"), COMPACT.Iy), (("y", "rz"), COMPACT.Iz)])
def test_rotary_inertia_of_a_simply_supported_rayleigh_beam(directions, I):  # noqa: E741
    """ω² = EI k⁴ / (ρA + ρI k²) with k = nπ/L: exact, the mode shapes being sines (Rayleigh 1894, §186)."""
    k = np.arange(1, 6) * np.pi / L
    euler = k**2 * np.sqrt(E * I / (RHO * COMPACT.A))
    exact = euler / np.sqrt(1.0 + I / COMPACT.A * k**2) / (2 * np.pi)
    model = straight(60, COMPACT, {0: ("x", "y", "z", "rx"), 60: ("y", "z")})
    computed = plane_frequencies(model, directions, 5)
    assert_allclose(computed, exact, rtol=5e-6)
    assert np.all(euler / (2 * np.pi) / exact - 1.0 > 100 * np.abs(computed / exact - 1.0))


def test_cantilever_with_a_heavy_tip():
    """A tip mass μ = m/(ρAL) puts the characteristic equation 1 + 1/(c·ch) = μ x (tan − tanh) to zero."""
    EI, mu = 3e4, 0.7
    section, material = without_rotary_inertia(EI)

    def characteristic(x):
        return 1 + np.cos(x) * np.cosh(x) - mu * x * (np.sin(x) * np.cosh(x) - np.cos(x) * np.sinh(x))

    roots = np.array([brentq(characteristic, a, b, xtol=1e-14) for a, b in ((0.5, 2.0), (3.0, 4.5), (6.5, 7.5))])
    exact = (roots / L) ** 2 * np.sqrt(EI / (RHO * section.A)) / (2 * np.pi)
    tip = PointMass(30, mu * RHO * section.A * L)
    model = straight(30, section, {0: DIRECTIONS}, material, [tip])
    for directions in (("z", "ry"), ("y", "rz")):
        assert_allclose(plane_frequencies(model, directions, 3), exact, rtol=1e-5)


def test_rotary_inertia_of_a_point_mass():
    """A flywheel on a shaft: ω² = GJ/(L·inertia), a third of the shaft's own small inertia turning with it."""
    shaft = RHO * (COMPACT.Iy + COMPACT.Iz) * L
    wheel = PointMass(4, 0.0, (1e4 * shaft, 0.0, 0.0))
    exact = np.sqrt(E / (2 * (1 + NU)) * COMPACT.J / (L * (1e4 + 1 / 3) * shaft)) / (2 * np.pi)
    computed = plane_frequencies(straight(4, COMPACT, {0: DIRECTIONS}, masses=[wheel]), ("rx",), 1)
    assert computed[0] == pytest.approx(exact, rel=1e-7)


def test_free_free_beam():
    """Six rigid-body modes, then the closed form's first bending mode 4.7300 (no rotary inertia)."""
    section, material = without_rotary_inertia(3e4)
    model = straight(20, section, {}, material)
    here = np.array([i for i, (_, d) in enumerate(model.dofs) if d in ("z", "ry")])
    lam, _ = eigen(model.K([])[here][:, here], model.M([])[here][:, here], 42)
    assert np.all(np.abs(lam[:2]) < 1e-10 * lam[-1])
    root = brentq(lambda x: np.cos(x) - 1 / np.cosh(x), 4, 5, xtol=1e-14)
    exact = (root / L) ** 2 * np.sqrt(3e4 / (RHO * section.A)) / (2 * np.pi)
    assert frequency_hz(lam[2:3])[0] == pytest.approx(exact, rel=1e-5)
