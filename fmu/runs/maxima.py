"""Save a run's posterior maxima, so that a resumed run need not search for them again."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fmu.analysis.maxima.results import Maxima
    from fmu.posterior.problem import UpdatingProblem

FILE = "maxima.nc"


def keep_maxima(directory: Path, maxima: Maxima, problem: UpdatingProblem) -> None:
    """Write the maxima and a hash of the posterior to a directory."""
    import xarray as xr

    from fmu.analysis.convergence.diagnosis import with_maxima
    from fmu.analysis.trace.conversion import save_trace

    tree = with_maxima(xr.DataTree(), maxima)
    tree.attrs["posterior"] = _posterior(problem)
    save_trace(tree, directory / FILE)


def kept_maxima(directory: str | os.PathLike[str], problem: UpdatingProblem | None = None) -> Maxima | None:
    """Return the saved maxima, or None if the file is missing or damaged.

    If `problem` is given, also return None if the maxima belong to a different posterior.
    """
    from fmu.analysis.convergence.diagnosis import maxima_of
    from fmu.analysis.trace.netcdf import from_netcdf

    path = Path(directory, FILE)
    if not path.is_file():
        return None
    try:
        tree = from_netcdf(path)
        is_other = problem is not None and tree.attrs["posterior"] != _posterior(problem)
        return None if is_other else maxima_of(tree)
    except (OSError, ValueError, KeyError):  # the file is damaged
        return None


def _posterior(problem: UpdatingProblem) -> str:
    """Return a hash of the data that define the posterior."""
    from fmu.analysis.trace.provenance import configuration_hash, describe_inputs

    return configuration_hash(describe_inputs(problem, "", {}, {})["problem"])
