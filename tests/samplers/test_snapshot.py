import io
import json
import math
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest

from fmu.runs.content import SavedState, packed_state
from fmu.samplers import Ensemble, HamiltonianMonteCarlo, Independence, MetropolisHastings, Slice, Tempering
from fmu.samplers.hmc.metric import Metric
from fmu.samplers.loop.group import Chunk, GroupState, RunContext, advance, first_snapshot
from fmu.samplers.loop.snapshot import Snapshot, restored, taken
from fmu.samplers.loop.starts import starting_points
from tests.samplers.targets import CorrelatedGaussian
from tests.samplers.tempered_targets import LinearGaussian

WARMUP, DRAWS, CHAINS = 60, 8, 3


@dataclass(frozen=True)
class Jumps:
    """A proposal that is not of the package."""

    width: float = 0.3

    def sample(self, rng, position):
        return position + rng.uniform(-self.width, self.width, position.shape)

    def log_ratio(self, candidate, position):
        return np.zeros(len(position))


SAMPLERS = {
    "mh": MetropolisHastings(),
    "independence": MetropolisHastings(Independence(np.zeros(5), np.eye(5))),
    "slice": Slice(),
    "slice, coordinate": Slice("coordinate"),
    "hmc": HamiltonianMonteCarlo(),
    "hmc, differences": HamiltonianMonteCarlo(gradient="central-difference"),
    "hmc, given mass": HamiltonianMonteCarlo(inverse_mass=np.eye(5)),
    "emcee": Ensemble(walkers=12),
    "emcee, two moves": Ensemble(walkers=12, moves={"de": 0.5, "snooker": 0.5}),
    "tempering, slice": Tempering(),
    "tempering, mh": Tempering("mh"),
    "tempering, hmc": Tempering("hmc"),
    "mh, own proposal": MetropolisHastings(Jumps()),
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
    return first_snapshot(context, rng, start, 0)


def through_a_file(snapshot):
    """A snapshot as a file would bring it back: JSON and arrays, of which none may be pickled."""
    buffer = io.BytesIO()
    np.savez(buffer, **{f"a{k}": array for k, array in enumerate(snapshot.arrays)})
    with np.load(io.BytesIO(buffer.getvalue()), allow_pickle=False) as file:
        arrays = [file[f"a{k}"] for k in range(len(snapshot.arrays))]
    return Snapshot(json.loads(json.dumps(snapshot.outline)), arrays)


def advanced(context, group, phase, steps):
    return advance(context, Chunk(group, phase, steps, math.inf, steps))


def same(one, other):
    return (one.dtype, one.shape, one.tobytes()) == (other.dtype, other.shape, other.tobytes())


@pytest.mark.parametrize("name", SAMPLERS)
def test_going_on_from_files_is_bitwise_going_on(name):
    """Seven steps at a time, every part from a file and with a setting of its own, as another process has it."""
    whole, group = [], begun(setting_of(name))
    for phase, steps in (("warmup", WARMUP), ("draws", DRAWS)):
        done = advanced(setting_of(name), group, phase, steps)
        group = done.group_state.group
        whole.append(done)
    group, learnt = begun(setting_of(name)), {}
    for phase, steps, expected in zip(("warmup", "draws"), (WARMUP, DRAWS), whole, strict=True):
        for first in range(0, steps, 7):
            stop = min(first + 7, steps)
            done = advanced(setting_of(name), through_a_file(group), phase, stop - first)
            group, learnt = done.group_state.group, done.group_state.learnt
            part = expected.steps.part(first, stop)
            assert same(done.steps.position, part.position)
            assert done.steps.stats.keys() == part.stats.keys()
            assert all(same(done.steps.stats[key], part.stats[key]) for key in part.stats)
            assert done.group_state.done[phase] == stop
    assert learnt == whole[-1].group_state.learnt
    assert len(group.arrays) == len(whole[-1].group_state.group.arrays)


@pytest.mark.parametrize("name", SAMPLERS)
def test_what_has_been_learnt_halfway_comes_back(name):
    context = setting_of(name)
    group = advanced(context, begun(context), "warmup", WARMUP // 2).group_state.group
    again = taken(restored(through_a_file(group), context.given()), context.given())
    assert again.outline == json.loads(json.dumps(group.outline))
    assert len(again.arrays) == len(group.arrays)
    assert all(same(one, other) for one, other in zip(again.arrays, group.arrays, strict=True))


def test_a_snapshot_stays_what_it_was():
    context = setting_of("hmc")
    group = advanced(context, begun(context), "warmup", 20).group_state.group
    before = [array.copy() for array in group.arrays]
    first, again = (advanced(context, group, "warmup", 20) for _ in range(2))
    assert same(first.steps.position, again.steps.position)
    assert all(same(one, other) for one, other in zip(group.arrays, before, strict=True))


def back(value, **given):
    return restored(through_a_file(taken(value, given)), given)


@pytest.mark.parametrize(
    "value",
    [
        None, True, 0, -7, 2**127 + 1, -(2**200), 0.1, -0.0, 5e-324, math.inf, -math.inf, "", "é\n\0", [], (), {},
        [1, "two", None], (1, (2.5, [3])), {"a": 1, 2: "b", (1, 2): 3}, [[1.5], [2.5, 3.5]],
    ],
    ids=repr,
)  # fmt: skip
def test_plain_values(value):
    found = back(value)
    assert found == value
    assert repr(found) == repr(value)


def test_nan():
    assert math.isnan(back(math.nan))


@pytest.mark.parametrize("kind", [np.float64, np.float32, np.int64, np.uint8, np.bool_])
def test_numpy_scalars_keep_their_kind(kind):
    found = back(kind(1))
    assert type(found) is kind
    assert found == 1


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
        found = back(array)
        assert same(found, array)
        assert found.flags.f_contiguous == array.flags.f_contiguous


def test_lists_of_arrays():
    alike = [np.arange(3.0) + k for k in range(4)]
    unlike = [np.zeros(2), np.zeros(3), np.zeros(2, dtype=int)]
    for arrays in (alike, unlike, [*alike, None]):
        found = back(arrays)
        assert isinstance(found, list)
        assert all(x is y or same(x, y) for x, y in zip(found, arrays, strict=True))
    assert len(taken(alike, {}).arrays) == 1
    found = back(alike)
    found.append(np.zeros(3))  # a tuner goes on with it


def test_generators_of_every_kind():
    for kind in (np.random.PCG64, np.random.MT19937, np.random.SFC64, np.random.Philox):
        rng = np.random.Generator(kind(7))
        rng.standard_normal(3)
        rng.integers(2**32, dtype=np.uint32)  # PCG64 keeps half a number for the next
        other = np.random.Generator(kind(0))
        other.bit_generator.state = back(rng.bit_generator.state)
        np.testing.assert_array_equal(other.standard_normal(5), rng.standard_normal(5))
        assert other.integers(2**32, dtype=np.uint32) == rng.integers(2**32, dtype=np.uint32)


def test_what_is_shared_stays_shared():
    metric, array = Metric(np.eye(2), 2), np.arange(3.0)
    found = back({"one": metric, "two": (metric, array), "three": [array, None]})
    assert found["one"] is found["two"][0]
    assert found["two"][1] is found["three"][0]
    assert found["one"] is not metric
    np.testing.assert_array_equal(found["one"].inverse, metric.inverse)
    other = Metric(np.eye(2), 2)
    apart = back([metric, other, array, array.copy()])
    assert apart[0] is not apart[1]
    assert apart[2] is not apart[3]


def test_short_lived_values_are_not_taken_for_each_other():
    """CPython gives the memory of a dead object, and so its id, to the next one."""

    class Fresh(dict):
        def items(self):
            return ((k, (Metric([k + 1.0], 1),)) for k in range(20))

    found = back(Fresh())
    assert [float(found[k][0].inverse[0, 0]) for k in range(20)] == [k + 1.0 for k in range(20)]


def test_what_is_given_is_named_and_not_copied():
    density = object()
    snapshot = taken([density, density], {"density": density})
    assert snapshot == ({"list": [{"given": "density"}] * 2}, [], ())
    other = object()
    assert restored(snapshot, {"density": other}) == [other, other]


IMPOSTOR = type("Metric", (), {})()
OBJECTS = np.array([None, {}], dtype=object)


@pytest.mark.parametrize(
    "thing",
    [SimpleNamespace(a=1), len, Slice, {1, 2}, b"bytes", 1j, IMPOSTOR, OBJECTS, [OBJECTS, OBJECTS]],
    ids=range(9),
)
def test_what_is_not_of_this_package_is_handed_on_but_never_written(thing):
    snapshot = taken({"deep": [thing, thing]}, {})
    assert not any(array.dtype.hasobject for array in snapshot.arrays)
    first, again = restored(snapshot, {})["deep"]
    assert first is thing or first == thing or all(one is other for one, other in zip(first, thing, strict=True))
    assert again is first or again == first
    state = SavedState("", "", GroupState(snapshot, {}, {}), {}, [], 0)
    with pytest.raises(ValueError, match="sampler: must be one of this package to be kept on disk"):
        packed_state(state)


@pytest.mark.parametrize(
    "outline",
    [
        {"object": "Popen", "has": {"args": "true"}},
        {"object": "Metric"},
        {"given": "nobody"},
        {"array": 3},
        {"again": 0},
        {"list": 3},
        {"no such kind": 1},
        {"dict": [[{"list": []}, 1]]},
    ],
    ids=str,
)
def test_what_is_no_snapshot_is_refused(outline):
    with pytest.raises(ValueError, match="snapshot: must be one of a sampler"):
        restored(Snapshot(outline, [np.zeros(2)]), {})
