"""Read measured frequency response functions from files."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from annotated_types import Ge, Gt
from numpy.typing import ArrayLike

from fmu.arguments import ArgumentError, OwnRule, check_arguments
from fmu.formats.frf.measured_frfs import Wanted
from fmu.formats.frf.read import read_frfs
from fmu.posterior.data.frf_data import FRFData, FRFKind
from fmu.types import Positive


@check_arguments
def read_frf(
    path: str | os.PathLike[str],
    *,
    kind: FRFKind | None = None,
    drives: tuple[tuple[Any, str], ...] | None = None,
    responses: tuple[tuple[Any, str], ...] | None = None,
    nodes: Mapping[int, Any] | None = None,
    variables: Mapping[str, str] | None = None,
    frfs: Sequence[Annotated[int, Ge(1)]] | None = None,
    scale: Positive = 1.0,
    averages: Annotated[float, Gt(1.0)] | None = None,
    sd: ArrayLike | None = None,
    use: Annotated[ArrayLike | None, OwnRule()] = None,
    band: tuple[float, float] | None = None,
    window: tuple[str, Positive] | None = None,
) -> FRFData:
    """Read frequency response functions (FRFs) from a file.

    ======================================  =============================================================
    ``.uff``, ``.unv``, ``.bunv``, ``.uf``  universal files, dataset 58: needs the package pyuff
    ``.csv``, ``.tsv``, ``.txt``            text tables: see `fmu.formats.frf.table`
    ``.npz``                                NumPy arrays: see `fmu.formats.frf.arrays`
    ``.mat``, ``.h5``, ``.hdf5``            MATLAB or HDF5 arrays: see `fmu.formats.frf.arrays`
    ======================================  =============================================================

    Parameters
    ----------
    path : path-like
    kind : {"receptance", "mobility", "accelerance", "dynamic-stiffness"}, optional
        Needed if the file does not state it; otherwise it must agree with the file.
    drives, responses : tuple of (place, direction), optional
        Points of all FRFs in the file, in file order; needed if the file does not name them. If `frfs` or `nodes`
        is also given, the points of FRFs that are not read are ignored.
    nodes : mapping of node number to place, optional
        For universal files: maps node numbers in the file to model nodes or their names; FRFs at other nodes are
        skipped. By default, the model's nodes have the same numbers as the nodes in the file.
    variables : mapping of str to str, optional
        For arrays: maps ``frequencies_hz``, ``values``, ``coherence``, ``sd``, ``averages``, ``kind``, ``drives``
        or ``responses`` to the name of this array in the file. Needed if the array has none of the usual names in
        `fmu.formats.frf.arrays`. The name ``"test.H"`` means the field H of a structure.
    frfs : sequence of int, optional
        Numbers of the FRFs to read, from 1 in file order. Defaults to all FRFs.
    scale : float
        Factor that converts the values and their sd in the file to SI units, such as 9.80665 for accelerations in
        g.
    averages : float, optional
        Number of independent averages behind the coherences in the file. Defaults to the number in the file; if
        there is none, the coherences are not used. It must not be given if there is an sd, which is used instead.
    sd, use, band, window : optional
        The attributes of `fmu.FRFData` with these names; `sd` is in SI units and replaces any sd in the file.

    Returns
    -------
    FRFData
        `notes` lists the properties that the file does not define, and data that were converted or not used.

    Raises
    ------
    ValueError
        If the ending of the file name is unknown, the file is broken, an FRF in `frfs` does not exist, a kind or
        points are missing, the kind contradicts the file, `nodes` or `variables` does not apply to the format,
        `averages` is given although there is an sd, `fmu.FRFData` rejects the data, or h5py is needed and not
        installed.
    FileNotFoundError, ImportError
        If the file does not exist, or it is a universal file and the package pyuff is not installed.
    """
    found = read_frfs(Path(path), Wanted(drives, responses, nodes, variables or {}, frfs))
    if kind is not None and found.kind not in (None, kind):
        raise ArgumentError("kind", f"must be {found.kind!r}, as the file says", repr(kind))
    said = kind or found.kind
    if said is None:
        raise ArgumentError("kind", "must be given, as the file does not say it", "None")
    if averages is not None and (sd is not None or found.sd is not None):
        rule = "must not be given together with an sd, here or in the file, which gives the errors; leave it out"
        raise ArgumentError("averages", rule, averages)
    notes, coherence = found.notes, found.coherence
    averages = averages or (None if coherence is None else found.averages)
    if averages is None and coherence is not None:
        notes += ("The coherences of the file are not used without averages, the number of averages behind them.",)
        coherence = None
    if sd is None and found.sd is not None:
        sd = found.sd * scale
    values, points = np.asarray(found.values) * scale, (found.drives, found.responses)
    lines = {"use": use, "band": band, "window": window}
    return FRFData(found.frequencies_hz, values, *points, said, sd, coherence, averages, notes=notes, **lines)  # type: ignore[arg-type]
