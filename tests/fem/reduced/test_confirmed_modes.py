"""Modes of large structures, from those of the reduced model: the full model's, or solved for anew."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fmu.fem.pairing.paired_structure import PairedStructure
from fmu.fem.reduced import confirming
from fmu.fem.reduced.points import box_points
from fmu.fem.reduced.reduced_structure import train
from tests.fem.reduced.test_frequency_bound import BUILT, box, free, heavy, plate


def paired(built, tolerance=1e-4):
    model, lower, upper = box(built)
    middle = 0.5 * (lower + upper)
    structure = PairedStructure.of(model, pairing="index", numbers=(2, 3, 4, 5), sensors=(), reference=middle)
    return train(structure, lower, upper, tolerance)[0], box_points(lower, upper, 8, seed=31)


@pytest.fixture(autouse=True)
def _all_are_large(monkeypatch):
    monkeypatch.setattr(confirming, "LARGE", 10)


@pytest.fixture
def solved_anew(monkeypatch):
    """Return the points of a block that were solved for as without a reduced model."""
    points, whole = [], confirming.FullBlock._solve_each

    def counted(self, theta, count):
        if isinstance(self, confirming.ConfirmedBlock):
            points.extend(theta)
        return whole(self, theta, count)

    monkeypatch.setattr(confirming.FullBlock, "_solve_each", counted)
    return points


@pytest.mark.parametrize(
    "built", [pytest.param(of, marks=pytest.mark.validate if of in (heavy, plate) else ()) for of in BUILT]
)
def test_they_are_those_of_the_full_model(built, solved_anew):
    structure, theta = paired(built)
    solved_anew.clear()
    exact, found = structure.truth.modes(theta), structure.confirmed_modes(theta)
    assert_allclose(found.eigenvalues, exact.eigenvalues, rtol=1e-8, atol=1e-8 * exact.eigenvalues.max())
    assert_array_equal(found.rank, exact.rank)
    reduced = structure.modes(theta).eigenvalues
    if not (structure.cheap.blocks[0].size == structure.truth.blocks[0].size or built.__name__ == "gone"):
        assert np.max(np.abs(reduced / exact.eigenvalues - 1.0)) > 1e-7  # there is something to correct
        assert len(solved_anew) < len(theta)


def test_a_mode_that_is_missing_is_counted_and_solved_for(monkeypatch, solved_anew):
    """Without one direction, Ritz vectors and corrections never find the mode."""
    structure, theta = paired(free)
    exact = structure.truth.modes(theta)
    solved_anew.clear()
    whole = confirming.davidson
    monkeypatch.setattr(confirming, "davidson", lambda *args: tuple(np.delete(of, 2, -1) for of in whole(*args)))
    found = structure.confirmed_modes(theta)
    assert len(solved_anew) == len(theta)
    assert_allclose(found.eigenvalues, exact.eigenvalues, rtol=1e-12)


def test_iterations_that_do_not_end_are_given_up(monkeypatch, solved_anew):
    monkeypatch.setattr(confirming, "CONVERGED", 0.0)
    structure, theta = paired(free)
    solved_anew.clear()
    found = structure.confirmed_modes(theta[:3])
    assert len(solved_anew) == 3
    assert_allclose(found.eigenvalues, structure.truth.modes(theta[:3]).eigenvalues, rtol=1e-12)


def test_outside_the_trained_box_the_full_model_answers(solved_anew):
    structure, theta = paired(free)
    solved_anew.clear()
    theta = np.concatenate([theta[:2], 3.0 * theta[:1]])
    found = structure.confirmed_modes(theta)
    assert_allclose(found.eigenvalues, structure.truth.modes(theta).eigenvalues, rtol=1e-8)
    assert_array_equal(
        structure.confirmed_modes(theta[2:]).eigenvalues, structure.truth.modes(theta[2:]).eigenvalues
    )
