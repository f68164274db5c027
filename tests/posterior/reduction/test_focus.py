"""The reduced model of a problem: as good as promised in all four cases, trained once, and remembered."""

from itertools import product

import numpy as np
import pytest
import scipy.sparse as sp
from numpy.testing import assert_allclose, assert_array_equal

from fmu import FrequencyErrors, FRFData, FRFErrors, ModalDamping, cases
from fmu.fem.modes.modal import frequency_gradient, frequency_hz
from fmu.fem.modes.separable import SeparableModel
from fmu.fem.modes.terms import Term
from fmu.fem.pairing.paired_structure import PairedStructure
from fmu.fem.reduced import training
from fmu.fem.reduced.basis import ReducedBlock
from fmu.fem.reduced.points import Trained
from fmu.fem.reduced.reduced_structure import ReducedStructure
from fmu.fem.reduced.training import Training
from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.parameters import Parameter
from fmu.posterior.priors.base import Normal
from fmu.posterior.problem import UpdatingProblem
from fmu.posterior.reduction import train_reduced as focus
from fmu.posterior.reduction.region import plausible_points
from fmu.posterior.reduction.tolerance import FREQUENCY_TOLERANCE, LOG_PROB_TOLERANCE, Tolerance
from fmu.posterior.reduction.train_reduced import ReductionWarning

CASES = [
    pytest.param((f"cantilever-{case}", pairing), id=f"{case}, {pairing}", marks=marks)
    for case, pairing, marks in (
        ("young", "shape", ()),
        ("young", "index", pytest.mark.validate),
        ("section", "shape", pytest.mark.validate),
        ("section", "index", ()),
    )
]
SIZES = (1, 2, 3, 16, 64, 513)


@pytest.fixture(scope="module", params=CASES)
def problem(request, load_case):
    return load_case(*request.param)


@pytest.fixture(scope="module")
def over_the_box(problem):
    """Return every corner of the box and 40 random points, with the modes of both models there."""
    corners = np.array(list(product(*zip(problem.lower, problem.upper, strict=True))))
    unit = np.random.default_rng(2026).uniform(size=(40, problem.ndim))
    theta = np.concatenate([corners, problem.lower + unit * (problem.upper - problem.lower)])
    structure = problem.model
    solves = structure.full_solves
    reduced = structure.modes(theta, gradient=True)
    assert structure.full_solves == solves
    return theta, reduced, structure.truth.solve(theta, gradient=True)


def test_frequencies_are_within_a_millionth_over_the_box(over_the_box):
    _, reduced, exact = over_the_box
    f, f_exact = frequency_hz(reduced.eigenvalues), frequency_hz(exact.eigenvalues)
    assert_allclose(f, f_exact, rtol=1e-6)
    # Rayleigh's principle, but for the full solver's own rounding
    assert np.all(f > f_exact * (1 - 1e-7))


def test_pairing_agrees_with_assignment_by_the_full_model_over_the_box(over_the_box):
    _, reduced, exact = over_the_box
    assert_array_equal(reduced.block, exact.block)
    assert_array_equal(reduced.rank, exact.rank)


def test_gradients_are_within_a_hundred_thousandth_over_the_box(problem, over_the_box):
    """∂ log f over the width of the box, relative to the largest at that theta."""
    _, reduced, exact = over_the_box
    slopes = []
    for modes in (reduced, exact):
        f = frequency_hz(modes.eigenvalues)
        slopes.append(frequency_gradient(f, modes.gradient) * problem.scale / f[..., None])
    error = np.max(np.abs(slopes[0] - slopes[1]), axis=(1, 2)) / np.max(np.abs(slopes[1]), axis=(1, 2))
    assert np.max(error) < 1e-5


def test_log_prob_is_within_its_tolerance_at_plausible_points(problem):
    theta = plausible_points(problem, 40, np.random.default_rng(314))
    full = frequency_hz(problem.model.truth.modes(theta).eigenvalues)
    exact = problem.likelihood.error.log_prob_terms(full).sum(axis=1)
    assert_allclose(problem.log_likelihood(theta), exact, rtol=0, atol=LOG_PROB_TOLERANCE)


def test_log_prob_is_within_its_tolerance_where_a_posterior_lives(problem):
    """Draws of a random walk from the best maximum, started and run on the reduced model alone."""
    rng = np.random.default_rng(5)
    theta = plausible_points(problem, 40, rng)[:40]
    value = problem.log_prob(theta)
    for _ in range(60):
        proposal = theta + 0.02 * problem.scale * rng.standard_normal(theta.shape)
        proposed = problem.log_prob(proposal)
        accepted = np.log(rng.uniform(size=len(theta))) < proposed - value
        theta, value = np.where(accepted[:, None], proposal, theta), np.where(accepted, proposed, value)
    assert np.max(value) - np.min(value) < 50
    full = frequency_hz(problem.model.truth.modes(theta).eigenvalues)
    exact = problem.likelihood.error.log_prob_terms(full).sum(axis=1) + problem.log_prior(theta)
    assert_allclose(value, exact, rtol=0, atol=LOG_PROB_TOLERANCE)


def test_a_batch_changes_no_bit(problem):
    rng = np.random.default_rng(8)
    theta = problem.sample_prior(rng, max(SIZES))
    theta[::7] = np.where(rng.uniform(size=theta[::7].shape) < 0.5, problem.lower, problem.upper)  # corners
    theta[3::50] *= 2.0  # outside the bounds
    values = [problem.log_prob(row) for row in theta]
    assert np.sum(np.isinf(values)) == len(theta[3::50])
    pairs = [problem.log_prob_and_grad(row) for row in theta]
    for n in SIZES:
        for first in sorted({0, (max(SIZES) - n) // 3, max(SIZES) - n}):
            rows = slice(first, first + n)
            assert_array_equal(problem.log_prob(theta[rows]), values[rows])
            value, gradient = problem.log_prob_and_grad(theta[rows])
            assert_array_equal(value, [v for v, _ in pairs[rows]])
            assert_array_equal(gradient, [g for _, g in pairs[rows]])
    assert_array_equal(problem.log_prob(np.asfortranarray(theta)), values)
    assert_array_equal(problem.log_prob(theta[::-1])[::-1], values)


def test_a_theta_outside_the_bounds_gets_the_full_models_frequencies_and_is_counted(problem):
    theta = np.vstack([problem.start, problem.upper * 1.1, problem.lower * 0.9, problem.start])
    before = problem.model.full_solves
    frequencies = problem.frequencies(theta)
    assert problem.model.full_solves == before + 2
    assert_array_equal(frequencies[1:3], frequency_hz(problem.model.truth.modes(theta[1:3]).eigenvalues))
    assert_array_equal(frequencies[[0, 3]], [problem.frequencies(problem.start)] * 2)
    problem.log_prob(theta)  # outside the bounds there is nothing to solve
    assert problem.model.full_solves == before + 2


def promise(monkeypatch, frequency, log_prob):
    """Let every problem ask for these tolerances."""
    monkeypatch.setattr(Tolerance, "of", classmethod(lambda cls, *_: cls(frequency, log_prob)))


@pytest.fixture
def bases(tmp_path, monkeypatch):
    """Return an empty cache of its own."""
    monkeypatch.setenv("FMU_CACHE_DIR", str(tmp_path))
    return tmp_path


def oscillators(chain, **changes):
    """Return a problem of three masses, trained in no time."""
    parameters = [Parameter(n, 2.0, 1.0, 4.0, prior=Normal(2.0, mean=2.0)) for n in ("k0", "k1")]
    return UpdatingProblem.reduced(chain, ModalData([0.1, 0.2]), parameters, pairing="index", **changes)


@pytest.fixture
def trainings(monkeypatch):
    """Return a list that grows by one whenever a structure is trained."""
    calls, train = [], focus.train

    def counted(structure, *arguments, **options):
        calls.append(structure)
        return train(structure, *arguments, **options)

    monkeypatch.setattr(focus, "train", counted)
    return calls


def test_a_second_problem_reads_what_the_first_one_trained(bases, trainings):
    first = two_chains()
    assert len(trainings) == 1
    (file,) = bases.iterdir()
    written = file.stat().st_mtime_ns
    second = two_chains()
    assert len(trainings) == 1
    assert file.stat().st_mtime_ns == written
    theta = first.sample_prior(np.random.default_rng(0), 20)
    assert_array_equal(second.log_prob(theta), first.log_prob(theta))
    assert repr(second.model) == repr(first.model)


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 not a zip", b"\x80\x04]\x94." * 20])
def test_a_broken_file_is_trained_again_and_replaced(bases, trainings, chain, content):
    theta = np.array([1.5, 2.5])
    expected = oscillators(chain).log_prob(theta)
    (file,) = bases.iterdir()
    good = file.read_bytes()
    for broken in (content, good[:-7], good[:50] + b"?" + good[51:]):
        file.write_bytes(broken)
        assert oscillators(chain).log_prob(theta) == expected
        assert file.read_bytes() == good
    assert len(trainings) == 4


def test_what_changes_the_posterior_changes_the_file(bases, trainings, chain):
    oscillators(chain)
    for changes in ({"beta": 2.0}, {"beta": [1.0, 3.0]}):
        oscillators(chain, **changes)
    assert len(list(bases.iterdir())) == len(trainings) == 3
    oscillators(chain, beta=[1.0, 3.0])
    assert len(trainings) == 3


def test_without_a_cache_every_problem_is_trained(tmp_path, monkeypatch, trainings, chain):
    monkeypatch.setenv("FMU_CACHE_DIR", "")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert oscillators(chain).log_prob([1.5, 2.5]) == oscillators(chain).log_prob([1.5, 2.5])
    assert len(trainings) == 2
    assert not list(tmp_path.iterdir())


def test_a_cache_that_cannot_be_written_is_no_hindrance(tmp_path, monkeypatch, trainings, chain):
    (tmp_path / "file").write_text("no directory")
    monkeypatch.setenv("FMU_CACHE_DIR", str(tmp_path / "file" / "bases"))
    assert np.isfinite(oscillators(chain).log_prob([1.5, 2.5]))
    assert len(trainings) == 1


def test_training_goes_on_until_the_log_probability_is_right(load_case, bases, monkeypatch):
    """A measurement so exact that a millionth of a frequency is too coarse."""
    sharp = load_case("cantilever-young", "shape")
    options = {"beta": 1e4, "name": "sharp"}

    def build():
        return UpdatingProblem.reduced(
            sharp.model.structure,
            ModalData(sharp.frequencies(sharp.start * 0.9), sensors=sharp.data.sensors),
            sharp.parameters,
            **options,
        )

    problem = build()
    theta = plausible_points(problem, 40, np.random.default_rng(9))
    full = frequency_hz(problem.model.truth.modes(theta).eigenvalues)
    exact = problem.likelihood.error.log_prob_terms(full).sum(axis=1)
    assert_allclose(problem.log_likelihood(theta), exact, rtol=0, atol=LOG_PROB_TOLERANCE)
    promise(monkeypatch, 1e-6, 1e9)
    assert np.max(np.abs(build().log_likelihood(theta) - exact)) > 10.0 * LOG_PROB_TOLERANCE


def two_chains(**options):
    """Return a problem of two chains side by side, whose first modes veer apart where they are equally stiff.

    The measured modes are of one chain each and of one frequency, so that the best fit is on the jump.
    """
    n, coupling = 12, 0.002
    springs = sp.diags_array([[2.0] * (n - 1) + [1.0], [-1.0] * (n - 1), [-1.0] * (n - 1)], offsets=[0, 1, -1])
    first, second = sp.diags_array([1.0, 0.0]), sp.diags_array([0.0, 1.0])
    links = sp.kron([[1.0, -1.0], [-1.0, 1.0]], sp.diags_array(np.full(n, coupling)))
    stiffness = [Term(sp.kron(first, springs).tocsr(), (1, 0)), Term(sp.kron(second, springs).tocsr(), (0, 1))]
    dofs = [(100 * side + i, "x") for side in (1, 2) for i in range(n)]
    model = SeparableModel(
        [*stiffness, Term(links.tocsr(), (0, 0))], [Term(sp.eye_array(2 * n, format="csr"), (0, 0))], dofs
    )
    sensors = tuple((100 * side + i, "x") for side in (1, 2) for i in (3, 7, n - 1))
    shape = np.sin(np.pi * np.array([4, 8, 12]) / 25)
    middle = frequency_hz(np.array(0.0158 + coupling))  # of a chain by itself, and its links
    data = ModalData([middle, middle], sensors=sensors, shapes=np.kron(np.eye(2), shape).T, sd_hz=[0.0004, 0.0012])
    parameters = [Parameter(name, 1.0, 0.7, 1.3) for name in ("k1", "k2")]
    return UpdatingProblem.reduced(model, data, parameters, **options)


ON_THE_JUMP = np.concatenate([10.0 ** -np.arange(4.0, 16.0, 0.25), -(10.0 ** -np.arange(4.0, 16.0, 0.25))])
"""Differences k1 − k2 of the chains, within rounding of 0 among others."""


def test_training_ends_where_the_best_fit_is_on_a_jump_of_the_pairing(bases, monkeypatch):
    rounds, refined = [], Training.refine
    monkeypatch.setattr(
        Training, "refine", lambda self, theta, times: rounds.append(theta) or refined(self, theta, times)
    )
    problem = two_chains()
    structure = problem.model
    assert rounds == []
    # both models are right to rounding, and differ by the choice of the mode within rounding of the jump alone
    tried = plausible_points(problem, 64, np.random.default_rng(0))
    theta = np.concatenate([tried, np.stack([1.0 + ON_THE_JUMP / 2, 1.0 - ON_THE_JUMP / 2], axis=1)])
    full = frequency_hz(structure.truth.modes(theta).eigenvalues)
    exact = problem.likelihood.error.log_prob_terms(full).sum(axis=1)
    differ = np.abs(problem.log_likelihood(theta) - exact) > LOG_PROB_TOLERANCE
    assert differ.any()
    assert focus.on_a_jump(structure, theta[differ], FREQUENCY_TOLERANCE).all()
    assert not focus.on_a_jump(structure, theta[~differ], FREQUENCY_TOLERANCE).any()


def with_half_the_basis(structure):
    poor = structure.cheap.blocks[0]
    half = poor.basis[:, : poor.basis.shape[1] // 2]
    changed = ReducedBlock(structure.truth.blocks[0], half, poor.n_trained)
    trained = Trained((changed,), structure.pairing, np.full(2, 0.7), np.full(2, 1.3))
    return ReducedStructure(structure.truth, trained)


def test_a_reduced_model_without_the_modes_is_not_on_a_jump(bases):
    theta = np.array([[0.8, 1.2], [1.2, 0.8]])
    assert not focus.on_a_jump(with_half_the_basis(two_chains().model), theta, FREQUENCY_TOLERANCE).any()


def test_points_on_a_jump_are_right_for_a_large_structure_with_frfs_too(bases, monkeypatch):
    """Its log-probabilities are compared with those of the full model, which may pair other modes."""
    given, whole = [], focus.train
    monkeypatch.setattr(focus, "train", lambda *args: given.append(args) or whole(*args))
    point, lines, sd = ((111, "x"),), np.array([0.01, 0.02]), np.full((1, 2), 1e3)
    frfs = FRFData(lines, np.ones((1, 2)), point, point, "receptance", sd=sd)
    model = two_chains(error=[FRFErrors(frfs, ModalDamping(0.02)), FrequencyErrors()]).model
    monkeypatch.setattr(PairedStructure, "solver", "SuperLU")
    theta = np.stack([1.0 + ON_THE_JUMP / 2, 1.0 - ON_THE_JUMP / 2], axis=1)
    monkeypatch.setattr(focus, "plausible_points", lambda *_: theta)
    inaccurate_points = given[0][4]
    assert inaccurate_points(model) is None
    assert len(inaccurate_points(with_half_the_basis(model))[0])


def test_training_stalls_when_three_rounds_halve_nothing():
    assert not focus.has_stalled([8.0])
    assert not focus.has_stalled([8.0, 7.0, 6.0])
    assert not focus.has_stalled([8.0, 7.0, 6.0, 3.9])
    assert focus.has_stalled([8.0, 7.0, 6.0, 4.1])
    assert not focus.has_stalled([8.0, 4.0, 3.0, 3.0, 1.9])
    assert focus.has_stalled([1.0, np.inf, np.inf, np.inf])


def test_training_ends_where_no_basis_is_good_enough(bases, monkeypatch):
    """What the full model computes is off by more than is asked for, as by rounding."""
    rounds, refined = [], Training.refine
    monkeypatch.setattr(
        Training, "refine", lambda self, theta, times: rounds.append(theta) or refined(self, theta, times)
    )
    promise(monkeypatch, 1e-6, 1e-300)
    monkeypatch.setattr(focus, "on_a_jump", lambda structure, theta, *_: np.zeros(len(theta), dtype=bool))
    with pytest.warns(
        ReductionWarning, match=r"^reduction: with a basis of \d+ vectors .* log-probability is off"
    ):
        assert np.isfinite(two_chains().log_prob([1.0, 1.1]))
    assert 3 <= len(rounds) < 10


def test_the_reason_is_told_if_no_solve_succeeds_at_draws_from_the_prior(bases, monkeypatch):
    """M has couplings c of neighbours, and is positive definite only where all |c| < 1: not at one draw of 30."""
    n, couplings = 402, 10
    signs = sp.diags_array([np.ones(n), -np.ones(n - 1)], offsets=[0, -1])
    M = [Term(sp.eye_array(n), (0,) * couplings)]
    for j in range(couplings):
        pair = sp.coo_array((np.ones(2), ([2 * j, 2 * j + 1], [2 * j + 1, 2 * j])), shape=(n, n))
        M.append(Term(pair, tuple(int(i == j) for i in range(couplings))))
    model = SeparableModel([Term(signs.T @ signs, (0,) * couplings)], M)
    monkeypatch.setattr(  # no reduced model pays
        focus, "train", lambda structure, *_: (structure.kept_full(9), {"full": np.array(9.0)})
    )
    parameters = [Parameter(f"c{j}", 0.0, -4.0, 4.0) for j in range(couplings)]
    for _ in range(2):  # made, and read from the cache
        with pytest.warns(ReductionWarning, match=r"no reduced model .* no modes .* \(the mass matrix is not pos"):
            problem = UpdatingProblem.reduced(model, ModalData([1e-3]), parameters, pairing="index", beta=1.0)
        assert problem.model is problem.model.truth


@pytest.mark.parametrize("given", [0, 0.0, -1e-6, 0.02, 1, float("nan"), float("inf"), "1e-6", None])
def test_a_tolerance_is_a_number_up_to_a_hundredth(chain, given):
    with pytest.raises(ValueError, match=r"^reduction: must be true, false or .* at most 0\.01 \(got "):
        oscillators(chain, reduction=given)


def test_what_the_log_probability_may_be_off_follows_the_frequencies_up_to_a_tenth():
    assert Tolerance.of(True) == Tolerance.of(np.True_) == Tolerance.of(1e-6) == Tolerance(1e-6, 1e-3)
    assert Tolerance.of(False) is None
    assert Tolerance.of(1e-7).log_prob == pytest.approx(1e-4)
    assert Tolerance.of(np.float64(1e-5)).log_prob == pytest.approx(1e-2)
    assert Tolerance.of(1e-4).log_prob == pytest.approx(0.1)
    assert Tolerance.of(1e-2) == Tolerance(1e-2, 0.1)


def test_a_looser_tolerance_is_another_configuration_another_file_and_a_smaller_basis(
    load_case, bases, trainings, chain
):
    usual, loose = oscillators(chain), oscillators(chain, reduction=1e-4)
    assert "reduction" not in usual.configuration()
    assert loose.configuration() == usual.configuration() | {"reduction": 1e-4}
    assert oscillators(chain, reduction=1e-6).configuration() == usual.configuration()
    assert oscillators(chain, reduction=False).tolerance is None
    assert len(list(bases.iterdir())) == len(trainings) == 2
    young = load_case("cantilever-young", "shape")
    sizes, errors = [], []
    theta = young.sample_prior(np.random.default_rng(2), 100)
    exact = frequency_hz(young.model.truth.modes(theta).eigenvalues)
    for reduction in (1e-6, 1e-4, 1e-2):
        settings = {"beta": young.likelihood.beta, "reduction": reduction}
        problem = (
            young
            if reduction == 1e-6
            else UpdatingProblem.reduced(young.model.structure, young.data, young.parameters, **settings)
        )
        sizes.append(sum(b.size for b in problem.model.cheap.blocks if isinstance(b, ReducedBlock)))
        errors.append(np.max(np.abs(problem.frequencies(theta) / exact - 1.0)) / reduction)
        full = problem.likelihood.error.log_prob_terms(exact).sum(axis=1)
        near = full > full.max() - problem.tolerance.depth
        assert_allclose(
            problem.log_likelihood(theta)[near], full[near], rtol=0, atol=2 * problem.tolerance.log_prob
        )
    # of the log-probability 1e-4 and 1e-2 ask the same
    assert sizes[0] > max(sizes[1:])
    assert np.all(np.array(errors) < 2.0)


def test_what_training_did_not_reach_is_said_again_when_it_comes_from_the_cache(bases, monkeypatch, trainings):
    """As if more than eight vectors would not pay."""
    monkeypatch.setattr(training, "affordable", lambda n_dof: 8)
    monkeypatch.setattr(training, "DENSE_LIMIT", 10)
    words = r"^reduction: with a basis of 8 .*are off by up to \S+ \(asked for: 1e-06\).*reduction=0\.0"
    with pytest.warns(ReductionWarning, match=words) as said:
        first = cases.load("cantilever-young")
    with pytest.warns(ReductionWarning) as again:
        second = cases.load("cantilever-young")
    assert len(trainings) == 1
    assert str(again[0].message) == str(said[0].message)
    theta = first.sample_prior(np.random.default_rng(0), 50)
    assert_array_equal(second.log_prob(theta), first.log_prob(theta))
    reached = float(str(said[0].message).split("by up to ")[1].split()[0])
    error = np.max(
        np.abs(first.frequencies(theta) / frequency_hz(first.model.truth.modes(theta).eigenvalues) - 1.0)
    )
    assert 0.1 * reached < error < 3.0 * reached
