import numpy as np
import pytest

from fmu.samplers import Slice, State, run
from fmu.samplers.slice import ACCOUNT, SCHEMES
from tests.samplers.targets import CorrelatedGaussian, Counting, Target, TruncatedGaussian


class Flat(Target):
    """Constant inside its box, or everywhere."""

    def value_and_slope(self, x):
        return np.zeros(len(x)), np.zeros_like(x)


def one_step(target, sampler, start):
    density = Counting(target)
    kernel = sampler.bind(density)
    state, _ = kernel.init(start)
    spent = density.n_solves
    state, info = kernel.step(np.random.default_rng(1), state)
    return state, info, density.n_solves - spent


def test_a_flat_box_wider_than_the_interval_costs_one_solve_a_draw():
    target = Flat(2, lower=[0.0, 0.0], upper=[1.0, 1.0])
    start = np.random.default_rng(0).random((50, 2))
    state, info, spent = one_step(target, Slice("hyperrectangle", width=3.0), start)
    assert spent == 50  # the interval is cut at the walls, so that the first candidate is inside
    assert np.all(info.n_solves == 1)
    assert np.all((state.position >= 0) & (state.position <= 1))


def test_ends_beyond_the_walls_are_not_evaluated():
    target = Flat(3, lower=np.zeros(3), upper=np.ones(3))
    start = np.random.default_rng(0).random((50, 3))
    _, info, spent = one_step(target, Slice("coordinate", width=5.0), start)
    # An initial interval of 5 has an end inside the unit box with probability below 1/5: no steps out, and at
    # most one of its ends evaluated beside the one candidate of each coordinate.
    assert spent == info.n_solves.sum()
    assert np.all(info.extra["n_shrinks"] == 0)
    assert 150 <= spent < 150 + 60


@pytest.mark.parametrize("budget", [0, 1, 7])
def test_stepping_out_spends_its_budget_on_a_flat_density(budget):
    start = np.zeros((40, 2))
    sampler = Slice("coordinate", width=0.5, max_steps_out=budget)
    _, info, spent = one_step(Flat(2), sampler, start)
    assert np.all(info.extra["n_steps_out"] == 2 * budget)
    assert np.all(info.n_solves == 2 * (budget + 1))
    assert spent == info.n_solves.sum()


def test_stepping_out_divides_its_budget_evenly_between_left_and_right():
    kernel = Slice("coordinate", width=1.0, max_steps_out=4).bind(Flat(2))
    start = np.zeros((20_000, 2))
    state, _ = kernel.step(np.random.default_rng(3), State(start, np.zeros(len(start))))
    # On a flat density the draw is uniform over an interval of 5 that is placed uniformly around the start, so
    # that it has the triangular density on (−5, 5).
    assert np.all(np.abs(state.position) < 5)
    assert np.all(np.abs(state.position.mean(axis=0)) < 5 * np.sqrt(25 / 6 / len(start)))
    np.testing.assert_allclose(state.position.var(axis=0), 25 / 6, rtol=0.05)


def test_stepping_out_stops_at_the_first_end_off_the_slice():
    target = CorrelatedGaussian()
    start = np.tile(target.mean, (40, 1))
    _, wide, _ = one_step(target, Slice("coordinate", width=1e4, max_steps_out=10), start)
    assert np.all(wide.extra["n_steps_out"] == 0)
    # With Y = P exp(−e) the slice through the mean is |x| < sqrt(2 e) sd, in coordinate 0 at first: each end steps
    # out until it has passed that, and each step is one evaluation beside the last of each end.
    narrow = Slice("coordinate", width=0.05, max_steps_out=10**6).bind(target)
    level = -np.full(40, 2.0)
    account = {name: np.zeros(40, dtype=np.int64) for name in ACCOUNT}
    rng = np.random.default_rng(1)
    place = narrow._place(rng, len(start), narrow.width[:1])
    left, right = narrow._step_out(rng, start, level, 0, place, account)[:, :, 0]
    reach = np.sqrt(2 * 2.0 / target.precision[0, 0])
    assert np.all((-reach - 0.05 <= left) & (left < -reach))
    assert np.all((reach < right) & (right <= reach + 0.05))
    np.testing.assert_array_equal(account["n_solves"], account["n_steps_out"] + 2)


def test_the_candidate_is_what_is_tested_against_the_level():
    """The erratum of section 4.2: with the test on the start, every first candidate would be taken."""
    target = TruncatedGaussian()
    start = np.tile(target.mean, (200, 1))
    kernel = Slice("hyperrectangle", width=20.0).bind(target)
    state, _ = kernel.init(start)
    rng, twin = np.random.default_rng(5), np.random.default_rng(5)
    level = state.log_prob - twin.standard_exponential(len(start))
    new, info = kernel.step(rng, state)
    assert np.all(new.log_prob >= level)
    assert np.all(info.n_solves[info.extra["n_shrinks"] > 0] > 1)
    assert (info.extra["n_shrinks"] > 0).sum() > 50


def test_intervals_shrink_towards_the_present_point():
    asked = []

    class Recorded(CorrelatedGaussian):
        def value_and_slope(self, x):
            asked.append(x[0])
            return super().value_and_slope(x)

    target = Recorded()
    kernel = Slice("hyperrectangle", width=100.0).bind(target)
    state, _ = kernel.init(target.mean[None] + 0.1)
    asked.clear()
    kernel.step(np.random.default_rng(2), state)
    away = np.array(asked) - state.position
    assert len(away) > 10
    for k in range(1, len(away)):
        missed = away[:k]
        left = np.max(np.where(missed < 0, missed, -np.inf), axis=0)
        right = np.min(np.where(missed < 0, np.inf, missed), axis=0)
        assert np.all((left <= away[k]) & (away[k] <= right))


@pytest.mark.parametrize("scheme", SCHEMES)
def test_a_chain_whose_slice_is_not_found_stays(scheme):
    """A density that jumps after the start was evaluated hides its slice altogether."""
    target = Flat(2, lower=[0.0, 0.0], upper=[1.0, 1.0])
    kernel = Slice(scheme, max_shrinks=20).bind(target)
    start = np.full((3, 2), 0.3)
    state, info = kernel.step(np.random.default_rng(1), State(start, np.full(3, 1e6)))
    np.testing.assert_array_equal(state.position, start)
    assert not info.accepted.any()
    assert np.all(info.extra["n_shrinks"] == 20 * (1 if scheme == "hyperrectangle" else 2))


def test_the_width_may_differ_by_coordinate():
    target = Flat(2)
    _, info, _ = one_step(target, Slice("coordinate", width=[0.1, 10.0], max_steps_out=0), np.zeros((500, 2)))
    assert np.all(info.accepted)
    state, _, _ = one_step(target, Slice("coordinate", width=[0.1, 10.0], max_steps_out=0), np.zeros((500, 2)))
    reach = np.abs(state.position).max(axis=0)
    assert reach[0] < 0.1
    assert 5 < reach[1] < 10


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"scheme": "doubling"}, "scheme: must be one of hyperrectangle, coordinate"),
        ({"width": 0.0}, "width: must be positive"),
        ({"width": [[1.0]]}, "width: must be a number or a vector"),
        ({"width": np.inf}, "width: must be finite"),
        ({"max_steps_out": -1}, r"max_steps_out: must be a whole number of at least 0 \(got -1\)"),
        ({"max_steps_out": 1.5}, "max_steps_out: must be a whole number"),
        ({"max_shrinks": 0}, "max_shrinks: must be a whole number of at least 1"),
    ],
)
def test_bad_settings(settings, message):
    with pytest.raises(ValueError, match=message):
        Slice(**settings)


def test_a_width_of_the_wrong_length():
    with pytest.raises(ValueError, match="width: must have length 2"):
        run(TruncatedGaussian(), Slice(width=[1, 1, 1]), draws=1, warmup=0, chains=1, seed=1, init="start")
