"""The paper's beam: its spectrum, the modes of its posterior, and the registry of cases."""

import numpy as np
import pytest
import scipy.linalg as sl
from scipy.special import erf

from fmu import cases
from fmu.fem.frame.components import Section
from tests import cantilever

PLANES = {"W": ("z", "ry"), "S": ("y", "rz"), "T": ("rx",), "A": ("x",)}


def named_modes(E, count):
    """Return name (plane of motion and number in it) and frequency of the lowest modes, from dense matrices."""
    model = cantilever.beam(1, E).separable()
    lam, phi = sl.eigh(model.K([]).toarray(), model.M([]).toarray(), subset_by_index=[0, count - 1])
    directions = np.array([direction for _, direction in model.dofs])
    kinetic = phi * (model.M([]) @ phi)
    modes, seen = {}, dict.fromkeys(PLANES, 0)
    for i in range(count):
        share = {p: kinetic[np.isin(directions, ds), i].sum() for p, ds in PLANES.items()}
        plane = max(share, key=share.get)
        assert share[plane] > 1 - 1e-9
        seen[plane] += 1
        modes[f"{plane}{seen[plane]}"] = np.sqrt(lam[i]) / (2 * np.pi)
    return modes


def test_order_of_the_spectrum():
    assert " ".join(named_modes(2.1e11, 9)) == "W1 S1 W2 T1 W3 W4 S2 T2 W5"


def test_mode_seven_is_the_second_strong_bending_mode_not_the_fourth_weak_one():
    modes = named_modes(2.4e11, 9)
    assert modes["W4"] == pytest.approx(1177.8, abs=0.05)
    assert modes["S2"] == pytest.approx(1237.16, abs=0.005)
    assert list(modes)[6] == "S2"


def test_pairing_by_shape_follows_the_weak_plane():
    modes = named_modes(2.4e11, 9)
    by_shape = cases.load("cantilever-young").frequencies(np.full(5, 2.4e11))
    np.testing.assert_allclose(by_shape, [modes[f"W{k}"] for k in range(1, 6)], rtol=1e-6)
    by_number = cases.load("cantilever-young", "index").frequencies(np.full(5, 2.4e11))
    np.testing.assert_allclose(by_number, [modes[m] for m in ("W1", "W2", "W3", "S2", "W5")], rtol=1e-6)


def test_section_of_the_beam():
    section = Section.rectangle(width=0.06, height=0.01)
    J = 0.06 * 0.01**3 / 3 * (1 - 0.63 / 6 + 0.052 / 6**5)
    constants = (section.A, section.Iy, section.Iz, section.J)
    assert constants == pytest.approx((6e-4, 5e-9, 1.8e-7, J), rel=1e-14, abs=0)


def test_sensors_add_their_mass_once_to_every_translation():
    model = cantilever.beam(1).separable()
    element_mass = 7850 * 6e-4 * 0.01
    rotary = {"x": 0.0, "y": 1.8e-7, "z": 5e-9}
    for direction in ("x", "y", "z"):
        rigid = np.array([float(d == direction) for _, d in model.dofs])
        # Of the element at the clamp only the free node's entry of the consistent mass matrix takes part.
        share = 1 / 3 if direction == "x" else 156 / 420
        expected = element_mass * (49 + share) + 7850 * rotary[direction] * 36 / (30 * 0.01) + 0.12
        assert rigid @ (model.M([]) @ rigid) == pytest.approx(expected, rel=1e-12)


# Local maxima of the log-posterior by number, without normalisers: I in 1e-9 m⁴, A in 1e-4 m².
MODES = {
    "A": ((3.904, 7.500, 9.000, 5.145), -94.6, "W1 S1 W3 S2 W5"),
    "B": ((6.873, 7.166, 9.000, 9.000), -162.1, "W1 W2 W3 W4 W5"),
    "C": ((5.534, 5.425, 6.913, 7.073), -168.8, "W1 W2 W3 S2 W5"),
}
UNITS = np.array([1e-9, 1e-9, 1e-4, 1e-4])


@pytest.fixture(scope="module")
def section_by_number():
    return cases.load("cantilever-section", "index")


def log_prob_without_normalisers(problem, theta):
    """Add back the normalisers of eq. (5) and (7) and of the bounds, worked out here from scratch."""
    sd = np.array([5e-9, 5e-9, 5e-4, 5e-4])
    a, b = problem.lower / sd / np.sqrt(2), problem.upper / sd / np.sqrt(2)
    mass = (erf(b) - erf(a)) / 2
    normaliser = 2.5 * np.log(np.pi) + np.sum(np.log(sd * np.sqrt(2 * np.pi) * mass))
    return problem.log_prob(theta) + normaliser


@pytest.mark.parametrize("mode", MODES)
def test_maxima_of_the_posterior_by_number(section_by_number, mode):
    point, height, _ = MODES[mode]
    problem = section_by_number
    peak = np.clip(np.array(point) * UNITS, problem.lower, problem.upper)
    top = log_prob_without_normalisers(problem, peak)
    assert top == pytest.approx(height, abs=0.05)
    rng = np.random.default_rng(1)
    for radius, gain in ((0.0005, 0.01), (0.02, 0.002)):
        around = peak + UNITS * radius * rng.uniform(-1, 1, size=(60, 4))
        around = np.clip(around, problem.lower, problem.upper)
        near = log_prob_without_normalisers(problem, around)
        assert np.all(near < top + gain)


@pytest.mark.parametrize("mode", MODES)
def test_physical_modes_behind_the_numbers(section_by_number, mode):
    point, _, names = MODES[mode]
    theta = np.array(point) * UNITS
    frame = cantilever.beam(2)
    updates = {"I1": [("Iy", "1")], "I2": [("Iy", "2")], "A1": [("A", "1")], "A2": [("A", "2")]}
    model = frame.separable(updates)
    directions = np.array([direction for _, direction in model.dofs])
    K, M = model.K(theta).toarray(), model.M(theta).toarray()
    expected = []
    for name in names.split():
        here = np.flatnonzero(np.isin(directions, PLANES[name[0]]))
        number = int(name[1:])
        lam = sl.eigh(K[np.ix_(here, here)], M[np.ix_(here, here)], eigvals_only=True)
        expected.append(np.sqrt(lam[number - 1]) / (2 * np.pi))
    np.testing.assert_allclose(section_by_number.frequencies(theta), expected, rtol=1e-6)


def test_registry_of_cases():
    assert {"cantilever-section", "cantilever-young", "shear-10dof", "shear-2dof"} <= set(cases.names())
    assert "5.1" in cases.describe("cantilever-young")
    assert "5.2" in cases.describe("cantilever-section")
    assert cases.load("cantilever-young").name == "cantilever-young, by shape"
    assert cases.load("cantilever-section", "index").name == "cantilever-section, by index"


@pytest.mark.parametrize("call", [cases.load, cases.describe])
def test_unknown_case(call):
    with pytest.raises(
        ValueError,
        match=r"^case: must be one of cantilever-frf, cantilever-section, .*shear-2dof, .* \(got 'bridge'\)$",
    ):
        call("bridge")


def test_weights_of_the_modes():
    """A weight β_i multiplies ε_i² and belongs into the normaliser (β_i/π)^½, eq. (4) and (5)."""
    theta, beta = np.full(5, 2.4e11), np.array([1.0, 2.0, 3.0, 4.0, 5.0])
    one, weighted = cases.load("cantilever-young"), cases.load("cantilever-young", beta=beta)
    error = one.frequencies(theta) - np.array(cantilever.MEASURED_HZ)
    expected = -np.sum((beta - 1.0) * error**2) + 0.5 * np.sum(np.log(beta))
    assert weighted.log_likelihood(theta) - one.log_likelihood(theta) == pytest.approx(expected, rel=1e-4)
    with pytest.raises(ValueError, match="beta"):
        cases.load("cantilever-section", beta=-1.0)


def test_unknown_pairing():
    with pytest.raises(ValueError, match=r"pairing: must be one of \('shape', 'index', 'soft'\) \(got 'name'\)$"):
        cases.load("cantilever-young", "name")


def test_settings_of_the_paper():
    young, section = (cases.load(f"cantilever-{name}") for name in ("young", "section"))
    assert young.names == ("E1", "E2", "E3", "E4", "E5")
    assert set(young.units) == {"N/m²"}
    np.testing.assert_array_equal(young.lower, np.full(5, 1.7e11))
    np.testing.assert_array_equal(young.upper, np.full(5, 2.5e11))
    np.testing.assert_array_equal(young.start, np.full(5, 2.4e11))
    assert section.names == ("Ix1", "Ix2", "Ax1", "Ax2")
    np.testing.assert_array_equal(section.lower, [3.5e-9, 3.5e-9, 4.5e-4, 4.5e-4])
    np.testing.assert_array_equal(section.upper, [7.5e-9, 7.5e-9, 9e-4, 9e-4])
    for problem in (young, section):
        np.testing.assert_array_equal(problem.data.frequencies_hz, [31.9, 197.9, 553.0, 1082.2, 1781.5])
        assert problem.data.numbers == (1, 3, 5, 7, 9)
        np.testing.assert_array_equal(problem.likelihood.beta, np.ones(5))
    assert [p.prior.sd for p in young.parameters] == [2e11] * 5
    assert [p.prior.sd for p in section.parameters] == [5e-9, 5e-9, 5e-4, 5e-4]
    assert {p.prior.mean for p in (*young.parameters, *section.parameters)} == {0.0}
