"""The maxima of a posterior, saved with a run so that they are not searched for again when it is resumed."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fmu.analysis.maxima.results import Maxima

FILE = "maxima.nc"


def keep_maxima(directory: Path, maxima: Maxima, problem: Any = None) -> None:
    """Write the maxima into a directory, with a hash of the posterior if the problem is given."""
    import xarray as xr

    from fmu.analysis.convergence.diagnosis import with_maxima
    from fmu.analysis.trace.conversion import save_trace

    tree = with_maxima(xr.DataTree(), maxima)
    tree.attrs["posterior"] = _posterior(problem)
    save_trace(tree, directory / FILE)


def kept_maxima(directory: Path, problem: Any = None) -> Maxima | None:
    """Return what `keep_maxima` wrote; None if there is nothing, or it is damaged or of another posterior."""
    import xarray as xr

    from fmu.analysis.convergence.diagnosis import maxima_of

    path = directory / FILE
    if not path.is_file():
        return None
    try:
        tree = xr.load_datatree(path, engine="h5netcdf")
        return maxima_of(tree) if tree.attrs["posterior"] == _posterior(problem) else None
    except (OSError, ValueError, KeyError):  # damaged
        return None


def searched(problem: Any, directory: str | os.PathLike[str] | None) -> Maxima:
    """Return the maxima of an updating problem: those saved in a directory, or searched for if there are none."""
    from fmu.analysis.maxima.search import find_map

    kept = None if directory is None else kept_maxima(Path(directory), problem)
    return find_map(problem) if kept is None else kept


def _posterior(problem: Any) -> str:
    """Return a hash of what defines the posterior; empty if there is no problem."""
    from fmu.analysis.trace.provenance import configuration_hash, described

    return "" if problem is None else configuration_hash(described(problem, "", {}, {})["problem"])
