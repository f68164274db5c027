import importlib
import json
import math
from functools import cache

import numpy as np
import pytest

from fmu.engines.base import InProcess
from fmu.samplers import Ensemble, HamiltonianMonteCarlo, MetropolisHastings, RandomWalk, Run, Slice, Tempering
from fmu.samplers.loop.run import n_groups
from fmu.samplers.loop.saving import Interrupted, TooManyFailuresError
from tests.samplers.targets import CorrelatedGaussian, TruncatedGaussian
from tests.samplers.tempered_targets import LinearGaussian

loop = importlib.import_module("fmu.samplers.loop.run")  # the package has a function of that name

WALK = MetropolisHastings(RandomWalk(0.3))
SAMPLERS = {
    "mh": MetropolisHastings(),
    "slice": Slice(),
    "hmc": HamiltonianMonteCarlo(),
    "emcee": Ensemble(walkers=12),
}


def drawn(sampler, draws=20, density=None, **changes):
    settings = {"warmup": 40, "chains": 4, "seed": 5, "init": "prior"} | changes
    return Run(density or CorrelatedGaussian(), sampler, **settings).extend(draws)


@cache
def whole(name):
    """Return the run of a sampler in one part."""
    return drawn(SAMPLERS[name])


def assert_same(one, other, chains=slice(None)):
    """Draws of `one` are those of some chains of `other`, and so is everything told about them."""
    for phase in ("warmup", "posterior"):
        a, b = getattr(one, phase), getattr(other, phase)
        np.testing.assert_array_equal(a.position, b.position[chains])
        assert a.stats.keys() == b.stats.keys()
        for name in a.stats:
            np.testing.assert_array_equal(a.stats[name], b.stats[name][chains])


class TestNumber:
    @pytest.mark.parametrize(
        ("groups", "chains", "sampler", "expected"),
        [
            (None, 4, WALK, 1),
            (None, 4, Ensemble(8), 4),
            (2, 4, WALK, 2),
            (4, 4, Ensemble(8), 4),
            (1, 3, Tempering(), 1),
        ],
    )
    def test_how_many(self, groups, chains, sampler, expected):
        assert n_groups(groups, chains, sampler) == expected

    @pytest.mark.parametrize(
        ("groups", "sampler", "message"),
        [
            (3, WALK, r"groups: must divide the 4 chains evenly \(got 3\)"),
            (8, WALK, r"groups: must divide the 4 chains evenly \(got 8\)"),
            (0, WALK, r"groups: must be a whole number of at least 1 \(got 0\)"),
            (2.0, WALK, r"groups: must be a whole number of at least 1 \(got 2.0\)"),
            (2, Ensemble(8), r"groups: must be the 4 ensembles, each of which is a group \(got 2\)"),
            (2, Tempering(), r"groups: must be 1 for tempering, .* \(got 2\)"),
        ],
    )
    def test_refused(self, groups, sampler, message):
        with pytest.raises(ValueError, match=message):
            drawn(sampler, groups=groups)


class TestIndependence:
    @pytest.mark.parametrize("name", ["mh", "slice", "hmc"])
    def test_a_group_does_not_depend_on_how_many_others_there_are(self, name):
        one, two, three = (drawn(SAMPLERS[name], chains=2 * n, groups=n) for n in (1, 2, 3))
        assert_same(one, two, slice(0, 2))
        assert_same(two, three, slice(0, 4))
        assert one.learnt.keys() == two.learnt.keys()
        assert [one.learnt[key] for key in one.learnt] == [two.learnt[key][0] for key in one.learnt]
        assert (two.groups, three.groups) == (2, 3)

    def test_nor_does_an_ensemble(self):
        assert_same(drawn(SAMPLERS["emcee"], chains=1), drawn(SAMPLERS["emcee"], chains=3), slice(0, 1))

    def test_a_group_does_not_depend_on_where_others_start(self):
        start = CorrelatedGaussian().sample_prior(np.random.default_rng(0), 4)
        elsewhere = start.copy()
        elsewhere[2:] += 0.5
        one, other = (drawn(SAMPLERS["hmc"], groups=2, init=init) for init in (start, elsewhere))
        np.testing.assert_array_equal(one.posterior.position[:2], other.posterior.position[:2])
        assert not np.any(one.posterior.position[2:] == other.posterior.position[2:])

    def test_chains_of_all_groups_differ(self):
        first = drawn(WALK, groups=4, init="start").warmup.position[:, -1, 0]
        assert np.unique(first).size == 4

    def test_another_number_of_groups_gives_other_draws(self):
        assert not np.array_equal(drawn(WALK).posterior.position, drawn(WALK, groups=2).posterior.position)

    def test_what_groups_learnt_is_json(self):
        learnt = drawn(SAMPLERS["hmc"], groups=2).learnt
        assert json.loads(json.dumps(learnt)) == learnt
        assert len(learnt["step_size"]) == 2
        assert learnt["step_size"][0] != learnt["step_size"][1]


class Backwards(InProcess):
    """Does the lines from the last to the first, each to its end."""

    def run_tasks(self, work, shared, tasks, follow=None, report=None):
        results = [None] * len(tasks)
        for i in reversed(range(len(tasks))):
            task = tasks[i]
            while task is not None:
                results[i] = work(shared, task, report)
                task = follow(i, results[i])
        return results


class TestParts:
    @pytest.mark.parametrize("name", SAMPLERS)
    @pytest.mark.parametrize("most", [1, 7])
    def test_the_draws_are_the_same_in_parts_of_any_number_of_steps(self, name, most, monkeypatch):
        expected = whole(name)
        monkeypatch.setattr(loop, "MOST_STEPS", most)
        assert_same(drawn(SAMPLERS[name]), expected)

    @pytest.mark.parametrize("name", SAMPLERS)
    def test_the_draws_are_the_same_in_parts_of_any_time(self, name, monkeypatch):
        expected, seen = whole(name), []
        monkeypatch.setattr(loop, "LIVE_S", 0.0)
        assert_same(drawn(SAMPLERS[name], stop=lambda: bool(seen.append(1))), expected)
        assert len(seen) == 60 * (4 if name == "emcee" else 1)

    @pytest.mark.parametrize("kernel", ["slice", "mh", "hmc"])
    def test_tempering(self, kernel, monkeypatch):
        whole = drawn(Tempering(kernel), density=LinearGaussian(), chains=2)
        monkeypatch.setattr(loop, "MOST_STEPS", 9)
        parts = drawn(Tempering(kernel), density=LinearGaussian(), chains=2)
        assert_same(parts, whole)
        assert parts.learnt == whole.learnt

    def test_the_order_of_the_work_does_not_matter(self, monkeypatch):
        forwards = drawn(SAMPLERS["mh"], groups=4)
        monkeypatch.setattr(loop, "MOST_STEPS", 11)
        assert_same(drawn(SAMPLERS["mh"], groups=4, engine=Backwards()), forwards)

    def test_a_step_that_takes_long_is_a_part(self, monkeypatch):
        """No part is ever empty, whatever the clock says."""
        monkeypatch.setattr(loop, "LIVE_S", -math.inf)
        assert drawn(WALK, stop=lambda: False).draws == 20


class TestProgress:
    def test_groups_are_told_apart(self, monkeypatch):
        monkeypatch.setattr(loop, "MOST_STEPS", 3)
        seen = []
        drawn(WALK, draws=7, warmup=4, groups=2, progress=lambda *call: seen.append(call))
        for group in ("1/2", "2/2"):
            calls = [call[:3] for call in seen if call[3]["group"] == group]
            assert calls == [*(("warmup", k, 4) for k in range(1, 5)), *(("draws", k, 7) for k in range(1, 8))]
        assert len(seen) == 22

    def test_a_single_group_has_no_name(self):
        seen = []
        drawn(WALK, progress=lambda *call: seen.append(call[3]))
        assert seen
        assert not any("group" in info for info in seen)

    def test_how_the_draws_do_is_passed_on(self, monkeypatch):
        """Of the steps that all groups have taken, and with the draws only."""
        monkeypatch.setattr(loop, "MOST_STEPS", 10)
        shapes, seen = [], []

        def live(draws):
            shapes.append(draws.shape)
            return {"rhat": 1.25}

        drawn(WALK, draws=60, groups=2, live=live, progress=lambda *call: seen.append(call))
        assert set(shapes) <= {(4, steps, 1, 5) for steps in range(20, 61, 10)}
        assert shapes
        assert seen[-1][3]["rhat"] == 1.25
        assert not any("rhat" in info for phase, _, _, info in seen if phase == "warmup")


class TestStopping:
    @pytest.mark.parametrize("groups", [1, 2])
    def test_between_two_parts(self, groups, monkeypatch):
        monkeypatch.setattr(loop, "MOST_STEPS", 10)
        whole, asked = drawn(WALK, draws=60, groups=groups), []
        begun = Run(
            CorrelatedGaussian(), WALK, warmup=40, chains=4, seed=5, init="prior", groups=groups,
            stop=lambda: asked.append(1) or len(asked) > 5 * groups,
        )  # fmt: skip
        with pytest.raises(Interrupted) as stopped:
            begun.extend(60)
        so_far = stopped.value.result
        assert so_far.draws == {1: 20, 2: 10}[groups]  # the others do not take another step
        assert len(asked) == 5 * groups + 1
        np.testing.assert_array_equal(so_far.posterior.position, whole.posterior.position[:, : so_far.draws])

    def test_in_warm_up_there_is_nothing_yet(self, monkeypatch):
        monkeypatch.setattr(loop, "MOST_STEPS", 10)
        with pytest.raises(Interrupted) as stopped:
            drawn(WALK, stop=lambda: True)
        assert stopped.value.result is None
        assert isinstance(stopped.value, KeyboardInterrupt)


class TestFailures:
    def test_too_many_stop_the_run(self, monkeypatch):
        monkeypatch.setattr(loop, "MOST_STEPS", 10)
        asked = []

        class Hollow(TruncatedGaussian):
            def value_and_slope(self, x):
                log_prob, slope = super().value_and_slope(x)
                return np.where(x[:, 0] > 0.3, np.nan, log_prob), slope

        def too_many(failed, solves, failures):
            asked.append((failed, solves))
            return "too many" if solves > 120 else None

        with pytest.raises(TooManyFailuresError, match="too many") as stopped:
            drawn(WALK, density=Hollow(), draws=50, init=[[0.0, 1.0]] * 4, too_many_failed=too_many)
        result = stopped.value.result
        assert 0 < asked[-1][0] < asked[-1][1]
        assert asked == sorted(asked)
        stats = [phase.stats for phase in (result.warmup, result.posterior)]
        assert asked[-1] == tuple(sum(int(s[name].sum()) for s in stats) for name in ("n_nonfinite", "n_solves"))
        assert result.draws == 10 * (len(asked) - 4)


class Narrowing:
    """A tuner of a user's own, which counts."""

    def __init__(self, density):
        self.density, self.steps, self.kernel = density, 0, WALK.bind(density)

    def update(self, state, info):
        self.steps += 1
        self.kernel = MetropolisHastings(RandomWalk(0.3 / self.steps**0.25)).bind(self.density)

    def finish_learning(self):
        return MetropolisHastings(RandomWalk(0.3 / self.steps**0.25))

    def state(self):
        return {"steps": self.steps}

    def restore(self, state):
        self.steps = state["steps"]
        self.kernel = MetropolisHastings(RandomWalk(0.3 / self.steps**0.25)).bind(self.density)


class OwnSampler(MetropolisHastings):
    def tuner(self, density, chains, steps):
        return Narrowing(density)


@pytest.mark.parametrize("most", [1, 7, 1000])
def test_a_sampler_that_the_package_does_not_know_learns_on_from_part_to_part(monkeypatch, most):
    monkeypatch.setattr(loop, "MOST_STEPS", most)
    result = drawn(OwnSampler())
    assert result.learnt["proposal"]["scale"] == 0.3 / 40**0.25
    assert_same(result, drawn(OwnSampler()))
