"""The bound of a reduced model's frequencies: above the true error everywhere, and not far above."""

import re
import warnings

import numpy as np
import pytest
import scipy.sparse as sp
from numpy.testing import assert_array_equal

from fmu.fem.modes.full_block import FullBlock
from fmu.fem.modes.separable import SeparableModel
from fmu.fem.modes.terms import Term
from fmu.fem.pairing.paired_structure import PairedStructure
from fmu.fem.reduced import anchors as anchors_module
from fmu.fem.reduced import residuals
from fmu.fem.reduced.anchors import Anchors, SingularAnchorError, anchor_points, is_semidefinite
from fmu.fem.reduced.learning import Learner
from fmu.fem.reduced.points import box_points
from fmu.fem.reduced.reduced_structure import train
from fmu.fem.reduced.residuals import bound_errors, frequency_error
from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.parameters import Parameter
from fmu.posterior.problem import UpdatingProblem

N, COUNT = 60, 5


def springs(of, n=N):
    """Return the stiffness of a chain of n masses whose springs k (0: to the ground) are those of the list."""
    K = np.zeros((n, n))
    for k in of:
        K[k, k] += 1.0
        if k:
            K[k - 1, k - 1] += 1.0
            K[k - 1, k] -= 1.0
            K[k, k - 1] -= 1.0
    return sp.csr_array(K)


def masses(of, n=N):
    return sp.csr_array(sp.diags_array(np.isin(np.arange(n), of).astype(float)))


def halves():
    """Return a chain with a stiffness for each half, as for two moduli."""
    return (
        _model([(springs(range(30)), (1, 0)), (springs(range(30, N)), (0, 1))], [(masses(range(N)), (0, 0))]),
        0.5,
        2.0,
    )


def free():
    """Return the same without the ground: one motion as a rigid body."""
    K = [(springs(range(1, 30)), (1, 0)), (springs(range(30, N)), (0, 1))]
    return _model(K, [(masses(range(N)), (0, 0))]), 0.5, 2.0


def heavy():
    """Return a chain with uncertain masses."""
    return (
        _model([(springs(range(N)), (0, 0))], [(masses(range(20)), (1, 0)), (masses(range(20, N)), (0, 1))]),
        0.5,
        2.0,
    )


def plate():
    """Return a chain with stiffness t³ and mass t, as of a plate, beside a part of its own."""
    K = [(springs(range(30)), (3, 0)), (springs(range(30, N)), (0, 1))]
    return _model(K, [(masses(range(30)), (1, 0)), (masses(range(30, N)), (0, 0))]), 0.7, 1.4


def massless():
    """Return a chain of which every third place has no mass."""
    K = [(springs(range(30)), (1, 0)), (springs(range(30, N)), (0, 1))]
    return _model(K, [(masses([k for k in range(N) if k % 3]), (0, 0))]), 0.5, 2.0


def twins():
    """Return two like chains with a weak link: their modes are close, and cross as one stiffens."""
    first, second = sp.diags_array([1.0, 0.0]), sp.diags_array([0.0, 1.0])
    lower, upper, link = springs(range(15), 30), springs(range(15, 30), 30), 1e-3 * sp.eye_array(30)
    K = [(sp.kron(first, lower), (1, 0)), (sp.kron(second, upper), (0, 1))]
    K += [(sp.kron(first, upper) + sp.kron(second, lower) + sp.kron([[1.0, -1.0], [-1.0, 1.0]], link), (0, 0))]
    return _model(K, [(masses(range(N)), (0, 0))]), 0.8, 1.25


def vanishing():
    """Return a chain whose second support may be 10 000 times softer than it is at most."""
    support = springs([0])[::-1, ::-1]
    return (
        _model([(springs(range(N)), (1, 0)), (sp.csr_array(support), (0, 1))], [(masses(range(N)), (0, 0))]),
        (0.8, 1e-4),
        (1.2, 1.0),
    )


def gone():
    """Return a chain that only uncertain springs hold, which may have no stiffness at all."""
    support = sp.csr_array(springs([0])[::-1, ::-1])
    return (
        _model([(springs(range(1, N)), (1, 0)), (support, (0, 1))], [(masses(range(N)), (0, 0))]),
        (0.8, 0.0),
        (1.2, 0.1),
    )


def _model(K, M):
    return SeparableModel([Term(*term) for term in K], [Term(*term) for term in M])


BUILT = [halves, free, heavy, plate, massless, twins, vanishing, gone]


def box(built):
    model, lower, upper = built()
    return (
        model,
        np.broadcast_to(np.asarray(lower, float), 2).copy(),
        np.broadcast_to(np.asarray(upper, float), 2).copy(),
    )


def compared(built, allowed=1e-5):
    """Return true errors and bounds of a space learnt to `allowed` at points, faces and corners, and the modes."""
    model, lower, upper = box(built)
    (dofs,) = model.blocks
    learner = Learner(FullBlock(model, dofs), lower, upper, COUNT, N)
    for seed in range(3):
        learner.visit(box_points(lower, upper, 16, seed), np.full(COUNT, allowed))
    cut, _ = learner.cut(COUNT, allowed, 1, N)
    theta = box_points(lower, upper, 128, seed=50)[::3]
    exact = learner.block.eigenvalues(theta, COUNT)
    found = bound_errors(cut, learner.anchors, theta, COUNT)
    # the modes of interest are elastic: for a rigid-body mode there is no relative error
    elastic = exact > 1e-8 * exact[:, -1:]
    true = np.where(
        elastic, np.sqrt(np.maximum(found.eigenvalues, 0.0) / np.where(elastic, exact, 1.0)) - 1.0, 0.0
    )
    return true, found.error, learner


@pytest.mark.parametrize("built", BUILT)
def test_the_bound_is_a_bound(built):
    true, bound, learner = compared(built)
    assert learner.anchors.proven
    # 1e-12: rounding of the full model, 1e-16 times a condition of some thousands
    assert np.all(true <= bound + 1e-12)
    known = true > 1e-9
    assert known.sum() > 20
    assert np.median(bound[known] / true[known]) <= 5.0


@pytest.mark.parametrize("near", [0.5, 0.8, 0.95])
def test_the_bound_counts_a_mode_just_above_that_little_of_the_residual_shows(near):
    """The trial vector is coupled to a mode at λ/`near` with a tenth of the energy, to a far one with the rest."""
    energy = np.array([1e-7, 9e-7])
    above = np.array([1.0 / near, 1e6])
    K = np.diag([1.0, *above])
    K[0, 1:] = K[1:, 0] = np.sqrt(energy * above)
    exact = np.linalg.eigvalsh(K)
    r = K[:, 0] - K[0, 0] * np.eye(3)[0]
    w = np.linalg.solve(K, r)
    one = np.ones((1, 1))
    bound = frequency_error(one, 0.0, one[None] * (r @ w), one * (w @ w), np.ones(1), exact[1:2])[0, 0]
    true = 1.0 / np.sqrt(exact[0]) - 1.0
    # what the bound neglects is of second order in the energy, divided by the distance of the modes
    second = energy.sum() / (1.0 - near)
    assert true <= bound * (1.0 + 10.0 * second)
    assert bound <= true * (1.0 + 10.0 * second)


@pytest.mark.parametrize("built", [halves, plate, vanishing])
def test_without_alpha_it_is_none(built, monkeypatch):
    nearest = Anchors.nearest
    monkeypatch.setattr(Anchors, "nearest", lambda *given: (nearest(*given)[0], np.ones(len(given[1]))))
    true, bound, _ = compared(built)
    assert np.any(true > bound + 1e-12)


def test_with_an_alpha_of_the_first_term_alone_it_is_none(monkeypatch):
    ratios = Anchors._ratios
    monkeypatch.setattr(Anchors, "_ratios", lambda *given: ratios(*given)[:, :1])
    true, bound, _ = compared(halves)
    assert np.any(true > bound + 1e-12)


def test_a_residual_without_a_term_is_another(monkeypatch):
    matrices, (model, lower, upper) = FullBlock._matrices, box(halves)
    learner = Learner(FullBlock(model, np.arange(N)), lower, upper, COUNT, N)
    learner.anchors.factor(0)
    theta = box_points(lower, upper, 16, seed=1)
    found = bound_errors(learner.space, learner.anchors, theta, COUNT).error

    def of_fewer_terms(self, theta):
        for (K, M), at in zip(matrices(self, theta), theta, strict=True):
            yield K - at[1] * self.K_terms[1].matrix.toarray(), M

    monkeypatch.setattr(FullBlock, "_matrices", of_fewer_terms)
    assert np.all(bound_errors(learner.space, learner.anchors, theta, COUNT).error[:, 0] > 3.0 * found[:, 0])


def test_the_bound_of_a_paired_model_is_that_of_its_modes():
    model, lower, upper = box(twins)
    truth = PairedStructure.of(model, pairing="shape", numbers=(1, 2, 3), sensors=(), reference=lower * 1.05)
    paired, _ = train(truth, lower, upper, 1e-6)
    theta = box_points(lower, upper, 64, seed=9)
    exact, reduced = paired.truth.modes(theta), paired.modes(theta)
    same = np.all((exact.rank == reduced.rank) & (exact.block == reduced.block), axis=1)
    assert same.mean() > 0.9
    true = np.sqrt(reduced.eigenvalues / exact.eigenvalues) - 1.0
    bound = paired.frequency_bound(theta)
    assert np.all(true[same] <= bound[same] + 1e-12)
    assert np.max(bound) <= 2e-6
    assert np.all(np.isinf(paired.frequency_bound(upper[None] * 1.1)))


def test_a_term_that_is_not_semidefinite_gives_an_estimate():
    K = [(springs(range(N)), (1, 0)), (springs([3]) - springs([4]), (0, 1))]
    model = _model(K, [(masses(range(N)), (0, 0))])
    block = FullBlock(model, np.arange(N))
    assert not Anchors(block, np.array([0.8, 0.1]), np.array([1.2, 0.2])).proven
    true, bound, learner = compared(lambda: (model, (0.8, 0.1), (1.2, 0.2)))
    assert not learner.anchors.proven
    assert np.all(true <= 1.1 * bound + 1e-12)


def test_one_anchor_where_little_changes_several_where_a_stiffness_may_vanish():
    terms = [Term(springs([0]), (1, 0)), Term(springs([1]), (0, 3))]
    assert_array_equal(anchor_points(terms, np.full(2, 1.0), np.full(2, 1.5)), [[1.25, 1.25]])
    several = anchor_points(terms, np.array([1.0, 1e-4]), np.array([1.5, 1.0]))
    assert len(several) > 2
    assert np.all(several[:, 0] == 1.25)
    assert len(anchor_points(terms, np.zeros(2), np.ones(2))) <= anchors_module._MOST
    assert 0.0 in anchor_points(terms, np.array([1.0, 0.0]), np.array([1.5, 1.0]))[:, 1]


def test_semidefinite_terms_are_told_from_others():
    assert is_semidefinite(springs(range(1, N)))
    assert is_semidefinite(sp.csr_array((5, 5)))
    assert not is_semidefinite(springs([3]) - 0.1 * springs([4]))
    large = springs(range(1, 500), 500)
    assert is_semidefinite(large)
    assert not is_semidefinite(large - 1.1 * springs([4], 500))


def hinged():
    """Return a chain with a massless end that an uncertain spring alone holds, which may vanish."""
    K = [(springs(range(N - 1)), (1, 0)), (springs([N - 1]), (0, 1))]
    return _model(K, [(masses(range(N - 1)), (0, 0))])


def test_a_motion_without_stiffness_and_mass_names_the_parameter():
    block = FullBlock(hinged(), np.arange(N))
    with pytest.raises(SingularAnchorError, match=r"^K \+ s M is singular") as raised:
        Anchors(block, np.array([0.8, 0.0]), np.array([1.2, 1.0]))
    assert raised.value.parameter == 1
    parameters = [Parameter("k", 1.0, 0.8, 1.2), Parameter("end", 0.5, 0.0, 1.0)]
    with pytest.raises(ValueError, match=r"^parameters: end must not reach zero: .*raise its lower bound"):
        UpdatingProblem.reduced(hinged(), ModalData([0.004, 0.012]), parameters, pairing="index")


def test_a_mode_that_the_space_does_not_know_is_counted():
    """Every residual is small, and yet a mode is missing."""
    model, lower, upper = box(halves)
    (dofs,) = model.blocks
    learner = Learner(FullBlock(model, dofs), lower, upper, COUNT, N)
    theta = 0.5 * (lower + upper)[None]
    assert learner.counts_the_same(theta, 3)
    _, shapes = learner.block.modes(theta, COUNT + 2)
    learner.space = learner.space.empty(learner.block, 0.0).grown(
        np.delete(shapes[0], 1, axis=1), learner.anchors.first
    )
    assert np.all(bound_errors(learner.space, learner.anchors, theta, 3).error < 1e-9)
    assert not learner.counts_the_same(theta, 3)


def test_fewer_points_at_once_where_memory_is_short(monkeypatch):
    model, *_ = box(halves)
    block = FullBlock(model, np.arange(N))
    assert residuals.at_once(block, COUNT) == 16
    monkeypatch.setattr(residuals, "BUDGET", 8 * 3 * N * COUNT * 4)
    assert residuals.at_once(block, COUNT) == 4


def posed(K, lower, upper):
    """Return the problem of a chain with the terms of K, and all warnings of its training."""
    ndim = len(lower)
    model = _model(K, [(masses(range(N)), (0,) * ndim)])
    start = 0.5 * (np.array(lower) + np.array(upper))
    lam = FullBlock(model, np.arange(N)).eigenvalues(start[None], 3)[0]
    measured = ModalData(np.sqrt(np.abs(lam)) / (2.0 * np.pi))
    parameters = [Parameter(f"p{j}", *of) for j, of in enumerate(zip(start, lower, upper, strict=True))]
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        problem = UpdatingProblem.reduced(model, measured, parameters, pairing="index")
    return problem, [str(warning.message) for warning in said]


def uncertain(of, ndim):
    """Return terms of K: the chain, and a spring for each parameter."""
    unit = np.eye(ndim, dtype=int)
    return [(springs(range(N)), (0,) * ndim), *((K, tuple(row)) for K, row in zip(of, unit, strict=True))]


def test_springs_that_vanish_together_have_anchors_of_their_own():
    problem, said = posed(uncertain([50.0 * springs([k]) for k in (10, 40)], 2), [0.0, 0.0], [10.0, 10.0])
    assert not said
    theta = 10.0 ** np.random.default_rng(0).uniform(-9.0, 1.0, size=(200, 2))
    bound = problem.model.frequency_bound(theta).max(axis=1)
    assert np.median(bound) <= 1e-6
    assert bound.max() <= 1e-3


def test_a_coefficient_that_changes_its_sign_has_an_estimate_of_alpha():
    """As of a change that is added to a nominal part."""
    problem, said = posed(uncertain([springs([10]), springs([40])], 2), [-0.5, 0.5], [0.5, 1.5])
    assert not said
    theta = problem.sample_prior(np.random.default_rng(0), 100)
    error = problem.frequencies(theta) / problem.model.truth.frequencies(theta) - 1.0
    bound = problem.model.frequency_bound(theta)
    assert np.all(np.abs(error) <= bound + 1e-12)
    assert bound.max() <= 5e-6


def test_where_no_anchor_is_near_is_told():
    terms = uncertain([50.0 * springs([k]) for k in (10, 20, 30, 40)], 4)
    _, said = posed(terms, [0.0] * 4, [10.0] * 4)
    (message,) = said
    assert re.match(r"reduction: errors of the reduced model are not bounded well where p\d is below", message)
    assert "narrow the bounds of this parameter" in message


def test_a_stiffness_that_turns_negative_is_told_with_its_parameter():
    terms = uncertain([-1.0 * springs([10]), springs([40])], 2)
    _, said = posed(terms, [0.1, 0.5], [1.2, 1.5])
    (message,) = said
    found = re.match(
        r"reduction: K is negative for some motion where p0 is above (\S+); narrow the bounds", message
    )
    assert 0.99 <= float(found.group(1)) <= 1.0


def test_a_stiffness_that_is_negative_at_the_start_is_refused():
    terms = uncertain([-3.0 * springs([10]), springs([40])], 2)
    with pytest.raises(ValueError, match=r"^stiffness: K must not be negative .*, by the term of p0; correct its"):
        posed(terms, [0.5, 0.5], [1.5, 1.5])
