import numpy as np
import pytest

from fmu.samplers import Independence, LogNormalWalk, MetropolisHastings, RandomWalk, run
from tests.samplers.moments import assert_right
from tests.samplers.targets import CorrelatedGaussian, Counting, Target, TruncatedGaussian


class Gamma(Target):
    """Independent Gamma(k) variables: positive and skewed."""

    def __init__(self):
        super().__init__(2, lower=[0.0, 0.0])
        self.shape = np.array([2.0, 5.0])
        self.mean, self.covariance = self.shape, np.diag(self.shape)

    def value_and_slope(self, x):
        return np.sum((self.shape - 1) * np.log(x) - x, axis=1), (self.shape - 1) / x - 1


def points(n, seed=0):
    return 0.5 + np.random.default_rng(seed).random((n, 2))


class TestProposals:
    def test_log_normal_walk_knows_its_density(self):
        from scipy.stats import lognorm

        proposal = LogNormalWalk(scale=(0.3, 0.7), origin=-0.25)
        x, y = points(5, 0) + 0.25, points(5, 1) + 0.25
        forth, back = (lognorm.logpdf(b, s=proposal.scale, scale=a).sum(axis=1) for a, b in ((x, y), (y, x)))
        np.testing.assert_allclose(proposal.log_ratio(y - 0.25, x - 0.25), back - forth, rtol=1e-10)

    def test_independence_knows_its_density(self):
        from scipy.stats import multivariate_normal

        covariance = np.array([[2.0, -0.7], [-0.7, 1.0]])
        proposal = Independence(mean=[1.0, 2.0], covariance=covariance)
        x, y = points(5, 0), points(5, 1)
        density = multivariate_normal([1.0, 2.0], covariance)
        np.testing.assert_allclose(proposal.log_ratio(y, x), density.logpdf(x) - density.logpdf(y), rtol=1e-10)

    def test_random_walk_is_symmetric(self):
        assert np.all(RandomWalk(0.4).log_ratio(points(4, 0), points(4, 1)) == 0)

    @pytest.mark.parametrize(
        ("proposal", "mean", "covariance"),
        [
            (RandomWalk(0.5), [3.0, 4.0], [[0.25, 0.0], [0.0, 0.25]]),
            (RandomWalk([0.5, 2.0]), [3.0, 4.0], [[0.25, 0.0], [0.0, 4.0]]),
            (RandomWalk([[1.0, 0.9], [0.9, 2.0]]), [3.0, 4.0], [[1.0, 0.9], [0.9, 2.0]]),
            (Independence([1.0, 2.0], [[1.0, 0.9], [0.9, 2.0]]), [1.0, 2.0], [[1.0, 0.9], [0.9, 2.0]]),
        ],
        ids=["number", "vector", "matrix", "independence"],
    )
    def test_samples_have_the_stated_moments(self, proposal, mean, covariance):
        n = 200_000
        x = proposal.sample(np.random.default_rng(1), np.tile([3.0, 4.0], (n, 1)))
        spread = np.sqrt(np.diag(covariance) / n)
        assert np.all(np.abs(x.mean(axis=0) - mean) < 5 * spread)
        np.testing.assert_allclose(np.cov(x.T), covariance, atol=5 * np.max(covariance) * np.sqrt(2 / n))


@pytest.mark.parametrize(
    ("target", "proposal"),
    [
        (Gamma(), LogNormalWalk(0.8)),
        (TruncatedGaussian(), Independence([0.5, 0.2], [[0.15, 0.02], [0.02, 0.04]])),
    ],
    ids=["log-normal walk", "independence"],
)
def test_asymmetric_proposals_need_the_hastings_ratio(target, proposal):
    """The same run without the ratio is wrong by many MCSE: this is what the ratio is for."""
    settings = {"draws": 200, "warmup": 60, "chains": 480, "seed": 17, "init": "prior"}
    assert_right(target, run(target, MetropolisHastings(proposal), **settings))

    class WithoutRatio:
        sample = staticmethod(proposal.sample)

        def log_ratio(self, candidate, position):
            return np.zeros(len(position))

    with pytest.raises(AssertionError, match="errors in MCSE"):
        assert_right(target, run(target, MetropolisHastings(WithoutRatio()), **settings))


def test_a_candidate_outside_the_box_is_rejected_at_no_cost():
    density = Counting(TruncatedGaussian())
    start = np.tile(density.target.mean, (4, 1))
    sampler = MetropolisHastings(RandomWalk(1000.0))
    result = run(density, sampler, draws=50, warmup=0, chains=4, seed=1, init=start)
    assert not result.posterior.stats["accepted"].any()
    assert np.all(result.posterior.stats["acceptance_rate"] == 0)
    assert density.n_solves == 4  # the start


def test_the_acceptance_rate_is_the_probability_of_acceptance():
    target = CorrelatedGaussian()
    sampler = MetropolisHastings(RandomWalk(0.9))
    stats = run(target, sampler, draws=1000, warmup=50, chains=64, seed=2, init="prior").posterior.stats
    rate, accepted = stats["acceptance_rate"], stats["accepted"]
    # Accepted minus its probability is white noise whose variance is known.
    error = (accepted - rate).sum() / np.sqrt((rate * (1 - rate)).sum())
    assert 0.1 < rate.mean() < 0.9
    assert abs(error) < 5


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: RandomWalk(0.0), r"scale: must be positive \(got 0.0\)"),
        (lambda: RandomWalk([0.1, -1.0]), "scale: must be positive"),
        (lambda: RandomWalk(np.nan), "scale: must be finite"),
        (lambda: RandomWalk("wide"), "scale: must be numbers"),
        (lambda: RandomWalk([[1.0, 2.0], [2.0, 1.0]]), "scale: must be a symmetric positive definite"),
        (lambda: RandomWalk([[1.0, 0.2], [0.1, 1.0]]), "scale: must be a symmetric positive definite"),
        (lambda: LogNormalWalk([[1.0]]), r"scale: must be a number or a vector \(got shape \(1, 1\)\)"),
        (lambda: LogNormalWalk(0.1, origin=[np.inf, 0]), "origin: must be a vector of finite numbers"),
        (lambda: LogNormalWalk(0.1, origin=np.nan), r"origin: must be finite \(got nan\)"),
        (lambda: LogNormalWalk(0.1, origin=-np.inf), r"origin: must be finite \(got -inf\)"),
        (lambda: Independence([0.0, 0.0], [[1.0]]), "covariance: must have length 2"),
        (lambda: Independence(0.0, [[1.0]]), "mean: must be a vector"),
    ],
)
def test_bad_settings(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize(
    ("proposal", "message"),
    [
        (RandomWalk([0.1, 0.1, 0.1]), r"scale: must have length 2, one entry per coordinate \(got 3\)"),
        (LogNormalWalk(0.1, origin=2.0), "origin: must be below every position"),
    ],
)
def test_settings_that_do_not_fit_the_density(proposal, message):
    target = TruncatedGaussian()
    with pytest.raises(ValueError, match=message):
        run(target, MetropolisHastings(proposal), draws=1, warmup=0, chains=1, seed=1, init="start")


def test_settings_compare_by_value():
    matrix = np.array([[1.0, 0.5], [0.5, 1.0]])
    assert RandomWalk(matrix) == RandomWalk(matrix.tolist())
    assert hash(RandomWalk(matrix)) == hash(RandomWalk(matrix.copy()))
    assert RandomWalk(matrix) != RandomWalk(2 * matrix)
