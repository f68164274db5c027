"""The certificate of reduced frequency response functions, where it holds and where it turns."""

import numpy as np
import pytest

import fmu
from fmu.fem.frf.confirming import FRFCertificate, confirm
from fmu.fem.frf.model import Damping, FRFModel
from fmu.fem.frf.proportional import Source
from fmu.fem.frf.training import Lines

THETA, VALUES = np.full((1, 5), 2.1e11) * [1.05, 0.95, 1.0, 1.1, 0.9], np.array([[0.006]])


@pytest.fixture(scope="module")
def model():
    problem = fmu.cases.load("cantilever-young")
    f = np.linspace(20.0, 1300.0, 120)
    points = [(50, "z"), (30, "z")]
    own = (problem.model.structure, points, points[:1] * 2, Damping(1, ratios=(Source(0.006, 0),)), problem.start)
    box = problem.lower, problem.upper, VALUES[0]
    rough = FRFModel(*own, *box, Lines(2 * np.pi * f, np.ones((2, len(f)))))
    theta, values = THETA, VALUES
    size = np.abs(rough.at(theta, values).frfs(2 * np.pi * f)[0])
    return FRFModel(*own, *box, Lines(2 * np.pi * f, 0.03 * size))


def test_a_trained_basis_is_confirmed_by_a_larger_one_and_by_direct_solves(model):
    assert model.is_confirmed
    assert model.block.size < 30
    found = confirm(model, THETA, VALUES)
    assert found.ok
    assert found.lines == 3
    assert "at most" in found.sentence()
    assert FRFCertificate.from_trace(found.attributes()) == found


def test_a_basis_without_its_last_vectors_is_not(model):
    small = model.on(model.block.truncate(model.block.size - 8))
    found = confirm(small, THETA, VALUES)
    assert not found.ok
    assert found.direct_error > 10 * confirm(model, THETA, VALUES).direct_error


def test_training_is_done_once(model, monkeypatch):
    """The same model is read from the cache, bit for bit; another band is trained."""
    from fmu.fem.frf import model as module

    calls, train = [], module.train
    monkeypatch.setattr(module, "train", lambda *args: calls.append(1) or train(*args))
    structure = fmu.cases.load("cantilever-young").model.structure
    damping = Damping(1, ratios=(Source(0.006, 0),))
    start = np.full(5, 2.4e11)
    box = np.full(5, 2.3e11), np.full(5, 2.5e11), VALUES[0]

    def make(top):
        lines = Lines(2 * np.pi * np.linspace(20.0, top, 30), np.full((1, 30), 1e-7))
        return FRFModel(structure, [(50, "z")], [(50, "z")], damping, start, *box, lines)

    first, again = make(300.0), make(300.0)
    assert np.array_equal(first.block.basis, again.block.basis)
    assert first.n_solves == again.n_solves
    n = len(calls)
    make(310.0)
    assert (n, len(calls)) in ((1, 2), (0, 1), (0, 0))  # a cache of an earlier run may have any of them


class Moved:
    """A model whose FRFs are those of other parameters; its bases are those of the model."""

    def __init__(self, model, by):
        self.model, self.by = model, by

    def __getattr__(self, name):
        return getattr(self.model, name)

    def at(self, theta, values):
        return self.model.at(theta + self.by, values)


def test_the_shift_is_that_of_the_posterior(model):
    """An error of the FRFs along the derivative by the first modulus is found in its standard deviations."""
    J = model.at(THETA, VALUES).slopes(model.lines.omega)[0, ..., 0] / model.lines.unit
    sd = 1.0 / np.sqrt(np.sum(np.abs(J) ** 2))
    by = np.array([2.0 * sd, 0, 0, 0, 0])
    assert abs(confirm(Moved(model, by), THETA, VALUES).shift - 2.0) < 0.1
