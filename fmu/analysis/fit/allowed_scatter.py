"""Describe a model discrepancy (such as scatter of parameters between modes), and say how to allow for one."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from fmu.analysis.fit.reweighting import estimated_scatter
from fmu.analysis.information import PRIOR, information
from fmu.analysis.trace.reading import problem_of
from fmu.numbers import fixed, names_in_words, significant

if TYPE_CHECKING:
    import xarray as xr

REMEDY = (
    "If no cause is found: fmu run FILE --discrepancy embedded (Python: discrepancy=fmu.Discrepancy()) allows for "
    "a model that is wrong, and widens the posterior and every prediction; --discrepancy all compares all kinds"
)
REMEDY_OF_FRFS = (
    'If a gain or a delay of a channel is the cause, gain_sd and delay_sd find it. A discrepancy of kind "modes" '
    '(Python: discrepancy=fmu.Discrepancy("modes", sd=0.02, correlation=0.0)) allows for a model whose modes are '
    "wrong, and widens the posterior and every prediction; model_sd for errors at single lines"
)
LEFT_TO_PRIOR = ": the data do not inform it and it keeps its prior, as if there are no more data than parameters"


def scatter_sentences(trace: xr.DataTree) -> tuple[str, ...]:
    """Return sentences on the size of each discrepancy, inferred or given, and on its inferred correlation.

    The tuple is empty if the model has no discrepancy.
    """
    problem = problem_of(trace)
    likelihood: Mapping[str, Any] = problem["likelihood"]
    noise, said = list(likelihood.get("noise", ())), []
    told = information(trace) if likelihood.get("discrepancy") else None
    left = {n for n, by in zip(told.names, told.basis, strict=True) if by == PRIOR} if told else set[str]()
    for one in likelihood.get("discrepancy", ()):
        if one["kind"] == "modes":
            said += _describe_modes(trace, one, noise)
            continue
        for number in dict.fromkeys(k for k in one["inferred"] if k >= 0):
            mine = [name for name, k in zip(one["names"], one["inferred"], strict=True) if k == number]
            sentence = _describe_inferred(trace, noise[number], mine, problem["parameters"])
            said.append(f"{sentence}{LEFT_TO_PRIOR if noise[number] in left else ''}")
        for tau in dict.fromkeys(tau for tau in one["tau"] if tau > 0):
            mine = [name for name, other in zip(one["names"], one["tau"], strict=True) if other == tau]
            size = significant(100.0 * tau, 2)
            said.append(f"{names_in_words(mine)}: a given scatter of {size} % over the modes")
        said += _describe_correlation(trace, one, noise)
    return tuple(said)


def remedy(trace: xr.DataTree) -> str:
    """Return sentences on how a model discrepancy can allow for the misfit, and on the effect that it would have.

    The text is empty if the model already has a discrepancy, or if its error model does not permit one.
    """
    responses = problem_of(trace).get("likelihood", {}).get("responses")
    if responses:
        return "" if "discrepancy" in responses[0] else REMEDY_OF_FRFS
    if not _may_have_discrepancy(trace):
        return ""
    estimate = estimated_scatter(trace)
    return f"{REMEDY}. {estimate}" if estimate else REMEDY


def _may_have_discrepancy(trace: xr.DataTree) -> bool:
    problem = problem_of(trace)
    likelihood: Mapping[str, Any] = problem.get("likelihood", {})
    if "discrepancy" in likelihood:
        return False
    kinds = [one for one in likelihood.get("errors", [likelihood]) if "frequency" in str(one.get("error", ""))]
    return bool(kinds) and not any(
        key in one for one in kinds for key in ("covariance_hz2", "freedom", "freedom_inferred")
    )


def _describe_modes(trace: xr.DataTree, settings: Mapping[str, Any], noise: list[str]) -> list[str]:
    """Return a clause on the size of the model's frequency error, and one on its shape error, if it has them."""
    found = []
    kinds = (("sd", "a", "relative error of the frequencies"), ("shape_sd", "an", "error of the shapes"))
    for key, article, what in kinds:
        if key not in settings:
            continue
        if settings[key]["inferred"] < 0:
            found.append(f"a given {what} of {significant(100.0 * settings[key]['known'], 2)} %")
            continue
        name = noise[settings[key]["inferred"]]
        draws = 100.0 * trace["posterior"][name].to_numpy().ravel()
        low, middle, high = (significant(x, 2) for x in np.quantile(draws, [0.05, 0.5, 0.95]))
        found.append(f"{article} {what} by the model, {name}, of {middle} % (90 %: {low} to {high} %)")
    return found


def _describe_correlation(trace: xr.DataTree, settings: Mapping[str, Any], noise: list[str]) -> list[str]:
    """Return a list with a clause on the model discrepancy's correlation between modes.

    The list is empty if this correlation is not inferred.
    """
    number = settings.get("correlation", {}).get("inferred", -1)
    if number < 0:
        return []
    draws = trace["posterior"][noise[number]].to_numpy().ravel()
    low, middle, high = (fixed(x, 2) for x in np.quantile(draws, [0.05, 0.5, 0.95]))
    return [f"a correlation over the modes, {noise[number]}, of {middle} (90 %: {low} to {high})"]


def _describe_inferred(trace: xr.DataTree, tau: str, names: list[str], parameters: Any) -> str:
    draws = 100.0 * trace["posterior"][tau].to_numpy().ravel()
    low, middle, high = np.quantile(draws, [0.05, 0.5, 0.95])
    prior = next(p["prior"] for p in parameters if p["name"] == tau)
    before = significant(67.45 * float(prior["sd"]), 2)  # the median of a half-normal distribution
    return (
        f"{names_in_words(names)}: a scatter over the modes, {tau}, of {significant(middle, 2)} % (90 %: "
        f"{significant(low, 2)} to {significant(high, 2)} %; the median of its prior is {before} %)"
    )
