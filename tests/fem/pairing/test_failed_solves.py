"""Why a solve failed: each way to fail has its own words, and a theta that works has none."""

import numpy as np
import pytest

from fmu.fem.modes.separable import SeparableModel
from fmu.fem.pairing.failed_solves import why_no_frequencies
from fmu.fem.pairing.modal_model import as_modal_model
from fmu.fem.pairing.paired_structure import PairedStructure

EYE = np.eye(3)
COUPLED = np.array([[2.0, -1.0, 0.0], [-1.0, 2.0, -1.0], [0.0, -1.0, 2.0]])
DOFS = ((1, "x"), (2, "x"), (3, "y"))
THETA = np.array([1.0, 1.0])


def structure(stiffness, mass):
    """Return a paired structure of parameters a (stiffness) and b (mass)."""
    model = SeparableModel.from_terms(["a", "b"], stiffness, mass, dofs=DOFS)
    return PairedStructure.of(model, pairing="index", numbers=(1, 2), sensors=(), reference=THETA)


SECOND = np.diag([0.0, 1.0, 0.0])
BETWEEN = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
FIRST = np.diag([1.0, 0.0, 0.0])
STIFF, HEAVY = [(COUPLED, "a")], [EYE]


@pytest.mark.parametrize(
    ("stiffness", "mass", "theta", "reason"),
    [
        ([(COUPLED, {"a": 3})], HEAVY, [1e150, 1.0], "K is not finite"),
        (STIFF, [(EYE, {"b": 3})], [1.0, 1e150], "M is not finite"),
        (
            STIFF,
            [EYE - SECOND, (SECOND, "b")],
            [1.0, -3.0],
            "M is not positive semidefinite: its diagonal is -3 at node 2 x",
        ),
        (
            STIFF,
            [FIRST, (EYE - FIRST, "b")],
            [1.0, 0.0],
            "M gives 1 modes of finite frequency, 2 are needed",
        ),
        (STIFF, [EYE, (0.5 * BETWEEN, "b")], [1.0, 4.0], "the mass matrix is not positive semidefinite"),
        (STIFF, HEAVY, [-1.0, 1.0], "K is not positive semidefinite: an eigenvalue is -3.41 (rad/s)²"),
    ],
)
def test_reasons_of_a_structure(stiffness, mass, theta, reason):
    posed = structure(stiffness, mass)
    theta = np.array(theta)
    with np.errstate(over="ignore"):
        assert not np.all(np.isfinite(posed.frequencies(theta[None])))
    assert why_no_frequencies(posed, theta) == reason
    assert why_no_frequencies(posed, THETA) is None


def test_overflow_inside_the_solver():
    posed = structure(STIFF, [(EYE, "b")])
    theta = np.array([1e300, 1e-300])
    assert np.all(np.isnan(posed.frequencies(theta[None])))
    assert why_no_frequencies(posed, theta).startswith("the eigenvalue solver did not converge (")


def test_a_solver_that_gives_up(monkeypatch):
    posed = structure(STIFF, HEAVY)

    def fails(*args, **options):
        raise np.linalg.LinAlgError("2 eigenvectors failed to converge")

    monkeypatch.setattr("fmu.fem.modes.eigensolver.sl.eigh", fails)
    monkeypatch.setattr("fmu.fem.modes.full_block.SMALL", 0)
    assert np.all(np.isnan(posed.frequencies(THETA[None])))
    assert why_no_frequencies(posed, THETA) == (
        "the eigenvalue solver did not converge (eigenproblem of 3 DOF: 2 eigenvectors failed to converge)"
    )


class Own:
    """A model of the user's own."""

    n_parameters, n_modes = 1, 2

    def frequencies(self, theta):
        return np.concatenate([np.sqrt(theta), np.ones_like(theta)], axis=1)


def test_any_model_is_looked_at_again():
    model = as_modal_model(Own())
    assert why_no_frequencies(model, np.array([-1.0])) == "frequencies are not finite (nan, 1 Hz)"
    assert why_no_frequencies(model, np.array([1.0])) is None
