"""Read parameters, draws, walkers and optional groups from a trace.

Some groups and variables are missing in traces of older versions, of other samplers and of plain log-densities.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from fmu.plain_data import mapping_in
from fmu.types import AnyArray, BoolArray, FloatArray

if TYPE_CHECKING:
    import xarray as xr


MANY = 30
"""Largest number of parameters for which a table or a figure includes test scores."""
LOSSES = "loss"
"""Name of the trace group with parameter losses between groups of tests."""
VALUE_KINDS = ("shared", "test", "group", "mean")
"""Kinds of roles of the parameters that are values of structural parameters; see `roles_of`."""
IMPORTED = "imported"
"""Trace attribute that names the other library that made the draws."""


def check_trace(trace: object, origin: str = "trace") -> None:
    """Raise ValueError unless `trace` has the groups and attributes that the analysis needs.

    The message calls the trace `origin`.
    """
    needed = ("posterior", "sample_stats")
    children, attrs = (getattr(trace, name, {}) for name in ("children", "attrs"))
    missing = [group for group in needed if group not in children]
    missing += [name for name in ("sampler", "walkers", "wall_s") if name not in attrs]
    if missing:
        raise ValueError(f"{origin}: must be a trace written by fmu (it has no {', '.join(missing)})")


def has(trace: xr.DataTree, group: str, variable: str | None = None) -> bool:
    """Return True if a trace contains a group and, if given, a variable in this group."""
    return group in trace.children and (variable is None or variable in trace[group])


def is_pseudo(trace: xr.DataTree) -> bool:
    """Return True if the likelihood is the modal residual, which is not a probability density of the data."""
    return has(trace, "log_likelihood", "residual")


def array_of(trace: xr.DataTree, group: str, variable: str) -> AnyArray:
    """Return a variable of a trace group as an array of shape (chains, draws, ...)."""
    # .variables[…] takes 1 % of the time of [group][variable] where a group has a thousand variables
    return trace[group].variables[variable].transpose("chain", "draw", ...).to_numpy()


def problem_of(trace: xr.DataTree) -> dict[str, Any]:
    """Return the configuration of the sampled problem (`UpdatingProblem.configuration`) from a trace.

    If the sampled density was not an UpdatingProblem, return the description of it that the trace stores. The dict
    is empty if the trace stores neither.
    """
    found = json.loads(str(trace.attrs.get("configuration", "{}"))).get("problem")
    return dict(mapping_in(found) or {})


def with_group(trace: xr.DataTree, group: str, dataset: xr.Dataset) -> xr.DataTree:
    """Return a copy of the trace with a group added or replaced.

    The copy shares the other arrays with the original.
    """
    import xarray as xr

    extended = trace.copy()
    extended[group] = xr.DataTree(dataset)
    return extended


def parameter_names(trace: xr.DataTree) -> tuple[str, ...]:
    """Return the names of the sampled parameters, in the order of theta."""
    return tuple(str(name) for name in trace["posterior"].data_vars)


def told_names(trace: xr.DataTree) -> tuple[str, ...]:
    """Return the names of the parameters to show in tables and figures.

    Test scores of populations are left out if there are more than `MANY` parameters.
    """
    names = parameter_names(trace)
    scores = set(score_names(trace))
    chosen = tuple(name for name in names if name not in scores)
    return chosen if len(names) > MANY and chosen else names


def roles_of(trace: xr.DataTree) -> dict[str, tuple[str, str, str]]:
    """Return each parameter's role in a problem with several tests, keyed by parameter name.

    A role has three parts: the kind, the structural parameter, and the test, group or covariate; see
    `fmu.posterior.joint.varies.base.Role`. The dict is empty if the problem has a single test.
    """
    if not has(trace, "constant_data", "role"):
        return {}
    columns = (trace["constant_data"][name].to_numpy().astype(str) for name in ("role", "role_of", "role_where"))
    rows = zip(*(column.tolist() for column in columns), strict=True)
    return dict(zip(trace["constant_data"]["parameter"].to_numpy().astype(str).tolist(), rows, strict=True))


def later_states(trace: xr.DataTree) -> list[str]:
    """Return the names of the structure's states after the reference state, from a trace with losses."""
    return [str(state) for state in trace[LOSSES]["state"].to_numpy().tolist()]


def is_relative_loss(trace: xr.DataTree, name: str) -> bool:
    """Return True if a parameter is a relative loss, in a group of tests or since an event."""
    return roles_of(trace).get(name, ("",))[0] == "loss"


def is_loss(trace: xr.DataTree, name: str) -> bool:
    """Return True if a parameter is a loss in a later state of the structure, or a value in such a state."""
    kind, _, where = roles_of(trace).get(name, ("", "", ""))
    return kind in ("loss", "group") and has(trace, LOSSES) and where in later_states(trace)


def score_names(trace: xr.DataTree) -> list[str]:
    """Return the names of the test scores: each test's standardised deviation from a population mean."""
    return [name for name, (kind, *_) in roles_of(trace).items() if kind == "score"]


def sds_of_population(trace: xr.DataTree, name: str) -> dict[str, str]:
    """Return the names of the population standard deviations of parameter `name`, keyed by group of tests.

    The key is ``""`` if all tests share one standard deviation. The dict is empty if the parameter has no
    population.
    """
    every = [(where, k) for k, (kind, of, where) in roles_of(trace).items() if kind == "sd" and of == name]
    return {where: k for where, k in every if where} or dict(every[:1])


def without_scores(trace: xr.DataTree) -> xr.DataTree:
    """Return the trace with only the parameters of `told_names`. The group ``tests`` is unchanged."""
    chosen = list(told_names(trace))
    if len(chosen) == len(parameter_names(trace)):
        return trace
    groups = {name: node.to_dataset() for name, node in trace.children.items()}
    for name in ("posterior", "warmup_posterior", "prior"):
        if name in groups:
            groups[name] = groups[name][chosen]
    groups["constant_data"] = groups["constant_data"].sel(parameter=chosen)
    found = type(trace).from_dict(groups)
    found.attrs = trace.attrs
    return found


def parameter_units(trace: xr.DataTree) -> tuple[str, ...]:
    """Return the units of the sampled parameters, in the order of theta; "" for a dimensionless parameter."""
    variables = trace["posterior"].variables
    return tuple(str(variables[name].attrs.get("units", "")) for name in parameter_names(trace))


def parameter_draws(trace: xr.DataTree) -> FloatArray:
    """Return the retained draws in SI units, shape (chains, draws, ndim)."""
    return np.stack([array_of(trace, "posterior", name) for name in parameter_names(trace)], axis=-1)


def columns_of(trace: xr.DataTree, names: Iterable[str]) -> list[int]:
    """Return the index of each named parameter on the last axis of `parameter_draws`.

    Raise ValueError if the trace has no parameter of a name.
    """
    known = parameter_names(trace)
    return [known.index(name) for name in names]


def constant(trace: xr.DataTree, which: str, name: str) -> float:
    """Return the ``"lower"`` bound, ``"upper"`` bound or ``"start"`` value of a parameter in SI units.

    Return NaN if the trace does not store this value.
    """
    return (
        float(trace["constant_data"][which].sel(parameter=name)) if has(trace, "constant_data", which) else np.nan
    )


def in_solves[Count: (float, FloatArray)](trace: xr.DataTree, n_solves: Count, n_gradients: Count) -> Count:
    """Convert a cost to solves: the number of log-probability evaluations that take the same time.

    An exact gradient, which is also counted as one solve, costs as much as ``trace.attrs["gradient_cost"]``
    solves. This ratio was measured at the end of the run; in a trace without it, a gradient costs one solve.
    """
    return n_solves + (float(trace.attrs.get("gradient_cost", 1.0)) - 1.0) * n_gradients


def used_modes(trace: xr.DataTree) -> BoolArray:
    """Return a mask of the measured modes that were used in updating, shape (n_modes,)."""
    observed = trace["observed_data"]
    return np.asarray(observed["used"] if "used" in observed else np.ones(observed.sizes["mode"], dtype=bool))


def modes_are_data(trace: xr.DataTree) -> bool:
    """Return True if any measured mode was used in updating, False if only other data (such as FRFs) were used."""
    return bool(used_modes(trace).any())


def mode_names(trace: xr.DataTree) -> list[str]:
    """Return the names of the measured modes. If only some were used in updating, the others are marked."""
    labels, are_data = trace["observed_data"]["mode"].to_numpy(), modes_are_data(trace)
    return [
        str(label) if used or not are_data else f"{label} (not used)"
        for label, used in zip(labels, used_modes(trace), strict=True)
    ]


def walkers_of(trace: xr.DataTree) -> int:
    """Return the number of walkers in each ensemble; 1 for a sampler with ordinary chains."""
    return int(trace.attrs["walkers"])


def is_imported(trace: xr.DataTree) -> bool:
    """Return True if another library made the draws, so that fmu's commands and options do not apply."""
    return IMPORTED in trace.attrs
