import emcee
import numpy as np
import pytest

from fmu.samplers import Ensemble, run
from fmu.samplers.snooker import SnookerMove
from tests.samplers.targets import CorrelatedGaussian, TruncatedGaussian


@pytest.mark.parametrize(
    ("moves", "pairs"),
    [
        ("stretch", (("stretch", 1.0),)),
        ({"de": 0.8, "snooker": 0.2}, (("de", 0.8), ("snooker", 0.2))),
        ([("de", 0.8), ("snooker", 0.2)], (("de", 0.8), ("snooker", 0.2))),
        (["stretch", "de"], (("stretch", 1.0), ("de", 1.0))),
    ],
)
def test_moves_may_be_given_in_several_ways(moves, pairs):
    assert Ensemble(moves=moves).moves == pairs


def test_the_default_is_a_kernel_density_where_the_walkers_suffice_for_one():
    target = CorrelatedGaussian()  # five coordinates
    named = [
        [type(move).__name__ for move in Ensemble(walkers).bind(target).moves]
        for walkers in (4 * target.ndim, 4 * target.ndim - 1)
    ]
    assert named == [["DEMove", "KDEMove"], ["DEMove"]]
    with pytest.raises(ValueError, match=r"walkers: must be at least 20, four per coordinate, for the move kde"):
        Ensemble(19, moves={"kde": 1.0, "de": 1.0}).bind(target)


def test_a_mixture_draws_its_moves_by_weight():
    """DE steps by a fixed multiple of a difference of walkers; a stretch does not."""
    target = CorrelatedGaussian()
    kinds = {}
    for name, moves in (("de", "de"), ("mixed", {"de": 1.0, "stretch": 1.0}), ("stretch", "stretch")):
        result = run(target, Ensemble(moves=moves), draws=60, warmup=0, chains=4, seed=3, init="prior")
        kinds[name] = result.posterior.stats["accepted"].mean()
    assert kinds["de"] < kinds["mixed"] - 0.03
    assert kinds["mixed"] < kinds["stretch"] - 0.03


@pytest.mark.filterwarnings("ignore:get_state and legacy:RuntimeWarning")  # emcee asks for the state of MT19937
@pytest.mark.parametrize("moves", [{"de": 0.5, "kde": 0.3, "stretch": 0.2}, "snooker"])
def test_a_step_is_that_of_emcee_to_the_last_bit(moves):
    target = CorrelatedGaussian()
    settings, rng, of_emcee = Ensemble(moves=moves), np.random.default_rng(4), np.random.default_rng(4)
    kernel = settings.bind(target)
    state = kernel.init(target.sample_prior(np.random.default_rng(1), 64).reshape(2, 32, -1))[0]
    sampler = emcee.EnsembleSampler(
        32, target.ndim, target.log_prob, moves=settings.weighted_moves(target.ndim), vectorize=True
    )
    for _ in range(10):
        before, (state, info) = state, kernel.step(rng, state)
        for position, log_prob, coords, at in zip(
            before.position, before.log_prob, state.position, state.log_prob, strict=True
        ):
            sampler._random = np.random.RandomState(of_emcee.bit_generator)
            end = next(sampler.sample(emcee.State(position, log_prob), iterations=1, store=False))
            np.testing.assert_array_equal(coords, end.coords)
            np.testing.assert_array_equal(at, end.log_prob)
    assert info.accepted.any()


def test_every_ensemble_has_its_own_stream():
    target = CorrelatedGaussian()
    start = np.tile(target.sample_prior(np.random.default_rng(1), 32), (3, 1, 1))
    position = run(target, Ensemble(), draws=2, warmup=0, chains=3, seed=1, init=start).posterior.position
    assert not np.array_equal(position[0], position[1])
    assert not np.array_equal(position[1], position[2])


def test_walkers_that_do_not_span_the_space_are_refused():
    target = TruncatedGaussian()
    start = np.tile(target.mean, (2, 32, 1))
    with pytest.raises(ValueError, match=r"init: the walkers must span the space \(those of ensemble 0 do not\)"):
        run(target, Ensemble(), draws=1, warmup=0, chains=2, seed=1, init=start)


def test_the_snooker_move_jumps_along_the_line_through_another_walker():
    rng = np.random.RandomState(3)
    s, rest = rng.randn(6, 3), [rng.randn(5, 3), rng.randn(5, 3)]
    q, factor = SnookerMove().get_proposal(s, rest, rng)
    others = np.concatenate(rest)
    for i in range(6):
        jump = (q[i] - s[i]) / np.linalg.norm(q[i] - s[i])
        before = s[i] - others
        along = np.abs(before @ jump) / np.linalg.norm(before, axis=1)
        z = np.argmax(along)
        assert along[z] == pytest.approx(1, abs=1e-10)
        ratio = np.linalg.norm(q[i] - others[z]) / np.linalg.norm(s[i] - others[z])
        assert factor[i] == pytest.approx(2 * np.log(ratio))


def test_walkers_at_one_point_do_not_snooker():
    rng = np.random.RandomState(3)
    s = np.ones((2, 3))
    q, factor = SnookerMove().get_proposal(s, [np.ones((5, 3))], rng)
    np.testing.assert_array_equal(q, s)
    np.testing.assert_array_equal(factor, 0.0)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"walkers": 4}, r"walkers: must be a whole number of at least 8 \(got 4\)"),
        ({"walkers": 32.5}, "walkers: must be a whole number"),
        ({"moves": "walk"}, r"moves: must be one of stretch, de, snooker, kde \(got 'walk'\)"),
        ({"moves": {"de": 0.0}}, "moves: must be a positive finite number"),
        ({"moves": {}}, "moves: must name one move or weigh several"),
        ({"moves": [("de", 0.5, 1)]}, "moves: must name one move or weigh several"),
        ({"moves": 3}, "moves: must name one move or weigh several"),
    ],
)
def test_bad_settings(settings, message):
    with pytest.raises(ValueError, match=message):
        Ensemble(**settings)


def test_too_few_walkers_for_the_density():
    with pytest.raises(ValueError, match=r"walkers: must be at least 10, twice the coordinates \(got 8\)"):
        Ensemble(walkers=8).bind(CorrelatedGaussian())
