"""Objects of this package as plain data and back: JSON and arrays, from which no code can come.

What a sampler has learnt so far lies in objects within objects, some of them shared. A snapshot keeps all of it to
the last bit: whoever goes on from one goes on exactly as the original would have. Objects that both sides have
anyway, the density above all, are named and not copied.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray


class Snapshot(NamedTuple):
    """Plain data.

    Attributes
    ----------
    outline : JSON value
        Numbers, texts, lists, and where which array belongs.
    arrays : list of ndarray
    others : tuple of object
        Objects that this package does not know, as they are: what a user's own sampler has learnt. With such ones
        a snapshot can be handed on, but not written down.
    """

    outline: Any
    arrays: list[NDArray[Any]]
    others: tuple[Any, ...] = ()


def taken(value: Any, given: Mapping[str, Any]) -> Snapshot:
    """Return a snapshot of `value`.

    Parameters
    ----------
    value : Any
        Numbers, texts, arrays, lists, tuples, dicts, and objects of the samplers made of these.
    given : mapping of str to object
        What is named in the snapshot instead of copied.
    """
    writer = _Writer(given)
    return Snapshot(writer.outline(value), writer.arrays, tuple(writer.others))


def restored(snapshot: Snapshot, given: Mapping[str, Any]) -> Any:
    """Return what `taken` took the snapshot of, with the objects `given` in place of their names.

    Raises
    ------
    ValueError
        If it is no such snapshot.
    """
    try:
        return _Reader(snapshot, given).value(snapshot.outline)
    except (KeyError, IndexError, TypeError, AttributeError) as error:
        raise ValueError(f"snapshot: must be one of a sampler ({type(error).__name__}: {error})") from error


class _Writer:
    def __init__(self, given: Mapping[str, Any]) -> None:
        self.arrays: list[NDArray[Any]] = []
        self.others: list[Any] = []
        self._given = {id(thing): name for name, thing in given.items()}
        self._seen: dict[int, int] = {}
        self._alive: list[Any] = []  # an id is of one object only as long as that lives

    def outline(self, value: Any) -> Any:
        if isinstance(value, np.generic):  # before the numbers: one kind is a float as well
            return {"scalar": self._stored(np.asarray(value))}
        if value is None or isinstance(value, bool | int | float | str):
            return value
        if id(value) in self._given:
            return {"given": self._given[id(value)]}
        if isinstance(value, list) and _are_alike(value):
            return {"rows": self._stored(np.stack(value))}
        if isinstance(value, list | tuple):
            kind = "list" if isinstance(value, list) else "tuple"
            return {kind: [self.outline(item) for item in value]}
        if isinstance(value, Mapping):
            return {"dict": [[self.outline(key), self.outline(item)] for key, item in value.items()]}
        return self._shared(value)

    def _shared(self, value: Any) -> Any:
        """Outline an array or an object, once however often it occurs."""
        if id(value) in self._seen:
            return {"again": self._seen[id(value)]}
        self._seen[id(value)] = len(self._seen)
        self._alive.append(value)
        if isinstance(value, np.ndarray) and not value.dtype.hasobject:
            return {"array": self._stored(value)}
        name = type(value).__name__
        if _classes().get(name) is not type(value):
            return self._other(value)
        return {"object": name, "has": {key: self.outline(item) for key, item in vars(value).items()}}

    def _other(self, value: Any) -> Any:
        self.others.append(value)
        return {"other": len(self.others) - 1}

    def _stored(self, array: NDArray[Any]) -> int:
        self.arrays.append(array)
        return len(self.arrays) - 1


class _Reader:
    def __init__(self, snapshot: Snapshot, given: Mapping[str, Any]) -> None:
        self._arrays, self._others, self._given = snapshot.arrays, snapshot.others, given
        self._seen: list[Any] = []

    def value(self, outline: Any) -> Any:
        if not isinstance(outline, dict):
            return outline
        kind, content = next(iter(outline.items()))
        if kind == "given":
            return self._given[content]
        if kind == "scalar":
            return self._arrays[content][()]
        if kind == "rows":
            return list(self._arrays[content])
        if kind == "list":
            return [self.value(item) for item in content]
        if kind == "tuple":
            return tuple(self.value(item) for item in content)
        if kind == "dict":
            return {self.value(key): self.value(item) for key, item in content}
        if kind == "again":
            return self._seen[content]
        if kind == "other":
            self._seen.append(self._others[content])
            return self._seen[-1]
        if kind == "array":
            self._seen.append(self._arrays[content])
            return self._seen[-1]
        made: Any = object.__new__(_classes()[content])
        self._seen.append(made)
        for key, item in outline["has"].items():
            object.__setattr__(made, key, self.value(item))  # also of a frozen dataclass
        return made


def _are_alike(values: list[Any]) -> bool:
    """Say whether these are arrays that can be stored as rows of one."""
    first = values[0] if values else None
    return isinstance(first, np.ndarray) and all(
        isinstance(v, np.ndarray) and not v.dtype.hasobject and v.shape == first.shape and v.dtype == first.dtype
        for v in values
    )


@cache
def _classes() -> dict[str, type]:
    """Return the classes whose objects a snapshot may hold, by name."""
    from fmu.samplers import kernel, metropolis, proposals
    from fmu.samplers import slice as slices
    from fmu.samplers.adaptation import learner
    from fmu.samplers.adaptation import schedule as warmup
    from fmu.samplers.hmc import gradient, metric
    from fmu.samplers.hmc import hmc as hamiltonian
    from fmu.samplers.tempering import density as tempered
    from fmu.samplers.tempering import kernel as tempering_kernel
    from fmu.samplers.tempering import replicas, rungs, tempering

    known = (
        kernel.State, kernel.Info, replicas.TemperedState, replicas.TemperedInfo, tempered.Points,
        tempered.PriorAndLikelihood, warmup.Schedule, warmup.DualAveraging, warmup.PooledMoments, learner.Learner,
        hamiltonian.HamiltonianTuner, slices.SliceTuner, metropolis.Search, metropolis.MetropolisTuner,
        tempering.LadderTuner, metric.Metric, metric.MetricOfChains, gradient.ExactGradient,
        gradient.CentralDifference, proposals.RandomWalk, proposals.LogNormalWalk, proposals.Independence,
        rungs.RandomWalks, hamiltonian.HamiltonianMonteCarlo, hamiltonian.HamiltonianKernel, slices.Slice,
        slices.SliceKernel, metropolis.MetropolisHastings, metropolis.MetropolisKernel, tempering.Tempering,
        tempering_kernel.TemperingKernel,
    )  # fmt: skip
    return {kind.__name__: kind for kind in known}
