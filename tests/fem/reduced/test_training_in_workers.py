"""A reduced model trained by several processes is the one that a single process trains, in every bit."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

import fmu
from fmu.fem.frame.components import DIRECTIONS, ElementGroup, Material, Section
from fmu.fem.frame.frame import Frame
from fmu.fem.modes.eigensolver import DENSE_LIMIT
from fmu.fem.pairing.paired_structure import PairedStructure
from fmu.fem.reduced.reduced_structure import train

STEEL = Material(E=2.1e11, nu=0.3, rho=7850.0)


@pytest.fixture(scope="module")
def engine():
    with fmu.engine(workers=2) as engine:
        yield engine


def cantilever(n_elements):
    """Return a cantilever out of the axes, a single block, whose halves have moduli of their own."""
    direction = np.array([1.0, 0.2, 0.4])
    nodes = np.linspace(0, 1.0, n_elements + 1)[:, None] * direction
    elements = np.stack([np.arange(n_elements), np.arange(1, n_elements + 1)], axis=1)
    section = Section(A=3e-3, Iy=4e-6, Iz=9e-6, J=7e-6)
    groups = [ElementGroup(str(g), part, section, STEEL) for g, part in enumerate(np.split(elements, 2))]
    return Frame(nodes, groups, {0: DIRECTIONS}).separable({"E0": [("E", "0")], "E1": [("E", "1")]})


@pytest.mark.parametrize(("n_elements", "pairing"), [(10, "shape"), (10, "index"), (100, "index")])
def test_the_basis_is_the_same(engine, n_elements, pairing):
    model = cantilever(n_elements)
    assert (model.n_dof > DENSE_LIMIT) == (n_elements == 100)  # so that both solvers have their turn
    states = []
    for at in (None, engine):
        structure = PairedStructure.of(
            model, pairing=pairing, numbers=(1, 2, 3), sensors=(), reference=np.full(2, 2.1e11)
        )
        calls = []
        states.append(
            train(structure, np.full(2, 1.4e11), np.full(2, 2.8e11), 1e-4, engine=at and Counting(at, calls))[1]
        )
        assert (min(calls, default=0) >= 4) == (at is not None)  # the workers were made use of
    assert states[0].keys() == states[1].keys()
    for name, state in states[0].items():
        assert_array_equal(states[1][name], state)


class Counting:
    """An engine that remembers how many tasks it was given."""

    def __init__(self, engine, calls):
        self.engine, self.calls, self.workers = engine, calls, engine.workers

    def run_tasks(self, work, shared, tasks, follow=None, report=None):
        self.calls.append(len(tasks))
        return self.engine.run_tasks(work, shared, tasks, follow, report)


def test_a_problem_answers_the_same(engine, monkeypatch, tmp_path):
    answers = []
    for at in (None, engine):
        monkeypatch.setenv("FMU_CACHE_DIR", str(tmp_path / str(at is None)))
        problem = fmu.cases.load("shear-10dof", engine=at)
        theta = problem.sample_prior(np.random.default_rng(1), 20)
        answers.append(problem.log_prob(theta))
    assert_array_equal(*answers)
