"""What the files of a checkpoint hold: steps as HDF5; where a group of chains stands, as arrays and an outline."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from fmu.durable_files import DamagedError
from fmu.posterior.failures import Failure
from fmu.samplers.loop.group import GroupState
from fmu.samplers.loop.record import Steps
from fmu.samplers.loop.snapshot import Snapshot


class Segment(NamedTuple):
    """A file of steps.

    Attributes
    ----------
    name : str
    sha256 : str
        Of its content.
    phase : str
    first, steps : int
        Number of the first step in the phase, and how many there are.
    solves, failed : int
        What they cost, and how many of these solves gave no finite log-density.
    """

    name: str
    sha256: str
    phase: str
    first: int
    steps: int
    solves: int
    failed: int


class SavedState(NamedTuple):
    """What is known of a group of chains when it is kept.

    Attributes
    ----------
    configuration : str
        Hash of what determines the draws.
    arithmetic : str
        What their last bits depend on.
    group_state : GroupState
    elapsed_s : mapping of str to float
        What the phases of the run have taken.
    segments : list of Segment
        All steps so far.
    total : int
        Steps of the phase, for who looks on.
    """

    configuration: str
    arithmetic: str
    group_state: GroupState
    elapsed_s: Mapping[str, float]
    segments: list[Segment]
    total: int


def packed_steps(steps: Steps, failures: Sequence[Failure]) -> bytes:
    """Return an HDF5 file of steps, and of the points that failed on the way."""
    import h5py

    buffer = io.BytesIO()
    with h5py.File(buffer, "w") as file:
        file["position"] = steps.position
        for name, values in steps.stats.items():
            file[f"stats/{name}"] = values
        if failures:
            file["failures/theta"] = np.array([failure.theta for failure in failures], dtype=float)
            file["failures/reason"] = [failure.reason for failure in failures]
    return buffer.getvalue()


def writable(text: str) -> str:
    """Return a text as files can hold it: what a user's program says may be no Unicode, or hold a zero."""
    return text.replace("\0", "\\0").encode("utf-8", "backslashreplace").decode()


def unpacked_steps(content: bytes) -> Steps:
    """Return the steps of such a file."""
    import h5py

    with h5py.File(io.BytesIO(content), "r") as file:
        return Steps(file["position"][()], {name: values[()] for name, values in file["stats"].items()})


def unpacked_failures(content: bytes) -> list[Failure]:
    """Return the points that failed on the way."""
    import h5py

    with h5py.File(io.BytesIO(content), "r") as file:
        if "failures" not in file:
            return []
        reasons = file["failures/reason"].asstr()[()]
        return [Failure(theta, str(why)) for theta, why in zip(file["failures/theta"][()], reasons, strict=True)]


def packed_state(state: SavedState) -> bytes:
    """Return a state as bytes: NumPy arrays in a zip file, one of them the outline as JSON.

    Raises
    ------
    ValueError
        If it holds objects that are not of this package.
    """
    group_state = state.group_state
    if group_state.group.others:
        kind = type(group_state.group.others[0])
        raise ValueError(f"sampler: must be one of this package to be kept on disk (got {kind!r})")
    outline = {
        "configuration": state.configuration,
        "arithmetic": state.arithmetic,
        "group": group_state.group.outline,
        "done": dict(group_state.done),
        "learnt": group_state.learnt,
        "elapsed_s": dict(state.elapsed_s),
        "segments": state.segments,
        "total": state.total,
    }
    arrays = {f"group{k}": array for k, array in enumerate(group_state.group.arrays)}
    arrays["outline"] = np.frombuffer(json.dumps(outline).encode(), dtype=np.uint8)
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)  # type: ignore[arg-type]
    return buffer.getvalue()


def unpacked_state(payload: bytes) -> SavedState:
    """Return the state; DamagedError if the bytes are none."""
    try:
        with np.load(io.BytesIO(payload), allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        outline = json.loads(arrays.pop("outline").tobytes())
        group = Snapshot(outline["group"], [arrays[f"group{k}"] for k in range(len(arrays))])
        group_state = GroupState(group, outline["done"], outline["learnt"])
        segments = [Segment(*segment) for segment in outline["segments"]]
        return SavedState(
            outline["configuration"],
            outline["arithmetic"],
            group_state,
            outline["elapsed_s"],
            segments,
            outline["total"],
        )
    except (OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile) as error:
        raise DamagedError(f"it holds no state ({error})") from error
