"""The simulated cases of several tests: written by their script, and the posterior tells what was simulated."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.linalg import eigh

import fmu
from fmu.formats.matrices.read import read_matrix
from tests.validation import several_cases as cases

FOLDER = fmu.cases.path(cases.DAMAGE).parent


def test_the_files_are_what_their_script_writes():
    assert fmu.cases.path(cases.REPEATED).read_text(encoding="utf-8") == cases.repeated_text()
    assert fmu.cases.path(cases.DAMAGE).read_text(encoding="utf-8") == cases.damage_text()
    assert_allclose(read_matrix(FOLDER / cases.DAMAGE / "mass.mtx").toarray(), cases.mass(), rtol=1e-15)
    for group in cases.GROUPS:
        found = read_matrix(FOLDER / cases.DAMAGE / f"{group.replace(' ', '-')}.mtx").toarray()
        assert_allclose(found, cases.stiffness(group), rtol=1e-15)


def test_the_matrices_are_those_of_rigid_floors():
    """Kinetic and strain energy of floors that move by x and y and turn, from scratch."""
    rng = np.random.default_rng(1)
    x, y, turn = rng.standard_normal((3, 4))
    u = np.stack([x, y - 2.5 * turn, y + 2.5 * turn], axis=1).ravel()
    inertia = cases.FLOORS * (5.0**2 + 5.0**2) / 12.0
    assert u @ cases.mass() @ u == pytest.approx(np.sum(cases.FLOORS * (x**2 + y**2) + inertia * turn**2))
    drift = [np.diff(v, prepend=0.0) for v in (x, y, turn)]
    north, south = drift[0] - 2.5 * drift[2], drift[0] + 2.5 * drift[2]
    west, east = drift[1] - 2.5 * drift[2], drift[1] + 2.5 * drift[2]
    whole = sum(cases.stiffness(group) for group in cases.GROUPS)
    energy = np.sum(50e6 * (north**2 + south**2) + 35e6 * (west**2 + east**2))
    assert u @ whole @ u == pytest.approx(energy)


def test_the_frequencies_of_all_tests_from_scratch():
    problem = fmu.cases.load(cases.REPEATED)
    values, measured = cases.repeated()
    assert problem.is_hierarchical
    assert_allclose(problem.data.frequencies_hz, measured.ravel(), atol=5e-5)
    theta = problem.start.copy()
    scores = [problem.names.index(f"k1 score [{t}]") for t in range(1, 31)]
    theta[scores] = np.linspace(-1.0, 1.0, 30)
    for factors, f in zip(problem.values(theta), problem.frequencies(theta).reshape(30, 4), strict=True):
        K = sum(2e6 * k * np.outer(cases.chain(s), cases.chain(s)) for s, k in enumerate(factors, 1))
        assert_allclose(f, np.sqrt(eigh(K, 1000.0 * np.eye(4), eigvals_only=True)) / (2 * np.pi), rtol=1e-9)
    assert_allclose(values.mean(axis=0), cases.MEANS, atol=4 * cases.SPREAD / np.sqrt(30))


@pytest.mark.validate
def test_the_scatter_is_found():
    trace = fmu.sample(fmu.cases.load(cases.REPEATED), draws=100, warmup=150, seed=3)
    table = fmu.summary(trace)
    truth = cases.repeated()[0]
    for j, name in enumerate(("k1", "k2", "k3", "k4")):
        mean, sd = table.loc[f"{name} mean"], table.loc[f"{name} sd"]
        assert abs(mean["mean"] - cases.MEANS[j]) < 4 * mean["sd"]
        assert abs(sd["mean"] - truth[:, j].std(ddof=1)) < 4 * sd["sd"]
        assert sd["eti90_lb"] > 0.02


@pytest.mark.validate
def test_the_damage_is_found():
    trace = fmu.sample(fmu.cases.load(cases.DAMAGE), draws=250, warmup=150, seed=3)
    table = fmu.damage(trace, (0.1,))
    for state in ("pattern 1", "pattern 2"):
        for group in cases.GROUPS:
            loss = table.loc[(state, group)]
            lost = cases.PATTERNS[state].get(group, 0.0)
            assert abs(loss["mean"] - lost) < 4 * loss["sd"]
            assert (loss["P(loss > 10 %)"] > 0.9) == (lost > 0.0)
