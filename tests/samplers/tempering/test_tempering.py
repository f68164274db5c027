"""Parallel tempering: right posteriors and evidences, modes far apart, honest accounts."""

from functools import cache

import numpy as np
import pytest
from scipy import stats

import fmu
from fmu.analysis.convergence import effective
from fmu.analysis.evidence import evidence
from fmu.analysis.maxima.missed import missed_maxima
from fmu.analysis.trace.conversion import to_trace
from fmu.posterior.scaled import ScaledDensity
from fmu.samplers import run
from fmu.samplers.tempering.density import PriorAndLikelihood, TemperedTarget
from fmu.samplers.tempering.kernel import LOG_LIKELIHOOD, replicas_of, side_by_side
from fmu.samplers.tempering.tempering import Tempering, adapt_ladder, rejections, stages
from tests.samplers.moments import assert_right
from tests.samplers.targets import BoundedBeta, CorrelatedGaussian, TruncatedGaussian
from tests.samplers.tempered_targets import Failing, FarModes, InBox, LinearGaussian

KERNELS = {
    "slice": "slice",
    "slice-coordinate": fmu.Slice("coordinate"),
    "slice-given-up": fmu.Slice("coordinate", width=0.5, max_shrinks=1),
    "mh": "mh",
    "mh-fixed": fmu.MetropolisHastings(fmu.RandomWalk(0.1)),
    "hmc": "hmc",
    "hmc-fixed": fmu.HamiltonianMonteCarlo(0.05, 4),
}


def assert_evidence(target, result, below=0.1):
    trace = to_trace(result, target)
    for method in ("stepping-stone", "thermodynamic"):
        found = evidence(trace, method)
        assert found.error < below
        assert abs(found.log_evidence - target.log_evidence) < 4 * found.error


@pytest.mark.parametrize(
    "kernel", ["mh", *(pytest.param(kernel, marks=pytest.mark.validate) for kernel in ("slice", "hmc"))]
)
def test_a_linear_gaussian_problem(kernel):
    target = LinearGaussian()
    settings = Tempering(kernel, rungs=10)
    result = run(
        target, settings, draws=150 if kernel == "mh" else 100, warmup=100, chains=64, seed=4, init="prior"
    )
    assert_right(target, result)
    assert_evidence(target, result)


@pytest.mark.parametrize(("kind", "kernel"), [(TruncatedGaussian, "hmc"), (BoundedBeta, "slice")])
def test_bounded_skewed_and_correlated(kind, kernel):
    target = InBox(kind())
    result = run(target, Tempering(kernel, rungs=6), draws=80, warmup=80, chains=48, seed=7, init="prior")
    assert_right(target, result)
    assert_evidence(target, result)


def test_rarer_swaps_do_not_matter_to_the_posterior():
    target = LinearGaussian()
    settings = Tempering(temperatures=np.linspace(0, 1, 6) ** 5, swap_every=2)
    assert_right(target, run(target, settings, draws=75, warmup=40, chains=128, seed=2, init="prior"))


def test_modes_far_apart_get_their_weights():
    """Slice sampling alone stays where it starts."""
    target = FarModes()
    start = np.repeat(target.centres[1:], 16, axis=0)
    stuck = run(target, fmu.Slice(), draws=50, warmup=50, chains=16, seed=1, init=start)
    assert np.all(stuck.posterior.position[..., 0] > 0)
    start = np.repeat(target.centres[1:], 32, axis=0)
    result = run(target, Tempering(), draws=160, warmup=120, chains=32, seed=1, init=start)
    in_first = (result.posterior.position[..., 0] < 0).astype(float)
    error = effective.mcse_mean(in_first)
    assert error < 0.06
    assert abs(in_first.mean() - 0.7) < 5 * error
    assert_evidence(target, result, below=0.15)
    assert result.posterior.stats["round_trips"].sum() > 100


def exact_replicas(t, n, rng):
    """Draws from N(0, 1/(1 + 8 t)), likelihood exp(−4 x²) to the power t under a standard normal prior."""
    x = rng.standard_normal((len(t), n)) / np.sqrt(1 + 8 * t[:, None])
    return x, -4 * x**2


@pytest.mark.parametrize("first", [0, 1], ids=["even", "odd"])
def test_swaps_leave_the_joint_distribution_invariant(first):
    rng = np.random.default_rng(first)
    t, n = np.array([0.0, 0.1, 0.4, 1.0]), 40_000
    kernel = Tempering(temperatures=t).bind(LinearGaussian())
    x, log_likelihood = exact_replicas(t, n, rng)
    order = kernel._order_after_swaps(rng, log_likelihood, first)
    np.testing.assert_array_equal(np.sort(order, axis=0), np.repeat(np.arange(4)[:, None], n, axis=1))
    swapped = x[order, np.arange(n)]
    variance = 1 / (1 + 8 * t)
    assert np.all(np.abs(np.mean(swapped**2, axis=1) / variance - 1) < 5 * np.sqrt(2 / n))
    for k in range(4):
        assert stats.kstest(swapped[k] / np.sqrt(variance[k]), "norm").pvalue > 1e-4
    # independent of each other afterwards, too
    assert np.all(np.abs(np.corrcoef(swapped**2)[np.triu_indices(4, 1)]) < 5 / np.sqrt(n))
    refused = np.mean(order == np.arange(4)[:, None], axis=1)[[k for k in range(3) if k % 2 == first]]
    expected = rejections(log_likelihood.T, t)[first::2]
    np.testing.assert_allclose(refused, expected, atol=5 * 0.5 / np.sqrt(n))


@pytest.mark.parametrize("kernel", ["slice", "hmc"])
def test_the_rungs_sample_the_tempered_densities(kernel):
    """The lowest the prior itself, and one between the Gaussian that prior · likelihood^t is."""
    target, rng = LinearGaussian(), np.random.default_rng(3)
    t = np.array([0.0, 0.001, 0.02, 0.2, 1.0])
    fixed = {"slice": fmu.Slice(width=4.0), "hmc": fmu.HamiltonianMonteCarlo(0.08, 6)}[kernel]
    tempering = Tempering(fixed, temperatures=t).bind(target)
    state, _ = tempering.init(target.sample_prior(rng, 400))
    kept = []
    for step in range(60):
        state, _ = tempering.step(rng, state)
        if step >= 29 and step % 10 == 9:
            kept.append(replicas_of(state).position)
    for k in (0, 1, 2):
        precision = np.eye(3) / target.sd**2 + t[k] * target.matrix.T @ target.matrix / target.noise**2
        covariance = np.linalg.inv(precision)
        mean = t[k] * covariance @ target.matrix.T @ target.data / target.noise**2
        x = np.concatenate([position[k] for position in kept])
        z = (x - mean) @ np.linalg.inv(np.linalg.cholesky(covariance)).T
        for i in range(3):
            assert stats.kstest(z[:, i], "norm").pvalue > 1e-4


@cache
def counted(name):
    """A short run, its target, and how many solves and gradients that was asked for."""
    target = InBox(TruncatedGaussian())
    result = run(target, Tempering(KERNELS[name]), draws=6, warmup=44, chains=3, seed=5, init="prior")
    return target, result, (target.n_solves, target.n_gradients)


@pytest.mark.parametrize("name", KERNELS)
class TestAccounts:
    def test_solves_of_all_rungs_are_counted(self, name):
        _, result, spent = counted(name)
        parts = (result.warmup, result.posterior)
        told = tuple(sum(int(part.stats[key].sum()) for part in parts) for key in ("n_solves", "n_gradients"))
        assert told == spent

    def test_log_prob_belongs_to_the_position(self, name):
        target, result, _ = counted(name)
        for part in (result.warmup, result.posterior):
            theta = part.position.reshape(-1, 2)
            np.testing.assert_allclose(part.stats["lp"].ravel(), target.log_prob(theta), rtol=1e-12)
            moved = np.any(np.diff(part.position, axis=1) != 0, axis=-1)
            np.testing.assert_array_equal(part.stats["accepted"][:, 1:], moved)
        likelihood = target.log_likelihood(result.posterior.position.reshape(-1, 2))
        np.testing.assert_allclose(result.posterior.stats[LOG_LIKELIHOOD][..., -1].ravel(), likelihood, rtol=1e-9)

    def test_what_is_remembered_of_every_replica_is_true(self, name):
        target, rng = LinearGaussian(), np.random.default_rng(8)
        kernel = Tempering(KERNELS[name], rungs=5).bind(ScaledDensity(target))
        state, _ = kernel.init(rng.standard_normal((4, 3)))
        for _ in range(30):
            state, _ = kernel.step(rng, state)
        replicas = replicas_of(state)
        theta = target.offset + target.scale * replicas.position.reshape(-1, 3)
        (prior, prior_slope), (likelihood, slope) = target.prior(theta), target.likelihood(theta)
        np.testing.assert_allclose(replicas.log_prior.ravel(), prior, rtol=1e-12)
        np.testing.assert_allclose(replicas.log_likelihood.ravel(), likelihood, rtol=1e-9)
        if replicas.likelihood_gradient is not None:
            prior_slope, slope = prior_slope * target.scale, slope * target.scale
            np.testing.assert_allclose(replicas.prior_gradient.reshape(-1, 3), prior_slope, rtol=1e-12)
            np.testing.assert_allclose(replicas.likelihood_gradient.reshape(-1, 3), slope, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    "kernel", ["slice", *(pytest.param(kernel, marks=pytest.mark.validate) for kernel in ("mh", "hmc"))]
)
def test_the_seed_alone_decides(kernel):
    target = InBox(TruncatedGaussian())
    settings = {"draws": 3, "warmup": 40, "chains": 2, "init": "prior"}
    first, again = (run(target, Tempering(kernel), seed=3, **settings) for _ in range(2))
    other = run(target, Tempering(kernel), seed=4, **settings)
    assert first.learnt == again.learnt
    for key, value in first.posterior.stats.items():
        np.testing.assert_array_equal(value, again.posterior.stats[key])
    np.testing.assert_array_equal(first.posterior.position, again.posterior.position)
    assert not np.array_equal(first.posterior.position, other.posterior.position)


def test_one_evaluation_a_replica_and_step():
    target = LinearGaussian()
    settings = Tempering(fmu.MetropolisHastings(fmu.RandomWalk(0.1)), rungs=6)
    result = run(target, settings, draws=20, warmup=0, chains=3, seed=1, init="prior")
    solves = result.posterior.stats["n_solves"]
    np.testing.assert_array_equal(solves[:, 0], 6 + 1)  # the start is booked on the first step
    np.testing.assert_array_equal(solves[:, 1:], 6)


def test_a_run_can_be_carried_on_and_its_settings_used_again():
    target = LinearGaussian()
    begun = fmu.samplers.Run(target, Tempering("hmc"), warmup=41, chains=2, seed=1, init="prior")
    begun.extend(4)
    whole = run(target, Tempering("hmc"), draws=8, warmup=41, chains=2, seed=1, init="prior")
    np.testing.assert_array_equal(begun.extend(4).posterior.position, whole.posterior.position)
    assert len(whole.learnt["kernel"]) == len(whole.learnt["temperatures"]) - 1 == whole.learnt["rungs"] - 1
    assert len({settings["step_size"] for settings in whole.learnt["kernel"]}) > 1


def test_the_ladder_is_learnt_until_all_swaps_are_refused_alike():
    target = LinearGaussian()
    result = run(target, Tempering(), draws=60, warmup=160, chains=40, seed=1, init="prior")
    t = np.array(result.learnt["temperatures"])
    refused = rejections(result.posterior.stats[LOG_LIKELIHOOD], t).mean(axis=0)
    assert np.ptp(refused) < 0.12
    assert len(t) == pytest.approx(2 * refused.sum() + 1, abs=2)


def test_stages_double_and_fill_the_warm_up():
    assert stages(1000) == [31, 31, 63, 125, 250, 500]
    for steps in (0, 1, 39, 40, 97, 1000):
        assert sum(stages(steps)) == steps


def test_a_ladder_is_cut_into_equal_parts_of_the_barrier():
    t = np.array([0.0, 0.1, 0.5, 1.0])
    found = adapt_ladder(t, np.array([0.9, 0.3, 0.3]), 6)  # barrier 0.9 at 0.1, 1.5 in all: 0.3 a step
    assert found[[0, -1]].tolist() == [0.0, 1.0]
    assert found[3] == pytest.approx(0.1)
    assert np.all(np.diff(found) > 0)
    assert len(adapt_ladder(t, np.full(3, 0.9), None)) == 8
    assert len(adapt_ladder(np.linspace(0, 1, 12), np.full(11, 1.0), None)) == 23


def test_round_trips_are_counted_at_both_ends():
    from fmu.samplers.tempering.kernel import _update_headings

    heading = np.array([[0, 1], [2, 0], [2, 1]])  # of two chains with three rungs
    turned, trips = _update_headings(heading)
    assert turned.tolist() == [[0, 2], [2, 0], [1, 1]]
    assert trips.tolist() == [1, 0]


def test_a_model_that_fails_in_part_of_the_prior():
    target = Failing()
    result = run(target, Tempering(rungs=10), draws=50, warmup=100, chains=64, seed=1, init=np.zeros((64, 3)))
    assert np.isneginf(result.posterior.stats[LOG_LIKELIHOOD][..., 0]).any()
    assert np.all(np.isfinite(result.posterior.stats[LOG_LIKELIHOOD][..., 1:]))
    assert_evidence(target, result, below=0.15)


def test_bad_settings_are_refused():
    for settings, words in (
        ({"kernel": "nuts"}, "kernel: must be one of mh, slice, hmc"),
        ({"kernel": fmu.Ensemble()}, "kernel: must be one of"),
        ({"kernel": fmu.HamiltonianMonteCarlo(gradient="central-difference")}, "kernel.gradient: must be exact"),
        (
            {"kernel": fmu.HamiltonianMonteCarlo(bent=[True, False])},
            "kernel.bent: must not be given under tempering",
        ),
        ({"kernel": (fmu.Slice(), fmu.Slice())}, "kernel: must be one per temperature above 0"),
        ({"temperatures": [0.1, 1.0]}, "temperatures: must be distinct inverse temperatures from 0 to 1"),
        ({"temperatures": [0.0, 0.5, 0.5, 1.0]}, "temperatures: must be distinct"),
        ({"temperatures": [0.0, 1.0], "rungs": 3}, "rungs: must be the number of temperatures"),
        ({"rungs": 1}, "rungs: must be a whole number of at least 2"),
        ({"swap_every": 0}, "swap_every: must be a whole number of at least 1"),
    ):
        with pytest.raises(ValueError, match=words):
            Tempering(**settings)
    assert Tempering(temperatures=[1.0, 0.0, 0.25]).temperatures == (0.0, 0.25, 1.0)


def test_a_density_that_is_no_product_is_refused():
    with pytest.raises(ValueError, match=r"needs a density with log_prior.*without log_prior, log_likelihood"):
        run(CorrelatedGaussian(), Tempering(), draws=1, warmup=0, chains=2, seed=1, init="prior")


def test_the_start_must_be_where_the_density_is_finite():
    for kernel in ("slice", "hmc"):
        with pytest.raises(ValueError, match="init: chain 0 must start where the log-density is finite"):
            run(Failing(), Tempering(kernel), draws=1, warmup=0, chains=1, seed=1, init=[[5.0, 0.0, 0.0]])


@pytest.mark.validate
def test_the_mode_that_no_other_sampler_reaches_from_the_papers_start(section, section_maxima):
    """Slice sampling alone stays 60 below the maximum that holds the probability."""
    settings = {"chains": 4, "seed": 1, "init": "start"}
    alone = to_trace(run(section, fmu.Slice(), draws=60, warmup=320, **settings), section, predictions=False)
    assert "was never visited" in missed_maxima(alone, section_maxima)[0]
    trace = to_trace(run(section, Tempering(), draws=60, warmup=320, **settings), section, predictions=False)
    assert not any("never visited" in reason for reason in missed_maxima(trace, section_maxima))
    best = trace["sample_stats"]["lp"].max("draw").to_numpy()
    assert np.any(best > section_maxima[0].log_prob - 10)  # a chain that has been at the top


def test_where_a_replica_was_not_evaluated_last_it_is_evaluated_again():
    """As after an interval of the coordinate-wise slice that was given up."""
    target, rng = LinearGaussian(), np.random.default_rng(1)
    parts = PriorAndLikelihood(target, with_gradients=False)
    start, between, last = (rng.standard_normal((3, 3)) for _ in range(3))
    tempered = TemperedTarget(parts, np.array([0.1, 0.5, 1.0]), parts.points(start))
    for position in (between, last):
        tempered.log_prob(position, slice(None))
    arrived = np.stack([start[0], between[1], last[2]])
    points, n_solves = tempered.at(arrived)
    assert n_solves.tolist() == [0, 1, 0]
    np.testing.assert_array_equal(points.position, arrived)
    np.testing.assert_array_equal(points.log_likelihood, target.likelihood(arrived)[0])


def test_every_replica_moves_with_the_settings_of_its_rung():
    target = LinearGaussian()
    turned = np.linalg.qr(np.random.default_rng(2).standard_normal((3, 3)))[0]
    slices = [fmu.Slice(width=w, axes=a).bind(target) for w, a in ((1.0, np.eye(3)), (2.0, turned))]
    joined = side_by_side(slices, 2)
    np.testing.assert_array_equal(joined.width[:, 0], [1, 1, 2, 2])
    np.testing.assert_array_equal(joined.axes, [np.eye(3), np.eye(3), turned, turned])
    walks = [fmu.MetropolisHastings(fmu.RandomWalk(s)).bind(target) for s in (0.1, 4.0 * np.eye(3))]
    factors = side_by_side(walks, 2).proposal.factor
    np.testing.assert_allclose(factors[:, 0, 0], [0.1, 0.1, 2.0, 2.0])
    settings = ((0.1, 2, 3.0 * np.ones(3)), (0.2, 4, np.ones(3)))
    masses = [fmu.HamiltonianMonteCarlo(h, n, inverse_mass=m).bind(target) for h, n, m in settings]
    joined = side_by_side(masses, 2)
    np.testing.assert_array_equal(joined.step_size, [0.1, 0.1, 0.2, 0.2])
    np.testing.assert_array_equal(joined.metric.inverse[:, 0, 0], [3, 3, 1, 1])
    assert joined.n_steps == 3
    momentum = np.random.default_rng(3).standard_normal((4, 3))
    own = [kernel.metric.velocity(momentum[2 * k : 2 * k + 2]) for k, kernel in enumerate(masses)]
    np.testing.assert_allclose(joined.metric.velocity(momentum), np.concatenate(own))
