"""A reduced model trained by several processes is the one that a single process trains, in every bit."""

import os
import signal

import numpy as np
import pytest
import scipy.sparse as sp
from numpy.testing import assert_array_equal

import fmu
from fmu.engines.base import InProcess
from fmu.fem.frame.components import DIRECTIONS, ElementGroup, Material, Section
from fmu.fem.frame.frame import Frame
from fmu.fem.modes import full_block
from fmu.fem.modes.eigensolver import DENSE_LIMIT
from fmu.fem.modes.full_block import COPIES, LIBRARIES
from fmu.fem.modes.separable import SeparableModel
from fmu.fem.modes.solver import LARGE
from fmu.fem.modes.terms import Term
from fmu.fem.pairing.paired_structure import PairedStructure
from fmu.fem.reduced.anchors import SingularAnchorError
from fmu.fem.reduced.points import box_points
from fmu.fem.reduced.reduced_structure import train

STEEL = Material(E=2.1e11, nu=0.3, rho=7850.0)


def cantilever(n_elements):
    """Return a cantilever out of the axes, a single block, whose halves have moduli of their own."""
    direction = np.array([1.0, 0.2, 0.4])
    nodes = np.linspace(0, 1.0, n_elements + 1)[:, None] * direction
    elements = np.stack([np.arange(n_elements), np.arange(1, n_elements + 1)], axis=1)
    section = Section(A=3e-3, Iy=4e-6, Iz=9e-6, J=7e-6)
    groups = [ElementGroup(str(g), part, section, STEEL) for g, part in enumerate(np.split(elements, 2))]
    model = Frame(nodes, groups, {0: DIRECTIONS}).separable({"E0": [("E", "0")], "E1": [("E", "1")]})
    return model, np.full(2, 1.4e11), np.full(2, 2.8e11)


def chain(n=LARGE):
    """Return a chain of n masses on springs, each half of which has a stiffness of its own."""
    terms = []
    for half in range(2):
        springs = np.where(np.arange(n) * 2 // n == half, 1.0, 0.0)
        after = np.append(springs[1:], 0.0)
        bands = [springs + after, -after[:-1], -after[:-1]]
        terms.append(
            Term(sp.csr_array(sp.diags_array(bands, offsets=[0, 1, -1])), tuple(np.eye(2, dtype=int)[half]))
        )
    mass = Term(sp.csr_array(sp.eye_array(n)), (0, 0))
    return SeparableModel(terms, [mass]), np.full(2, 0.7), np.full(2, 1.4)


def paired(built, pairing="index"):
    model, lower, upper = built
    reference = 0.5 * (lower + upper)
    structure = PairedStructure.of(model, pairing=pairing, numbers=(1, 2, 3), sensors=(), reference=reference)
    return structure, lower, upper


class Counting:
    """An engine that remembers how many tasks it was given."""

    def __init__(self, engine, free=None):
        self.engine, self.calls, self.workers, self.free = engine, [], engine.workers, free

    def free_memory(self):
        return self.free

    def run_tasks(self, work, shared, tasks, follow=None, report=None):
        self.calls.append((len(tasks), shared))
        return self.engine.run_tasks(work, shared, tasks, follow, report)


def assert_states_equal(one, other):
    assert one.keys() == other.keys()
    for name, state in one.items():
        assert_array_equal(other[name], state)


@pytest.mark.parametrize(("n_elements", "pairing"), [(10, "shape"), (100, "index")])
def test_the_basis_is_the_same(engine, n_elements, pairing):
    built = cantilever(n_elements)
    is_dear = built[0].n_dof > DENSE_LIMIT
    assert is_dear == (n_elements == 100)  # so that both solvers have their turn
    states, counted = [], Counting(engine)
    for at in (None, InProcess(), counted):
        structure, lower, upper = paired(built, pairing)
        with structure.spread_over(at):
            states.append(train(structure, lower, upper, 1e-3)[1])
    assert bool(counted.calls) == is_dear  # a small block is not worth a task
    for other in states[1:]:
        assert_states_equal(states[0], other)


@pytest.mark.parametrize("where", ["workers", pytest.param("this process", marks=pytest.mark.validate)])
def test_a_large_structure_is_the_same_too(engine, where):
    """Right-hand sides of residuals, solves that confirm, and plain solves are tasks."""
    found, shared = [], []
    for at in (None, engine if where == "workers" else InProcess()):
        structure, lower, upper = paired(chain())
        counted = at and Counting(at)
        theta = box_points(lower, upper, 4, seed=4)[:5]
        with structure.spread_over(counted):
            model, state = train(structure, lower, upper, 1e-3)
            modes = model.confirmed_modes(theta).eigenvalues
            some = structure.full_blocks[0].modes(theta[:2], 3)
            bound = model.frequency_bound(theta)
        if at is engine:
            shared += [of for _, of in counted.calls]
            os.kill(engine._processes[0].process.pid, signal.SIGKILL)
            with structure.spread_over(engine):
                again = model.confirmed_modes(theta).eigenvalues
            assert_array_equal(again, modes)
        assert_array_equal(structure.full_blocks[0].modes(theta[1:2], 3)[1][0], some[1][1])
        found.append((state, modes, bound, *some))
    assert np.isfinite(found[0][1]).all()
    assert_states_equal(found[0][0], found[1][0])
    for one, same in zip(found[0][1:], found[1][1:], strict=True):
        assert_array_equal(same, one)
    if where == "workers":  # the anchors are sent once, for right-hand sides and for solves that confirm
        names = [type(of).__name__ for of in shared]
        assert names.count("Anchors") >= 2
        assert len({id(of) for of in shared}) == 2


def test_no_more_workers_than_fit(engine):
    structure, lower, upper = paired(chain())
    (block,) = structure.full_blocks
    theta = box_points(lower, upper, 4, seed=4)[:3]
    entries = sum(term.matrix.nnz for term in block.K_terms)
    exact = block.modes(theta, 2)[0]
    one = LIBRARIES + 12 * (entries + block.size) + COPIES * 12 * entries + 8 * block.size * full_block._VECTORS
    one += block.clear_factor(lower).n_bytes
    for free, begun in ((2 * one, [2]), (2 * one - 1, [])):
        counted = Counting(engine, free)
        with structure.spread_over(counted):
            assert_array_equal(block.modes(theta, 2)[0], exact)
        assert [n for n, _ in counted.calls] == begun


def test_a_solve_that_fails_keeps_its_reason(engine):
    structure, lower, upper = paired(cantilever(100))
    (block,) = structure.full_blocks
    theta = np.stack([lower, np.nan * lower, upper])
    with structure.spread_over(engine):
        found = structure.modes(theta).eigenvalues
        with pytest.raises(SingularAnchorError, match="no stiffness at 1") as caught:
            block.run_tasks(_fails, block, range(3))
    assert_array_equal(found, structure.modes(theta).eigenvalues)
    assert_array_equal(np.isnan(found).any(axis=1), [False, True, False])
    assert caught.value.parameter == 1


def _fails(block, task, report):
    if task == 1:
        raise SingularAnchorError(f"no stiffness at {task}", parameter=1)
    return task


def test_a_problem_answers_the_same(engine, monkeypatch, tmp_path):
    answers = []
    for at in (None, engine):
        monkeypatch.setenv("FMU_CACHE_DIR", str(tmp_path / str(at is None)))
        problem = fmu.cases.load("shear-2dof", engine=at)
        theta = problem.sample_prior(np.random.default_rng(1), 20)
        answers.append(problem.log_prob(theta))
    assert_array_equal(*answers)
