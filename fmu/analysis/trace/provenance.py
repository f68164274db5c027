"""Provenance of a trace: settings, versions, and a hash of everything that determines the draws."""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import platform
from collections.abc import Mapping
from datetime import UTC, datetime
from typing import TYPE_CHECKING

import numpy as np

from fmu.analysis.trace.densities import is_updating, names_of
from fmu.analysis.trace.reading import is_imported, parameter_names
from fmu.arguments import ArgumentError

if TYPE_CHECKING:
    import xarray as xr

    from fmu.samplers.loop.record import RunResult
    from fmu.types import LogDensity

PACKAGES = ("numpy", "scipy", "emcee", "arviz", "fmu")


def canonical_json(value: object) -> str:
    """Return `value` as canonical JSON: sorted keys, no spaces, shortest floats that round-trip.

    NumPy scalars and arrays become numbers and lists, and tuples become lists.

    Raises
    ------
    TypeError
        If `value` contains something that is neither JSON nor NumPy.
    """
    return json.dumps(value, sort_keys=True, separators=(",", ":"), default=_plain)


def _plain(value: object) -> object:
    """Convert a NumPy array or scalar to nested lists or a number. Raise TypeError for anything else."""
    if hasattr(value, "tolist"):
        return value.tolist()
    raise TypeError(f"a configuration must hold JSON values and NumPy arrays only (got {type(value).__name__})")


def describe_inputs(
    density: LogDensity, sampler: str, settings: Mapping[str, object], run: Mapping[str, object]
) -> dict[str, object]:
    """Return the inputs that determine the draws as a dict: problem, sampler, its settings, and run arguments."""
    describe = getattr(density, "configuration", None)
    problem = (
        describe()
        if describe is not None
        else {"density": type(density).__qualname__, "lower": density.lower, "upper": density.upper}
    )
    return {"problem": problem, "sampler": {"name": sampler, "settings": settings}, "run": dict(run)}


def configuration(result: RunResult, density: LogDensity, start: object = None) -> dict[str, object]:
    """Return everything that determines the draws of a run, as a dict.

    `start` describes the starting points of the chains if ``result.init`` does not.
    """
    run = {
        "draws": result.draws,
        "warmup": result.warmup_draws,
        "chains": result.chains,
        "groups": result.groups,
        "walkers": result.walkers,
        "seed": result.seed,
        "init": result.init if start is None else start,
    }
    return describe_inputs(density, result.sampler, result.settings, run)


def configuration_hash(settings: object) -> str:
    """Return the hexadecimal SHA-256 hash of `settings` as canonical JSON."""
    return hashlib.sha256(canonical_json(settings).encode()).hexdigest()


def check_problem(problem: LogDensity | None, trace: xr.DataTree, whose: str = "") -> None:
    """Raise ValueError if a problem is given that has other parameters or another posterior than `trace`.

    `whose` names the trace. An imported trace may not know its posterior, so that only its parameters count.
    """
    if problem is None:
        return
    if names_of(problem) != parameter_names(trace):
        rule = f"must have the parameters {whose}{parameter_names(trace)}"
        raise ArgumentError("problem", rule, names_of(problem))
    sampled = json.loads(trace.attrs["configuration"])["problem"]
    given = json.loads(canonical_json(describe_inputs(problem, "", {}, {})["problem"]))
    if sampled != given and not is_imported(trace):
        differ = sorted(key for key in sampled | given if sampled.get(key) != given.get(key))
        rule = f"must be the posterior {whose}that was sampled; they differ in {', '.join(differ)}"
        raise ArgumentError("problem", rule, advice=": sample again, or leave the problem out")


def versions() -> dict[str, str]:
    """Return the versions of Python and of all packages that affect the numbers, keyed by name."""
    return {"python": platform.python_version()} | {name: importlib.metadata.version(name) for name in PACKAGES}


def _solver(density: LogDensity) -> str:
    """Return the name of the library that factorises the full model's matrices, or "" if there are no matrices."""
    from fmu.fem.pairing.paired_structure import structure_of

    structure = structure_of(density.model.parts[0]) if is_updating(density) else None
    return "" if structure is None else structure.solver


def attributes(result: RunResult, density: LogDensity, start: object = None) -> dict[str, str | int | float]:
    """Return the root attributes of a trace, which are numbers or text, as netCDF requires.

    ``n_solves`` and ``n_gradients`` count the solves and gradients of the retained draws; ``warmup_n_solves`` and
    ``warmup_n_gradients`` count them for the warm-up. ``wall_s`` is the sampling time in seconds, warm-up
    included, and ``warmup_wall_s`` the time of the warm-up. ``created_at`` is the UTC time at which the attributes
    were made, and ``solver`` the library that factorises the full model's matrices.
    """
    settings = configuration(result, density, start)
    costs = {
        f"{prefix}{name}": int(np.sum(draws.stats.get(name, 0)))  # a warm-up of no steps has no statistics
        for prefix, draws in (("", result.posterior), ("warmup_", result.warmup))
        for name in ("n_solves", "n_gradients")
    }
    return {
        "problem": str(getattr(density, "name", type(density).__qualname__)),
        "sampler": result.sampler,
        "settings": canonical_json(result.settings),
        "learnt": canonical_json(result.learnt),
        "seed": result.seed,
        "draws": result.draws,
        "warmup": result.warmup_draws,
        "chains": result.chains,
        "groups": result.groups,
        "walkers": result.walkers,
        "init": result.init,
        "configuration": canonical_json(settings),
        "configuration_hash": configuration_hash(settings),
        "versions": canonical_json(versions()),
        "solver": _solver(density),
        "created_at": datetime.now(UTC).isoformat(timespec="seconds"),
        "wall_s": float(result.wall_s),
        "warmup_wall_s": float(result.warmup_wall_s),
        **costs,
    }
