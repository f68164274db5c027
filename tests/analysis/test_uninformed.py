"""What the data leave to the prior is named, and nothing else is: against models whose posterior is known."""

from types import SimpleNamespace

import numpy as np
import pytest

import fmu
from fmu.analysis.convergence.diagnosis import judge
from fmu.analysis.identifiability import Identifiability, identifiability, with_identifiability
from fmu.analysis.information import (
    COMBINED,
    DATA,
    PRIOR,
    _entropy_sd,
    compared_with_draws,
    information,
    left_along,
    separation_in_words,
)
from fmu.analysis.start.check import check
from fmu.analysis.trace.conversion import to_trace
from fmu.analysis.uninformed import doubts, hardest_pair, left_to_prior
from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.errors.frequency import FrequencyErrors
from fmu.posterior.parameters import Parameter
from fmu.posterior.priors.base import Normal, Uniform
from fmu.posterior.priors.one_sided import LogNormal
from fmu.posterior.problem import UpdatingProblem
from tests.linear import LinearModel


class Storeys:
    """f_i = a_i √(k/(m + b_i M)): a stiffness and a mass that scale the model, and a known mass M added to it."""

    n_parameters, n_modes = 2, 3

    def __init__(self, known_mass):
        self.known = known_mass * np.array([0.5, 0.3, 0.1])

    def frequencies(self, theta):
        return np.array([2.0, 5.0, 8.0]) * np.sqrt(theta[:, :1] / (theta[:, 1:2] + self.known))

    def frequencies_and_gradient(self, theta):
        f = self.frequencies(theta)
        return f, np.stack([0.5 * f / theta[:, :1], -0.5 * f / (theta[:, 1:2] + self.known)], axis=-1)


PRIORS = {
    "normal": (Normal(0.3, mean=1.0), 0.2, 4.0),
    "truncated": (Normal(0.8, mean=1.0), 0.8, 1.4),
    "log-normal": (LogNormal(1.0, 0.6), 0.0, np.inf),
    "uniform": (Uniform(), 0.5, 1.5),
}


def test_the_ratio_of_entropies_of_one_shape_is_that_of_the_standard_deviations():
    x = np.random.default_rng(1).standard_normal((2, 20_000))
    assert _entropy_sd(0.5 * x[0], x[1]) == pytest.approx(0.5, rel=0.03)


def chain(prior="normal", known_mass=0.0, sd=0.01, error=None):
    distribution, lower, upper = PRIORS[prior]
    model = Storeys(known_mass)
    measured = model.frequencies(np.array([[1.1, 1.0]]))[0]
    parameters = [Parameter(name, 1.0, lower, upper, distribution) for name in ("k", "m")]
    data = ModalData(measured, sd_hz=sd * measured)
    settings = {} if error is None else {"error": error}
    return UpdatingProblem.reduced(model, data, parameters, **settings)


@pytest.fixture
def posterior(make_result):
    """Return a function that draws from a posterior by weighting draws from the prior: exact, and independent."""

    def drawn(problem, seed=1, n=1600, pool=200_000):
        rng = np.random.default_rng(seed)
        theta = problem.sample_prior(rng, pool)
        weight = problem.log_likelihood(theta)
        weight = np.exp(weight - weight.max())
        assert weight.sum() ** 2 / np.sum(weight**2) > 500
        picked = rng.choice(pool, n, p=weight / weight.sum())
        trace = to_trace(make_result(theta[picked].reshape(4, -1, problem.ndim)), problem)
        return with_identifiability(trace, problem)

    return drawn


@pytest.mark.parametrize("prior", PRIORS)
def test_stiffness_and_mass_that_only_their_ratio_is_told_of(prior, posterior):
    problem = chain(prior)
    (found,) = check(problem, draws=20).doubts
    assert found.startswith("The measurement cannot separate k and m: it determines only k/m.")
    assert "100 % of the prior standard deviation" in found
    trace = posterior(problem)
    told = information(trace)
    assert told.basis == (COMBINED, COMBINED)
    assert any(w.startswith("k and m were not updated individually: the data determine only k/m") for w in
               judge(trace).warnings)  # fmt: skip


@pytest.mark.parametrize("prior", PRIORS)
def test_a_known_mass_silences_it(prior, posterior):
    problem = chain(prior, known_mass=4.0)
    assert check(problem, draws=20).verdict() == "No warnings."
    told = information(posterior(problem))
    assert told.basis == (DATA, DATA)
    assert told.uninformed == ()
    assert told.warnings() == []


@pytest.mark.parametrize(("known_mass", "separated"), [(0.0, False), (1.0, True)])
def test_columns_of_one_pattern_are_separated_by_their_difference(known_mass, separated, posterior):
    """The cosine is above 0.95 in both cases, and only one pair cannot be separated."""
    problem = chain(known_mass=known_mass)
    linearised = identifiability(problem)
    one, other = linearised.sensitivity.T
    assert abs(one @ other) / np.linalg.norm(one) / np.linalg.norm(other) > 0.95
    pair = hardest_pair(linearised, linearised.covariance)
    exact = np.linalg.inv(np.eye(2) + linearised.sensitivity.T @ linearised.sensitivity)
    assert pair.remaining_sd == pytest.approx(np.sqrt(np.linalg.eigvalsh(exact)[-1]), rel=1e-9)
    assert pair.change == pytest.approx(np.linalg.svd(linearised.sensitivity)[1][-1], rel=1e-6, abs=1e-9)
    said = separation_in_words(posterior(problem), linearised)
    assert said.startswith("Hardest to separate: k and m." if separated else "The data cannot separate k and m.")
    assert (information(posterior(problem)).uninformed == ()) == separated


def test_a_parameter_without_information_is_not_confused_with_another():
    S = np.array([[30.0, 0.0, 0.1], [0.0, 5.0, 0.0]])
    found = Identifiability(("a", "b", "c"), ("",) * 3, ("1", "2"), np.ones(3), np.ones(3), S)
    assert hardest_pair(found, found.covariance) is None


@pytest.mark.parametrize("seed", range(5))
def test_errors_so_large_that_nothing_is_told(seed, posterior):
    told = information(posterior(chain("log-normal", known_mass=4.0, sd=100.0), seed))
    assert told.basis == (PRIOR, PRIOR)
    assert len(told.warnings()) == 2


def test_noise_that_the_data_do_not_tell(posterior):
    """Of an sd inferred from three frequencies the prior says more; from its own prior alone, all."""
    noise = Parameter("noise", 0.02, 0.0, prior=LogNormal(0.02, 0.05))
    tight = chain(known_mass=4.0, error=FrequencyErrors("relative", noise))
    told = information(posterior(tight))
    assert told.basis == (DATA, DATA, PRIOR)
    assert told.warnings()[0].startswith("noise was not updated by the data: ")
    wide = Parameter("noise", 0.1, 0.03, 1.0, prior=Uniform())
    assert information(posterior(chain(known_mass=4.0, error=FrequencyErrors("relative", wide)))).basis[2] == DATA


def test_a_wide_spread_over_two_maxima_is_no_lack_of_information(make_result, problem):
    """Two narrow peaks at ∓1.2 prior standard deviations: wider than the prior, and yet only the sign is open."""
    rng = np.random.default_rng(2)
    draws = rng.normal(size=(4, 500, 2)) * [0.05, 0.1]
    draws[..., 0] += rng.choice([-1.2, 1.2], (4, 500))
    told = information(to_trace(make_result(draws), problem))
    assert told.contraction[0] < 0.0
    assert told.informed.all()
    assert told.uninformed == ()


def test_marginals_that_keep_the_prior_while_a_combination_is_known(make_result, problem):
    """Draws of two parameters that are tied to each other, each with its whole prior."""
    rng = np.random.default_rng(3)
    z = rng.normal(size=(4, 500, 1))
    draws = np.concatenate([z, 2.0 * z], axis=-1) + 0.01 * rng.normal(size=(4, 500, 2))
    told = information(to_trace(make_result(np.clip(draws, -4, 4)), problem))
    assert told.contraction.max() < 0.2
    assert not told.informed.any()
    assert told.basis == (COMBINED, COMBINED)
    (warning,) = told.warnings()
    assert warning.startswith("the combination 0.7")
    assert " + 0.7" in warning


def test_parameters_that_no_mode_depends_on_come_first_and_combinations_are_few():
    S = np.zeros((3, 5))
    S[0, :2] = [5.0, -5.0]
    S[1, 2:4] = [7.0, 3.5]
    found = Identifiability(tuple("abcde"), ("",) * 5, ("1", "2", "3"), np.ones(5), np.full(5, 0.5), S)
    left = left_to_prior(found)
    assert [one.words for one in left] == ["e", "0.89 d − 0.45 c", "0.71 a + 0.71 b"]
    assert [one.told for one in left] == ["", "", "a/b"]
    assert doubts(found)[0].startswith("The measurement carries no information on e: 100")
    for one in left:
        assert np.linalg.norm(S @ one.direction) < 1e-12
    told = Identifiability(*(getattr(found, k) for k in ("names", "units", "labels", "theta", "prior_sd")),
                           np.eye(5) * 0.33)  # fmt: skip
    assert left_to_prior(told) == []  # 0.33 prior standard deviations' worth: less than 95 % is left


@pytest.mark.parametrize("slopes", [np.full(40, 0.2), np.linspace(0.51, 0.01, 40)], ids=["equal", "falling"])
def test_parameters_that_are_weak_alone_and_strong_together_are_not_all_uninformed(slopes):
    """One of 40 directions is informed: 39 are left, all of them together, in few sentences."""
    n = len(slopes)
    names = tuple(f"k{j}" for j in range(1, n + 1))
    found = Identifiability(names, ("",) * n, ("1",), np.ones(n), np.ones(n), slopes[None])
    assert np.sum(found.singular_values > 1.0) == 1
    left = left_to_prior(found)
    basis = np.linalg.qr(np.array([one.direction for one in left]).T)[0]
    assert basis.shape == (40, 39)
    most = np.sqrt(0.95**-2 - 1.0)  # of a direction of which 95 % is left
    assert np.linalg.norm(slopes @ basis) <= 1.5 * most
    said = doubts(found)
    alone = {one.words for one in left if len(one.names) == 1}
    assert len(said) == 1 + bool(alone)
    together = n - len(alone)
    assert f"determines at most 1 combination of these {together}" in said[-1]
    assert all(slopes[names.index(one)] < 0.5 * most for one in alone)


def test_many_parameters_without_any_information_share_a_sentence():
    S = np.append(np.zeros(5), 3.0)[None]
    found = Identifiability(tuple("abcdef"), ("",) * 6, ("1",), np.ones(6), np.ones(6), S)
    (said,) = doubts(found)
    assert said.startswith(
        "The measurement carries no information on a, b, c, d and e: 100 % of the prior standard deviation"
    )


def test_a_common_factor_leaves_the_ratios():
    S = np.array([[2.0, 3.0, -5.0], [1.0, -2.0, 1.0]])
    found = Identifiability(tuple("abc"), ("",) * 3, ("1", "2"), np.ones(3), np.ones(3), S)
    assert [one.told for one in left_to_prior(found)] == ["the ratios of a, b and c"]


@pytest.mark.parametrize("case", ["cantilever-section", "shear-2dof"])
def test_shipped_cases_that_are_told_in_every_direction(case):
    assert doubts(identifiability(fmu.cases.load(case))) == []


def test_an_identifiable_problem_says_nothing(problem, posterior):
    assert doubts(identifiability(problem)) == []
    exact = information(posterior(problem, n=400))
    assert exact.warnings() == []


def wide(prior=None):
    """Two parameters of which the frequencies of the tests of `to_trace` are to be ignored."""
    prior = prior or Normal(1.0)
    parameters = [
        Parameter(name, 1.0 if isinstance(prior, LogNormal) else 0.0, prior=prior) for name in ("a", "b")
    ]
    return UpdatingProblem(LinearModel(), ModalData([101.0, 99.5, 102.0]), parameters)


@pytest.mark.parametrize(("sd", "informed"), [(0.5, True), (0.8, True), (0.88, False), (1.0, False)])
def test_contraction_turns_at_three_tenths(sd, informed, make_result):
    """√0.7 = 0.837 of the prior's standard deviation."""
    draws = np.random.default_rng(3).normal(size=(4, 2000, 2)) * [sd, 0.1]
    told = information(to_trace(make_result(draws), wide()))
    assert told.contraction == pytest.approx([1 - sd**2, 0.99], abs=0.08)
    assert list(told.informed) == [informed, True]
    assert told.basis == (DATA if informed else PRIOR, DATA)
    assert told.n_informed == 1 + informed
    assert told.table()["informed"]["a"] == informed
    assert ("a was not updated by the data" in str(told)) == (not informed)


def test_contraction_of_a_log_normal_prior_is_that_of_the_logarithm(make_result):
    """Half of its width, but at six times the median: the variance itself is larger than the prior's."""
    draws = np.exp(np.random.default_rng(4).normal(size=(4, 2000, 2)) * 0.5 + [np.log(6.0), 0.0])
    trace = to_trace(make_result(draws), wide(LogNormal(1.0, 1.0)))
    told = information(trace)
    assert told.of_logarithm == (True, True)
    assert told.contraction == pytest.approx([0.75, 0.75], abs=0.05)
    assert draws[..., 0].var() > float(trace["prior"]["a"].var())


def test_a_parameter_at_its_bound_is_informed_as_much_as_its_variance_says(make_result, problem):
    """Within the last hundredth of the range of a flat prior; normal scores would leave 35 % of the sd there."""
    parameters = [Parameter(name, 0.5, 0.0, 1.0) for name in ("a", "b")]
    flat = UpdatingProblem(LinearModel(), problem.data, parameters)
    draws = np.random.default_rng(5).uniform(0.99, 1.0, size=(4, 500, 2))
    assert information(to_trace(make_result(draws), flat)).contraction.min() > 0.999


def linear_draws(problem, rng, lower=-np.inf):
    """Exact draws of a linear model with normal priors, those above `lower` alone."""
    one = identifiability(problem)
    precision = np.diag(one.prior_sd**-2.0) + one.fisher_information
    draws = rng.multivariate_normal([0.0, 0.0], np.linalg.inv(precision), size=400_000)
    return draws[(draws > lower).all(axis=1)][:8000].reshape(4, -1, 2)


def test_draws_and_a_linearised_model_agree_where_the_model_is_linear(make_result):
    problem = wide()
    trace = to_trace(make_result(linear_draws(problem, np.random.default_rng(6))), problem)
    one = identifiability(problem)
    np.testing.assert_allclose(left_along(trace, one), 1 / np.hypot(1, one.singular_values), rtol=0.08)
    (said,) = compared_with_draws(trace, one, "the start", 1, converged=True)
    assert said.startswith("The model linearised at the start agrees with the draws")


def test_a_linearised_model_may_lack_parameters_of_the_draws(make_result):
    problem = wide()
    trace = to_trace(make_result(linear_draws(problem, np.random.default_rng(6))), problem)
    every = identifiability(problem)
    last = SimpleNamespace(names=every.names[1:], prior_sd=every.prior_sd[1:], directions=np.eye(1))
    drawn, prior = (float(trace[group][every.names[1]].std()) for group in ("posterior", "prior"))
    np.testing.assert_allclose(left_along(trace, last), [drawn / prior], rtol=1e-12)


def weak():
    """Bounds at 0 and 4, errors so large that the prior remains but for the bounds."""
    parameters = [Parameter(name, 1.0, 0.0, 4.0, Normal(2.0)) for name in ("a", "b")]
    return UpdatingProblem(LinearModel(), ModalData([101.0, 99.5, 102.0], sd_hz=3.0), parameters)


@pytest.mark.parametrize(
    ("at_bound", "maxima", "converged", "words"),
    [
        (True, 1, True, "of the draws of a lie at its lower bound"),
        (True, 1, False, "Neither is to be relied on before the draws have converged."),
        (True, 2, True, "and the posterior has 2 maxima, of which a linearised model sees one."),
        (False, 1, True, "frequencies are not linear in the parameters, or priors not normal"),
    ],
)  # fmt: skip
def test_why_draws_and_a_linearised_model_differ(at_bound, maxima, converged, words, make_result):
    problem, rng = weak(), np.random.default_rng(7)
    size = (4, 500, 2)
    position = rng.exponential(0.04, size=size) if at_bound else 2.0 + 0.02 * rng.normal(size=size)
    trace = to_trace(make_result(position), problem)
    first, second = compared_with_draws(trace, identifiability(problem), "the start", maxima, converged)
    assert first.startswith("The model linearised at the start differs from the draws: along ")
    assert words in second
    assert ("at its lower bound" in second) == (at_bound and converged)


def test_nothing_can_be_said_without_a_prior(make_trace):
    assert information(make_trace(np.zeros((2, 5, 2)))) is None


def test_scores_that_no_table_shows_are_not_told_to_be_left_to_the_prior(make_result):
    """The page judges without the scores of 40 tests; so do the notes of the verdict."""
    model = fmu.SeparableModel.from_terms(["k"], [(np.eye(1), "k")], [np.eye(1)])
    tests = [fmu.Test(f"t{i}", ModalData([0.159], sd_hz=0.01)) for i in range(40)]
    problem = fmu.JointProblem(model, tests, [Parameter("k", 1.0, 0.2, 3.0)], varies={"k": fmu.Population()})
    rng = np.random.default_rng(8)
    draws = rng.standard_normal((4, 300, problem.ndim))  # all scores as in their prior
    draws[..., :2] = np.array([1.0, 0.05]) + 0.01 * draws[..., :2]
    trace = to_trace(make_result(draws), problem)
    assert information(trace).not_informed
    assert [said for said in judge(trace).warnings if "was not updated" in said] == []
