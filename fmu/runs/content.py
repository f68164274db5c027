"""The files in a checkpoint: steps in HDF5, and the state of each chain group as NumPy arrays with JSON data."""

from __future__ import annotations

import io
import json
import re
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fmu.durable_files import DamagedError, add_checksum, digest, payload_of
from fmu.plain_data import mapping_in
from fmu.posterior.failures import Failure
from fmu.samplers.loop.group import GroupState
from fmu.samplers.loop.record import Steps
from fmu.types import AnyArray

TITLE = "fmu state 3"
_EARLIER = (b"fmu state 1\n", b"fmu state 2\n")


class Segment(NamedTuple):
    """One step file, as listed in a saved state.

    Attributes
    ----------
    name : str
        Name of the file.
    sha256 : str
        Checksum of the file's content.
    phase : str
    first, steps : int
        Index of the first step in the phase, and number of steps.
    solves, failed : int
        Number of solves for the steps, and number of failed solves, which gave no finite log-density.
    """

    name: str
    sha256: str
    phase: str
    first: int
    steps: int
    solves: int
    failed: int


class SavedState(NamedTuple):
    """State of a group of chains when it was saved.

    Attributes
    ----------
    configuration : str
        Hash of all the data that determine the draws.
    arithmetic : str
        CPU and BLAS types, on which the last bits of the draws depend.
    group_state : GroupState
    elapsed_s : mapping of str to float
        Time in s that each phase of the run has taken.
    segments : list of Segment
        The step files written so far.
    total : int
        Total number of steps in the current phase, for ``fmu watch``.
    """

    configuration: str
    arithmetic: str
    group_state: GroupState
    elapsed_s: Mapping[str, float]
    segments: list[Segment]
    total: int


def packed_steps(steps: Steps, failures: Sequence[Failure]) -> bytes:
    """Return steps, and the points at which solves failed during these steps, as the bytes of an HDF5 file."""
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
    """Return text that HDF5 can store: NUL and invalid Unicode, which users' messages may contain, are escaped."""
    return text.replace("\0", "\\0").encode("utf-8", "backslashreplace").decode()


def unpacked_steps(content: bytes) -> Steps:
    """Read the steps from the bytes that `packed_steps` returned."""
    import h5py

    with h5py.File(io.BytesIO(content), "r") as file:
        return Steps(file["position"][()], {name: values[()] for name, values in file["stats"].items()})


def unpacked_failures(content: bytes) -> list[Failure]:
    """Read the failures, if there are any, from the bytes that `packed_steps` returned."""
    import h5py

    with h5py.File(io.BytesIO(content), "r") as file:
        if "failures" not in file:
            return []
        reasons = file["failures/reason"].asstr()[()]
        return [Failure(theta, str(why)) for theta, why in zip(file["failures/theta"][()], reasons, strict=True)]


def packed_state(state: SavedState) -> bytes:
    """Return a state as the bytes of a zip file of NumPy arrays. All other data are JSON in one of the arrays.

    Raises
    ------
    ValueError
        If the sampler's state contains an object that can be saved neither as an array nor as JSON.
    """
    outline = state._asdict()
    outline["group_state"], arrays = _apart(state.group_state.tree())
    try:
        arrays["outline"] = np.frombuffer(json.dumps(outline).encode(), dtype=np.uint8)
    except TypeError as error:
        raise ValueError(
            f"sampler: its state must be arrays, numbers and strings to be saved ({error})"
        ) from error
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)  # type: ignore[arg-type]
    return buffer.getvalue()


def unpacked_state(payload: bytes) -> SavedState:
    """Read the state from the bytes that `packed_state` returned; raise DamagedError if they are damaged."""
    try:
        with np.load(io.BytesIO(payload), allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        outline = json.loads(arrays.pop("outline").tobytes())
        group_state = GroupState.of_tree(_together(outline.pop("group_state"), arrays))
        segments = [Segment(*segment) for segment in outline.pop("segments")]
        return SavedState(group_state=group_state, segments=segments, **outline)
    except (OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile) as error:
        raise DamagedError(f"it contains no state ({error})") from error


def numbered_files(directory: Path, kind: str) -> list[tuple[int, Path]]:
    """Return the files or directories of one kind in a directory, such as ``state-000007``, sorted by number."""
    matches = ((re.fullmatch(rf"{kind}-(\d+)", path.name), path) for path in directory.glob(f"{kind}-*"))
    return sorted((int(match[1]), path) for match, path in matches if match)


def state_file(state: SavedState) -> bytes:
    """Return a state file's content: the state and its checksum."""
    return add_checksum(TITLE, packed_state(state))


def read_state(path: Path) -> SavedState:
    """Read the state from a file.

    Raises
    ------
    DamagedError
        If the content has changed since the file was written.
    OSError
        If the file cannot be read.
    ValueError
        If an earlier version of fmu wrote the file.
    """
    content = path.read_bytes()
    if content.startswith(_EARLIER):
        raise ValueError(
            f"checkpoint: {path} was written by an earlier version of fmu and cannot be resumed by this one; "
            "finish the run with that version, or use another directory"
        )
    return unpacked_state(payload_of(TITLE, content))


def read_segment(directory: Path, segment: Segment) -> bytes:
    """Return the bytes of a step file; raise DamagedError if the file cannot be read or has changed."""
    try:
        content = (directory / segment.name).read_bytes()
    except OSError as error:
        raise DamagedError(f"{segment.name} cannot be read: {error.strerror}") from error
    if digest(content) != segment.sha256:
        raise DamagedError(f"the checksum of {segment.name} is wrong")
    return content


def _apart(tree: Mapping[str, object], path: str = "") -> tuple[dict[str, object], dict[str, AnyArray]]:
    """Split a tree into its arrays and the rest; return the rest, and the arrays keyed by path.

    A path is written like ``state/position``.
    """
    plain: dict[str, object] = {}
    arrays: dict[str, AnyArray] = {}
    for name, value in tree.items():
        table = mapping_in(value)
        if table is not None:
            plain[name], inner = _apart(table, f"{path}{name}/")
            arrays |= inner
        elif isinstance(value, np.ndarray | np.generic) and not value.dtype.hasobject:
            arrays[path + name] = np.asarray(value)
        else:
            plain[name] = value
    return plain, arrays


def _together(plain: dict[str, Any], arrays: Mapping[str, AnyArray]) -> dict[str, Any]:
    """Reassemble the tree that `_apart` has split into `plain` and `arrays`."""
    for path, array in arrays.items():
        *folders, name = path.split("/")
        tree = plain
        for folder in folders:
            tree = tree[folder]
        tree[name] = array
    return plain
