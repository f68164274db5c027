import json
import math
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest

from fmu.runs.content import SavedState, packed_state, unpacked_state
from fmu.samplers import (
    Ensemble,
    HamiltonianMonteCarlo,
    Independence,
    MetropolisHastings,
    MixtureSampler,
    Slice,
    Tempering,
)
from fmu.samplers.loop.group import Chunk, GroupState, RunContext, _GroupRunner, advance
from fmu.samplers.loop.starts import starting_points
from fmu.samplers.mixture.quadratic import Quadratic
from tests.samplers.targets import CorrelatedGaussian
from tests.samplers.tempered_targets import LinearGaussian

WARMUP, DRAWS, CHAINS = 48, 6, 3


@dataclass(frozen=True)
class Jumps:
    """A proposal that is not of the package."""

    width: float = 0.3

    def sample(self, rng, position):
        return position + rng.uniform(-self.width, self.width, position.shape)

    def log_ratio(self, candidate, position):
        return np.zeros(len(position))


class Shortening:
    """A tuner that is not of the package: it shortens a step as long as the warm-up lasts."""

    def __init__(self, density):
        self.density = density
        self.restore({"width": np.array(0.3)})

    def update(self, state, info):
        self.restore({"width": 0.99 * self.width})

    def finish_learning(self):
        return MetropolisHastings(Jumps(float(self.width)))

    def state(self):
        return {"width": self.width}

    def restore(self, state):
        self.width = state["width"]
        self.kernel = self.finish_learning().bind(self.density)


class OwnSampler(MetropolisHastings):
    def tuner(self, density, chains, steps):
        return Shortening(density)


def a_mixture(*weights):
    """A mixture of components that overlap, with weights that do not add up to 1 exactly."""
    around = [Quadratic(np.full(5, at), 0.0, np.zeros(5), np.eye(5)) for at in np.linspace(-1, 1, len(weights))]
    return MixtureSampler(around, weights, jumps=3)


SAMPLERS = {
    "mh": MetropolisHastings(),
    "independence": MetropolisHastings(Independence(np.zeros(5), np.eye(5))),
    "slice": Slice(),
    "slice, coordinate": Slice("coordinate"),
    "hmc": HamiltonianMonteCarlo(),
    "hmc, differences": HamiltonianMonteCarlo(gradient="central-difference"),
    "hmc, given mass": HamiltonianMonteCarlo(inverse_mass=np.eye(5)),
    "mixture": MixtureSampler(jumps=3),
    "mixture, slice": MixtureSampler(local=Slice()),
    "mixture, given": a_mixture(0.1, 0.2, 0.3),
    "emcee": Ensemble(walkers=12),
    "emcee, odd": Ensemble(walkers=13),  # a normal draw would be left over in each step
    "emcee, two moves": Ensemble(walkers=12, moves={"de": 0.5, "snooker": 0.5}),
    "tempering, slice": Tempering(),
    "tempering, mh": Tempering("mh"),
    "tempering, hmc": Tempering("hmc"),
    "mh, own proposal": MetropolisHastings(Jumps()),
    "mh, own tuner": OwnSampler(),
    "tempering, own proposal": Tempering(MetropolisHastings(Jumps())),
    "tempering, given ladder": Tempering("mh", temperatures=[0.0, 0.1, 1.0]),
}


def setting_of(name):
    return RunContext(
        LinearGaussian() if name.startswith("tempering") else CorrelatedGaussian(), SAMPLERS[name], WARMUP
    )


def begun(context):
    rng = np.random.default_rng(3)
    (start,) = starting_points(context.scaled, "prior", [rng], CHAINS, context.sampler.walkers)
    return GroupState.at(start, rng)


def through_a_file(group):
    """The group as a file of a checkpoint would bring it back."""
    return unpacked_state(packed_state(SavedState("", "", group, {}, [], 0))).group_state


def advanced(context, group, phase, steps):
    return advance(context, Chunk(group, phase, steps, math.inf, steps))


@cache
def group_after(name, steps):
    """Return the group after 1, half or all steps of the warm-up; nothing changes it (see below)."""
    earlier = {1: 0, WARMUP // 2: 1, WARMUP: WARMUP // 2}[steps]
    context = setting_of(name)
    group = group_after(name, earlier) if earlier else begun(context)
    return advanced(context, group, "warmup", steps - earlier).group


def same(one, other):
    return (one.dtype, one.shape, one.tobytes()) == (other.dtype, other.shape, other.tobytes())


@pytest.mark.parametrize("name", SAMPLERS)
def test_going_on_from_files_is_bitwise_going_on(name, monkeypatch):
    """Eleven steps at a time, every part from a file and with a setting of its own, as another process has it."""
    monkeypatch.setattr("fmu.samplers.loop.group._AT_ONCE", 5)
    whole, group = [], begun(setting_of(name))
    for phase, steps in (("warmup", WARMUP), ("draws", DRAWS)):
        done = advanced(setting_of(name), group, phase, steps)
        group = done.group
        whole.append(done)
    group = begun(setting_of(name))
    for phase, steps, expected in zip(("warmup", "draws"), (WARMUP, DRAWS), whole, strict=True):
        for first in range(0, steps, 11):
            stop = min(first + 11, steps)
            done = advanced(setting_of(name), through_a_file(group), phase, stop - first)
            group = done.group
            assert same(done.steps.position, expected.steps.position[:, first:stop])
            assert done.steps.stats.keys() == expected.steps.stats.keys()
            assert all(same(done.steps.stats[key], x[:, first:stop]) for key, x in expected.steps.stats.items())
            assert group.done[phase] == stop
    assert group.learnt == whole[-1].group.learnt


@pytest.mark.parametrize("name", SAMPLERS)
def test_what_has_been_learnt_halfway_comes_back(name):
    group = group_after(name, WARMUP // 2)
    again = _GroupRunner(setting_of(name), through_a_file(group)).group_state()
    before, after = (dict(leaves(g.tree())) for g in (group, again))
    assert before.keys() == after.keys()
    for path, value in before.items():
        found = after[path]
        assert same(np.asarray(found), np.asarray(value)) if isinstance(value, np.ndarray) else found == value


def test_a_group_state_stays_what_it_was():
    context = setting_of("hmc")
    group = advanced(context, begun(context), "warmup", 20).group
    before = packed_state(SavedState("", "", group, {}, [], 0))
    first, again = (advanced(context, group, "warmup", 20) for _ in range(2))
    assert same(first.steps.position, again.steps.position)
    assert packed_state(SavedState("", "", group, {}, [], 0)) == before


def leaves(tree, path=""):
    for key, value in tree.items():
        if isinstance(value, dict):
            yield from leaves(value, f"{path}/{key}")
        else:
            yield f"{path}/{key}", value


@pytest.mark.parametrize("name", SAMPLERS)
def test_a_group_is_arrays_and_plain_values(name):
    """At any time of the warm-up, and after it."""
    for steps in (1, WARMUP // 2, WARMUP):
        for path, value in leaves(group_after(name, steps).tree()):
            if isinstance(value, np.ndarray | np.generic):
                assert value.dtype.kind in "biuf", path
            else:
                json.dumps(value)


def test_what_was_seen_in_warm_up_is_dropped_at_its_end():
    """The positions of the warm-up are not kept with the state of every draw."""
    for name in ("mh", "slice", "hmc", "tempering, slice"):
        tree = group_after(name, WARMUP).tree()
        assert sum(value.nbytes for _, value in leaves(tree) if isinstance(value, np.ndarray)) < 9000


@pytest.mark.parametrize("kind", [np.random.PCG64, np.random.MT19937, np.random.SFC64, np.random.Philox])
def test_generators_of_every_kind_are_plain(kind):
    rng = np.random.Generator(kind(7))
    rng.standard_normal(3)
    rng.integers(2**32, dtype=np.uint32)  # PCG64 keeps half a number for the next
    group = through_a_file(GroupState.at(np.zeros((1, 2)), rng))
    other = np.random.Generator(kind(0))
    other.bit_generator.state = group.generator
    np.testing.assert_array_equal(other.standard_normal(5), rng.standard_normal(5))
    assert other.integers(2**32, dtype=np.uint32) == rng.integers(2**32, dtype=np.uint32)


def with_tuner(tuner):
    return replace(GroupState.at(np.zeros((1, 2)), np.random.default_rng(0)), tuner=tuner)


def test_arrays_keep_kind_order_and_every_bit():
    values = np.array([[np.nan, -0.0, np.inf], [5e-324, -np.inf, 0.1]])
    values.view(np.uint64)[0, 0] ^= 1  # a NaN with another payload
    for array in (
        values,
        np.asfortranarray(values),
        values[:, :0],
        np.array(2.5),
        values > 0,
        np.arange(3, dtype="i2"),
    ):
        found = through_a_file(with_tuner({"deep": {"array": array}})).tuner["deep"]["array"]
        assert same(found, array)
        assert found.flags.f_contiguous == array.flags.f_contiguous


@pytest.mark.parametrize(
    "value",
    [None, True, 0, -7, 2**127 + 1, 0.1, -0.0, 5e-324, math.inf, "", "é\n\0", [], {}, [1, 2], {"a": {"b": [0.5]}}],
    ids=repr,
)
def test_plain_values(value):
    found = through_a_file(with_tuner({"value": value})).tuner["value"]
    assert found == value
    assert repr(found) == repr(value)


@pytest.mark.parametrize("thing", [object(), {1, 2}, b"bytes", 1j, np.array([None, {}])], ids=range(5))
def test_what_is_not_plain_is_not_written(thing):
    with pytest.raises(ValueError, match="sampler: its state must be arrays, numbers and strings to be saved"):
        through_a_file(with_tuner({"deep": {"thing": thing}}))
