"""The search of plain log-densities: what it finds, what it does not exclude, and densities that are wrong."""

import numpy as np
import pytest

import fmu
from fmu.analysis.convergence.diagnosis import maxima_of, with_maxima
from fmu.analysis.maxima.plain import PlainDensity
from fmu.analysis.maxima.search import find_map
from tests.densities import Shell, ThreeWidths
from tests.plain_densities import AtWall, FourModes, Gammas, Gumbels, Pair


class Plain:
    """A log-density of two coordinates in a box, given as a function, with draws from the box."""

    ndim, lower, upper = 2, np.full(2, -3.0), np.full(2, 3.0)

    def __init__(self, function):
        self.log_prob = function

    def sample_prior(self, rng, n):
        return rng.uniform(-3.0, 3.0, (n, 2))


class OnTheLine(Plain):
    """The same without a prior and without bounds."""

    lower, upper = np.full(2, -np.inf), np.full(2, np.inf)
    sample_prior = property()


def bowl(theta):
    return -0.5 * np.sum(np.asarray(theta) ** 2, axis=-1)


def test_all_modes_of_a_bounded_density_are_found_and_weighed():
    density = FourModes()
    found = find_map(density, starts=256)
    assert found.doubts == ()
    assert found.search == "256 starts from the prior led to 4 maxima"
    np.testing.assert_allclose(sorted(m.share for m in found), sorted(density.weights), atol=0.03)
    assert found.log_evidence == pytest.approx(0.0, abs=0.1)
    assert found.n_solves > found.n_gradients > 64
    assert not found.labels


def test_differences_stand_for_a_missing_gradient():
    with_gradient = Gumbels()
    without = Plain(with_gradient.log_prob)
    without.lower, without.upper = with_gradient.lower, with_gradient.upper
    without.sample_prior = with_gradient.sample_prior
    found, exact = find_map(without), find_map(with_gradient)
    np.testing.assert_allclose(found[0].theta, exact[0].theta, atol=1e-4)
    assert found.search == "16 starts from the prior led to 1 maximum"
    assert found.n_gradients == 0


def test_a_step_over_a_wall_does_not_end_the_ascent():
    (found,) = find_map(Gammas())
    np.testing.assert_allclose(found.theta, Gammas.shapes - 1.0, atol=1e-4)


def test_a_maximum_at_a_wall_is_one():
    (found,) = find_map(AtWall())
    assert found.at_bound.tolist() == [-1, -1, -1]
    np.testing.assert_allclose(found.sd, 1.0 / AtWall.rates, rtol=0.2)


def test_chains_start_in_several_modes_and_jump_between_them():
    """From its prior alone no chain would change sides."""
    density = Pair()
    trace = fmu.sample(density, "mh", draws=500, warmup=200, seed=2)
    assert np.mean(trace["posterior"]["x0"] < 0) == pytest.approx(0.7, abs=0.05)
    assert fmu.diagnose(trace).state == "converged"
    assert maxima_of(trace).search.startswith("64 starts")

    narrow = Pair(sd=0.25)  # 16 standard deviations apart, where HMC changes sides on no processor
    at_one = {"init": np.tile([-2.0, 0.0], (4, 1)), "jumps": False, "maxima": find_map(narrow)}
    stayed = fmu.sample(narrow, "hmc", draws=20, warmup=20, seed=2, **at_one)
    assert fmu.diagnose(stayed).verdict.startswith("not converged: maximum 2 at x0 = 2")


@pytest.mark.parametrize("sampler", ["mixture", pytest.param("mh", marks=pytest.mark.validate)])
def test_modes_that_no_search_finds_leave_a_run_converged_locally(sampler):
    """Two of the three modes attract 1e-5 and 1e-8 of the box: what was not found is not excluded."""
    trace = fmu.sample(ThreeWidths(), sampler, seed=3, draws=200, warmup=300, until_ess=400, max_solves=40_000)
    found = fmu.diagnose(trace)
    assert found.state == "converged locally"
    assert "too far apart to meet a mode as narrow as these draws" in found.remarks[0]
    if sampler == "mixture":
        evidence = fmu.evidence(trace)
        assert abs(evidence.log_evidence) > 50 * evidence.error  # of one mode of three, which it says
        assert " of the visited places alone " in str(evidence).splitlines()[0]


def test_more_starts_and_a_tighter_box_lift_the_doubt():
    """The word depends on how densely the points lie, and on nothing that is set by hand."""
    wide = Plain(bowl)
    wide.lower, wide.upper = np.full(2, -60.0), np.full(2, 60.0)
    wide.sample_prior = lambda rng, n: rng.uniform(-60.0, 60.0, (n, 2))
    few, tight = (
        fmu.sample(density, draws=200, warmup=50, until_ess=400, seed=1) for density in (wide, Plain(bowl))
    )
    more = with_maxima(few, find_map(wide, starts=1024))
    states = [fmu.diagnose(trace).state for trace in (few, more, tight)]
    assert states == ["converged locally", "converged", "converged"]


def test_a_hollow_density_has_no_weighed_maxima_and_starts_in_its_prior():
    trace = fmu.sample(Shell(), "mh", draws=5, warmup=0)
    assert trace.attrs["init"] == "prior"
    assert "but not how much of the probability each holds" in " ".join(maxima_of(trace).doubts)
    assert maxima_of(trace).search.startswith("16 starts from the prior led to ")  # further ones tell no more
    assert maxima_of(trace).n_solves < 20_000


def test_a_density_without_prior_or_bounds_needs_no_start():
    trace = fmu.sample(OnTheLine(bowl), "mh", draws=300, warmup=200, until_ess=400, seed=1)
    found = fmu.diagnose(trace)
    assert found.state == "converged locally"
    assert "without bounds or a prior nothing says where others can be" in found.remarks[0]


def test_chains_start_where_the_density_is_finite():
    def half(theta):
        return np.where(theta[..., 0] > 0, np.nan, bowl(theta))

    trace = fmu.sample(Plain(half), "mh", draws=300, warmup=200, until_ess=400, seed=1)
    assert fmu.diagnose(trace).state == "converged"
    assert float(trace["posterior"]["x0"].max()) <= 0


def raising(_):
    raise RuntimeError("the mesh is inverted")


@pytest.mark.parametrize(
    ("function", "sentence"),
    [
        (
            lambda t: np.full(len(t), -np.inf),
            "must be finite somewhere; it is so at none of 16 points from the prior",
        ),
        (
            lambda t: np.full(len(t), np.nan),
            "must be finite somewhere; it is so at none of 16 points from the prior",
        ),
        (
            lambda t: np.full(len(t), np.inf),
            "must be finite somewhere; it is so at none of 16 points from the prior",
        ),
        (lambda _: 0.0, r"log_prob must take theta of shape \(\d+, 'ndim'\) and return real numbers of shape"),
        (lambda _: np.zeros(3), r"one row a point \(got float64 of shape \(3,\)\)"),
        (lambda t: np.zeros(len(t), dtype=complex), r"one row a point \(got complex128 of shape"),
        (lambda t: ["a"] * len(t), r"return real numbers of shape \(\d+,\), one row a point \(got <U1 of shape"),
    ],
    ids=["-inf", "nan", "inf", "number", "three", "complex", "text"],
)
@pytest.mark.parametrize("sampler", ["mixture", "emcee"])
def test_a_density_that_is_wrong_is_refused_in_a_sentence(function, sentence, sampler):
    with pytest.raises(ValueError, match=f"^problem: .*{sentence}"):
        fmu.sample(Plain(function), sampler, draws=10, warmup=10)


def test_an_error_of_the_density_stays_and_says_where():
    with pytest.raises(RuntimeError, match="the mesh is inverted") as caught:
        fmu.sample(Plain(raising), "mh", draws=10, warmup=10)
    (note,) = caught.value.__notes__
    assert (
        note == "The log-density raised this at one of 256 theta. Let it return -inf where it cannot be computed."
    )


def test_an_error_of_the_gradient_at_the_start_says_which_point():
    density = Plain(bowl)
    density.log_prob_and_grad = raising
    with pytest.raises(RuntimeError, match="the mesh is inverted") as caught:
        find_map(density)
    assert caught.value.__notes__[0].startswith("The log-density raised this at theta = [0.0, 0.0]. Let it")


def test_hmc_needs_a_gradient():
    with pytest.raises(ValueError, match="sampler: hmc needs a density with log_prob_and_grad; without it take"):
        fmu.sample(Plain(bowl), "hmc", draws=10, warmup=10)
    differences = fmu.HamiltonianMonteCarlo(gradient="central-difference")
    trace = fmu.sample(Plain(bowl), differences, draws=150, warmup=50, until_ess=400)
    assert fmu.diagnose(trace).state == "converged"


@pytest.mark.parametrize("steps", [np.floor, np.zeros_like], ids=["discontinuous", "flat"])
def test_a_density_in_steps_is_sampled(steps):
    def log_prob(theta):
        return steps(np.asarray(theta)).sum(axis=-1)

    trace = fmu.sample(Plain(log_prob), "mixture", draws=600, warmup=100, until_ess=400, seed=1)
    assert fmu.diagnose(trace).converged
    weight = np.exp(steps(np.arange(-3.0, 3.0)))
    mean = weight @ np.arange(-2.5, 3.0) / weight.sum()
    for name in ("x0", "x1"):
        row = fmu.summary(trace).loc[name]
        assert abs(row["mean"] - mean) < 5 * row["mcse_mean"]


def test_the_first_start_is_the_middle_of_the_bounds():
    density = Plain(bowl)
    density.lower, density.upper = np.array([-3.0, 1.0]), np.array([1.0, 11.0])
    np.testing.assert_allclose(PlainDensity(density).starting_points(1, 0), [[-1.0, 6.0]])


def test_differences_are_slopes_in_the_units_of_each_coordinate():
    density = Plain(bowl)
    density.lower, density.upper = np.array([-3.0, -1.0]), np.array([3.0, 99.0])
    _, gradient = PlainDensity(density).log_prob_and_grad([[1.0, -0.5], [0.0, 2.0]])
    np.testing.assert_allclose(gradient, [[-1.0, 0.5], [0.0, -2.0]], atol=1e-4)


def test_scales_that_are_far_from_the_widths_are_named():
    class Unscaled:
        ndim, lower, upper = 2, np.full(2, -np.inf), np.full(2, np.inf)

        def log_prob(self, theta):
            z = (np.asarray(theta) - [2e11, 3e-9]) / [2e10, 3e-10]
            return -0.5 * np.sum(z**2, axis=-1)

    class Scaled(Unscaled):
        offset, scale = np.array([2e11, 3e-9]), np.array([2e10, 3e-10])

    told = fmu.find_map(Unscaled()).doubts[-1]
    assert told.startswith("x0 and x1: the widths differ from the scales in use, 1, 1, more than ")
    assert told.endswith("give the density right attributes offset and scale, a typical point and a typical width")
    assert not any("scale" in doubt for doubt in fmu.find_map(Scaled()).doubts)

    class Narrow(Unscaled):
        lower, upper = np.zeros(2), np.array([1e16, 1e-4])  # between finite bounds, a small width is no doubt

    assert not any("scale" in doubt for doubt in fmu.find_map(Narrow()).doubts)
