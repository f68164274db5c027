"""Datasets 55, 15 and 2411 of universal files as pyuff reads them, once they are what they say.

pyuff takes any number of values for what a header announces, and says only that it cannot read a dataset, not why.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from fmu.formats.modes.measured_modes import ModesError
from fmu.formats.shown import in_words

SHAPES, NODES = 55, (15, 2411)
REAL, COMPLEX = (2,), (3, 7)
"""Analysis types: normal modes; complex eigenvalues of first and second order."""
MOST_DATASETS = 10_000
LARGEST_DATASET = 2**23
"""Bytes: some 150 000 nodes."""
_MOTION = (0, 1, 8, 11, 12)
"""Specific data types: unknown, general, displacement, velocity, acceleration."""
_TAG = b"    -1"


@contextmanager
def imported_pyuff() -> Iterator[Any]:
    """Give pyuff, without its warnings of what it uses itself."""
    try:
        import pyuff
    except ImportError:
        raise ImportError("universal files need pyuff: install fmu[uff]") from None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        yield pyuff


def datasets(path: Path) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Return the datasets with modes, and those with nodes.

    Raises
    ------
    ImportError
        If pyuff is not installed.
    ModesError
        If the file is no universal file, or too large, or datasets are not as their headers say.
    """
    content = path.read_bytes()
    if content.count(_TAG) > 2 * MOST_DATASETS:
        raise ModesError(path.name, [f"must have at most {MOST_DATASETS} datasets"])
    kinds = [[str(kind).encode()] for kind in (SHAPES, *NODES)]
    if any(len(part) > LARGEST_DATASET and part[:99].split()[:1] in kinds for part in content.split(_TAG)):
        raise ModesError(path.name, [f"must have modes and nodes in datasets of at most {LARGEST_DATASET} bytes"])
    with imported_pyuff() as pyuff:
        try:
            file = pyuff.UFF(str(path))
            types = [int(kind) for kind in file.get_set_types()]
        except Exception as error:  # pyuff raises no other kind
            raise ModesError(path.name, [f"must be a universal file ({in_words(error)})"]) from error
        if not types:
            raise ModesError(path.name, ["must be a universal file (it has no dataset)"])
        read, found = {}, []
        for i, kind in enumerate(types):
            if kind in (SHAPES, *NODES):
                try:
                    read[i] = file.read_sets(i)
                    found += [f"dataset {i + 1}: {rule}" for rule in _wrong(read[i])]
                except Exception:
                    where = f"its dataset {i + 1}, of type {kind}"
                    found.append(f"must be a universal file ({where}, has lines of another format)")
    if found:
        raise ModesError(path.name, found)
    sets = [one for i, one in read.items() if types[i] == SHAPES and one["analysis_type"] in REAL + COMPLEX]
    return sets, [one for i, one in read.items() if types[i] in NODES]


def _wrong(one: Mapping[str, Any]) -> list[str]:
    """Say what is wrong with what pyuff made of a dataset: it takes whatever number of values there is."""
    if one["type"] in NODES:
        lengths = {len(one[key]) for key in ("node_nums", "x", "y", "z")}
        if len(lengths) > 1 or not np.all(np.isfinite(one["node_nums"])):
            return ["must have a number and three coordinates a node"]
        return []
    if one["analysis_type"] not in REAL + COMPLEX:
        return []
    frequency = "freq" if one["analysis_type"] in REAL else "eig"
    found = (
        [f"must have a whole mode number (got {one.get('mode_n')})"] if not _is_whole(one.get("mode_n")) else []
    )
    if not np.isfinite(one.get(frequency, np.nan)):
        found.append(f"must have a finite frequency or eigenvalue (got {one.get(frequency)})")
    if one["spec_data_type"] not in _MOTION:
        found.append(
            f"shapes must be of displacement, velocity or acceleration (got type {one['spec_data_type']})"
        )
    most = 6 if one["data_type"] == 2 else 3
    if one["data_type"] not in (2, 5) or one["n_data_per_node"] not in (3, most):
        found.append(
            "must have real data (type 2) of 3 or 6 values a node, or complex data (type 5) of 3 "
            f"(got type {one['data_type']} of {one['n_data_per_node']})"
        )
    elif {len(one.get(f"r{i + 1}", ())) for i in range(one["n_data_per_node"])} != {len(one["node_nums"])}:
        found.append(f"must have {one['n_data_per_node']} values at each of its {len(one['node_nums'])} nodes")
    return found


def _is_whole(number: Any) -> bool:
    return isinstance(number, int | np.integer) or (isinstance(number, float) and number.is_integer())
