"""What is read from a trace: parameters, draws, walkers, and the groups that not every trace has.

A trace of an older version, of another sampler or of a plain log-density lacks some groups and variables.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from fmu.types import FloatArray

if TYPE_CHECKING:
    import xarray as xr


def check_trace(trace: Any, origin: str = "trace") -> None:
    """Raise ValueError unless `trace` has what the analysis relies on; `origin` names it in the message."""
    needed = ("posterior", "sample_stats")
    missing = [group for group in needed if group not in getattr(trace, "children", {})]
    missing += [name for name in ("sampler", "walkers", "wall_s") if name not in getattr(trace, "attrs", {})]
    if missing:
        raise ValueError(f"{origin}: must be a trace written by fmu (it has no {', '.join(missing)})")


def parameter_names(trace: xr.DataTree) -> tuple[str, ...]:
    """Return the names of the sampled parameters, in the order of theta."""
    return tuple(str(name) for name in trace["posterior"].data_vars)


def parameter_draws(trace: xr.DataTree) -> FloatArray:
    """Return the retained draws, shape (chains, draws, ndim), SI units."""
    posterior = trace["posterior"]
    return np.stack(
        [posterior[name].transpose("chain", "draw").to_numpy() for name in parameter_names(trace)], axis=-1
    )


def walkers_of(trace: xr.DataTree) -> int:
    """Return the number of walkers a chain of the trace consists of."""
    return int(trace.attrs["walkers"])
