"""State a posterior's assumptions in words and numbers, given the configuration of its problem as a dict."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from fmu.numbers import MISSING, apart, given, names_in_words, significant, with_sd
from fmu.plain_data import mapping_in
from fmu.posterior.frf.assumptions import BESIDE_MODES, NO_DATA, assumptions_on_frfs
from fmu.posterior.parameters import prior_in_words
from fmu.posterior.prior_doubts import outside_bounds
from fmu.types import FloatArray

Inferred = Mapping[str, tuple[float, float]]
"""Posterior mean and standard deviation of each inferred error parameter, keyed by its name."""


class Assumptions(NamedTuple):
    """The assumptions behind a problem's posterior.

    Attributes
    ----------
    sentences : tuple of str
        Sentences on the error models, the priors, the tests, the pairing and the reduced model.
    errors : tuple of tuple of str
        For each measured mode, its label, its frequency in Hz, and its error sd in Hz and in per cent; empty if
        there are no frequency errors.
    has_inferred : bool
        Whether parameters of the errors, such as standard deviations, are inferred.
    """

    sentences: tuple[str, ...]
    errors: tuple[tuple[str, str, str, str], ...] = ()
    has_inferred: bool = False


ERRORS_HEADER = ("mode", "measured, Hz", "σ, Hz", "σ, %")


def assumptions(
    problem: Mapping[str, Any],
    reduction: float | None,
    inferred: Inferred | None = None,
    error: float | None = None,
    elsewhere: float | None = None,
    log_prob: float | None = None,
) -> Assumptions | None:
    """Return the assumptions behind a problem's posterior.

    Parameters
    ----------
    problem : mapping
        The dict returned by `UpdatingProblem.configuration`, or the same dict read from a trace.
    reduction : float or None
        Relative frequency error allowed in the reduced model; None if there is no reduced model.
    inferred : mapping of str to (float, float), optional
        Posterior mean and standard deviation of each inferred error parameter, after a run.
    error : float, optional
        Largest relative frequency error found by a run's certificate.
    elsewhere : float, optional
        Relative frequency error allowed outside the bulk of the posterior, if it is larger than `reduction`.
    log_prob : float, optional
        Error in the log-probability that the reduced model may cause.

    Returns
    -------
    Assumptions or None
        None if `problem` is not the configuration of an updating problem.
    """
    if not {"likelihood", "parameters", "data"} <= set(mapping_in(problem) or ()):
        return None
    likelihood, data = problem["likelihood"], problem["data"]
    responses, used = likelihood.get("responses", ()), data.get("use", ())
    are_data = not used or any(used)
    said = _errors(likelihood, problem["parameters"], data, inferred) if are_data or not responses else []
    for one in responses:
        said += assumptions_on_frfs(one)
    if responses:
        said.append(BESIDE_MODES if are_data else NO_DATA)
    priors = outside_bounds(problem["parameters"])
    cut = "Priors: independent, cut off at the bounds; both are in the table of the parameters."
    unused = [str(label) for label, use in zip(data["labels"], data.get("use", ()), strict=False) if not use]
    if unused and are_data:
        said.append(f"Not used in updating, and thus a test of the model: mode{'s' * (len(unused) > 1)} "
                    f"{', '.join(unused)}.")  # fmt: skip
    said += [cut, *_between_tests(problem), *priors, _pairing(problem)]
    if reduction is None:
        said.append("The full model is solved everywhere; there is no reduced model.")
    else:
        seen = "" if error is None else f"; {significant(error, 2)} was found at draws solved again in full"
        away = (
            ""
            if elsewhere is None
            else (f" where the posterior has its mass, and {significant(elsewhere)} elsewhere")
        )
        said.append(
            "Within the bounds a reduced model replaces the full one. The relative error allowed to a frequency "
            f"is {significant(reduction)}{away}{seen}."
            + (
                ""
                if log_prob is None
                else f" The error allowed to the log-probability is {significant(log_prob)}."
            )
        )
    errors = _by_mode(likelihood, problem["parameters"], data, inferred) if are_data else ()
    return Assumptions(tuple(said), errors, bool(likelihood.get("noise")))


_OF = {
    "frequency": "Errors of the frequencies",
    "absolute frequency": "Errors of the frequencies, in Hz",
    "relative frequency": "Errors of the frequencies, relative to their size",
    "eigenvalue frequency": "Errors of the eigenvalues, relative to their size",
    "shape": "Errors of the mode shapes, scaled to unit length at the sensors",
    "MAC": "Errors 1 − MAC of the mode shapes",
}


def _between_tests(problem: Mapping[str, Any]) -> list[str]:
    """Return the sentences that say how parameters differ between tests; empty if there is only one test."""
    if "tests" not in problem:
        return []
    said = ["A parameter has one value in all tests, unless it is named for one of them or for a group."]
    populations = problem.get("populations", {})
    if populations:
        kinds = dict.fromkeys(str(one["distribution"]) for one in populations.values())
        together = "correlated, with a prior LKJ" if problem.get("correlated") else "independent of each other"
        of_each, and_others = (" each", f"; the populations are {together}") if len(populations) > 1 else ("", "")
        said.append(
            f"The values of {', '.join(populations)} in the tests are draws from a {' or '.join(kinds)} "
            f"distribution{of_each}, cut off at the bounds{and_others}."
        )
        in_time = [name for name, one in populations.items() if "correlation_time" in one]
        if in_time:
            said.append(f"The values of {', '.join(in_time)} are correlated in time, by exp(−Δt/T) for Δt apart.")
    return said


def _errors(
    likelihood: Mapping[str, Any], parameters: Any, data: Mapping[str, Any], inferred: Inferred | None
) -> list[str]:
    """Return the sentences on the error models."""
    if likelihood.get("error") == "modal-residual":
        size = _range(np.asarray(likelihood["beta"]))
        return [f"The error is the modal residual of eq. (2), a pseudo-likelihood without noise: β = {size}."]
    said = []
    noise = {name: next(p for p in parameters if p["name"] == name) for name in likelihood.get("noise", ())}
    for one in likelihood.get("errors", [likelihood]):
        kind = str(one.get("error", "unknown"))
        if kind not in _OF:
            said.append(f"Errors of the kind {kind!r}: an error model that is not fmu's own.")
            continue
        what = _OF[kind]
        shape = "half-Gaussian" if kind == "MAC" else "Gaussian"
        if "freedom" in one:
            shape = f"Student's with {significant(one['freedom'])} degrees of freedom"
        elif "freedom_inferred" in one:
            shape = f"Student's with inferred degrees of freedom, {list(noise)[int(one['freedom_inferred'])]},"
        if "covariance_hz2" in one:
            said.append(f"{what}: Gaussian and correlated between the modes, with {_source(data)}.")
            continue
        if "beta" in one:
            beta = np.asarray(one["beta"])
            said.append(
                f"{what}: Gaussian and independent, with a known σ of {_range(np.sqrt(0.5 / beta))} Hz "
                f"(β = {_range(beta)} per Hz²)."
            )
            continue
        spread = one.get("spread") or {}
        sizes = [noise[list(noise)[int(k)]] for k in spread.get("inferred", {})]
        fixed = np.asarray(spread.get("fixed", ()), dtype=float)
        parts = [] if not np.any(fixed) else [f"a known σ of {_describe_known(kind, fixed, data)}"]
        parts += [_describe_inferred(p, inferred) for p in sizes]
        said.append(f"{what}: {shape} and independent, with {' and '.join(parts) or 'a σ of its own'}.")
    for one in likelihood.get("quantities", ()):
        rows = zip(one["labels"], one["measured"], one["sd"], one["units"], strict=True)
        values = [f"{label} {with_sd(value, sd)} {unit}" for label, value, sd, unit in rows]
        said.append(f"Measured besides, with Gaussian errors: {', '.join(values)}.")
    of_model = likelihood.get("discrepancy", ())
    said += [sentence for one in of_model for sentence in _errors_of_model(one, parameters, noise, inferred)]
    if not of_model:
        said.append("These errors must cover both measurement error and model error.")
    if data.get("tests") is not None:
        said.append("A measured frequency is the mean of repeated tests, and its σ is the error of that mean.")
    return said


def _describe_known(name: str, fixed: FloatArray, data: Mapping[str, Any]) -> str:
    """Return known sds as text.

    Relative frequency errors are in per cent, absolute ones in Hz, and other errors without a unit.
    """
    if name == "relative frequency":
        return f"{_range(100.0 * fixed / np.asarray(data['frequencies_hz']))} %"
    return _range(fixed) + (" Hz" if name == "absolute frequency" else "")


def _errors_of_model(
    one: Mapping[str, Any], parameters: Any, noise: Mapping[str, Any], inferred: Inferred | None
) -> list[str]:
    """Return sentences on a model discrepancy: what scatters, the size, and the correlation.

    `one` is the result of `as_dict` of an `EmbeddedScatter` or of `ModeErrors`; `noise` has the inferred error
    parameters by name, in their order.
    """

    def size(setting: Mapping[str, Any], what: str) -> str:
        if setting["inferred"] >= 0:
            return _describe_inferred(noise[list(noise)[setting["inferred"]]], inferred, what)
        return f"a known {what} of {given(setting['known'])}"

    correlation = one.get("correlation", {"known": 0.0, "inferred": -1})
    independent = correlation == {"known": 0.0, "inferred": -1}
    over_modes = "independently" if independent else f"and between two modes {size(correlation, 'correlation')}"
    if one["kind"] == "modes":
        said = []
        if "sd" in one:
            said.append(f"the frequencies err, relative to their size, with {size(one['sd'], 'σ')}, {over_modes}")
        if "shape_sd" in one:
            root = np.asarray(one["root"])
            alike = "independent" if np.count_nonzero(root) == len(root) else "correlated"
            of_shapes = f"with {size(one['shape_sd'], 'σ')}, {alike} from sensor to sensor"
            said.append(f"the mode shapes, scaled to a largest component of one, err {of_shapes}")
    else:
        units = {p["name"]: p["unit"] for p in parameters}
        scatters: dict[tuple[float, int, str], list[str]] = {}
        columns = (one[key] for key in ("names", "relative", "size", "tau", "inferred"))
        for name, relative, unit, tau, number in zip(*columns, strict=True):
            if tau > 0.0 or number >= 0:
                of = "the value" if relative else f"{given(unit)} {units.get(name, '')}".strip()
                scatters.setdefault((tau, number, of), []).append(name)
        said = [
            f"{names_in_words(names)} scatter{'s' * (len(names) == 1)} over the modes by τ times {of}, with "
            f"{size({'known': tau, 'inferred': number}, 'τ')}, {over_modes}"
            for (tau, number, of), names in scatters.items()
        ]
    return [f"Errors of the model, the same in all tests of a structure: {part}." for part in said]


def _describe_inferred(parameter: Mapping[str, Any], inferred: Inferred | None, what: str = "σ") -> str:
    prior = prior_in_words(parameter["prior"], parameter["unit"])
    text = f"a {what} that is inferred, {parameter['name']} (prior: {prior}"
    if inferred and parameter["name"] in inferred:
        text += f"; posterior: {with_sd(*inferred[parameter['name']])}"
    return f"{text})"


def _source(data: Mapping[str, Any]) -> str:
    return "the covariance of the tests" if data.get("tests") is not None else "the covariance that is given"


def _by_mode(
    likelihood: Mapping[str, Any], parameters: Any, data: Mapping[str, Any], inferred: Inferred | None
) -> tuple[tuple[str, str, str, str], ...]:
    """Return the rows for the table of frequency errors; see `Assumptions.errors`."""
    measured = np.asarray(data["frequencies_hz"], dtype=float)
    sd = frequency_sd(likelihood, parameters, measured, inferred)
    if sd is None:
        return ()
    labels = data.get("labels") or range(1, len(measured) + 1)
    return tuple(
        (str(label), given(f), significant(s, 3), significant(100.0 * s / f, 2))
        for label, f, s in zip(labels, measured, sd, strict=True)
    )


def frequency_sd(
    likelihood: Mapping[str, Any], parameters: Any, measured: FloatArray, inferred: Inferred | None
) -> FloatArray | None:
    """Return each mode's error sd in Hz, shape (n_modes,), from the first frequency error model.

    Return None if no error model has an sd of the frequencies. An inferred parameter of the sd is replaced by its
    posterior mean or, before a run, by its starting value. For Student's t distribution, the sd is the scale.
    """
    named = list(likelihood.get("noise", ()))
    start = {p["name"]: float(p["start"]) for p in parameters}
    for one in likelihood.get("errors", [likelihood]):
        name = str(one.get("error"))
        if name == "frequency" and "covariance_hz2" in one:
            return np.sqrt(np.diag(np.asarray(one["covariance_hz2"], dtype=float)))
        if name == "frequency" and "beta" in one:
            return np.broadcast_to(np.sqrt(0.5 / np.asarray(one["beta"], dtype=float)), measured.shape)
        if name.endswith(" frequency") and "spread" in one:
            variance = np.asarray(one["spread"]["fixed"], dtype=float) ** 2
            for k, size in one["spread"]["inferred"].items():
                who = named[int(k)]
                value = inferred[who][0] if inferred and who in inferred else start[who]
                variance = variance + (value * np.asarray(size, dtype=float)) ** 2
            sd = np.sqrt(variance)
            return np.asarray(0.5 * measured * sd if name == "eigenvalue frequency" else sd)
    return None


def _pairing(problem: Mapping[str, Any]) -> str:
    """Return the sentence that states how computed modes are paired with the measured modes."""
    data, likelihood = problem["data"], problem["likelihood"]
    model = mapping_in(problem["model"]) or {}
    if "configurations" in model:  # several tests, with the same kind of pairing
        model = mapping_in(model["configurations"][0]["model"]) or {}
    if likelihood.get("error") == "modal-residual":
        return "The modal residual compares no computed modes, and pairs none."
    if "pairing" not in model:
        return "The model itself pairs its modes with the measured ones."
    if model["pairing"] in ("IndexPairing", "index"):
        order = "in the sorted spectrum" if model["pairing"] == "IndexPairing" else "in the order of the function"
        if "n_rigid" in model:
            order = f"among the elastic modes, which follow {model['n_rigid']} rigid-body modes"
        numbers = dict.fromkeys(map(str, data["numbers"]))  # each number once, also with several tests
        return f"Modes are paired by number {order}: {', '.join(numbers)}."
    softly = ""
    if "softness" in likelihood:
        softly = (
            f", softly: the likelihood of a measured mode is a mixture over computed ones, with weights "
            f"exp(MAC/{given(float(likelihood['softness']))})"
        )
    if data.get("shapes") is not None:
        return f"Modes are paired by MAC with the shapes measured at {len(data['shapes'])} sensors{softly}."
    if data.get("counterparts"):
        by = f"by their numbers among these, {', '.join(dict.fromkeys(map(str, data['counterparts'])))}"
    else:
        by = f"as the lowest {'modes that the sensors see' if data['sensors'] else 'elastic modes'}, in this order"
    return (
        "No shapes were measured. Modes are paired by MAC with the model's own shapes before updating, where they "
        f"are paired {by}{softly}."
    )


def _range(values: FloatArray) -> str:
    """Return the range of values as text: one number if all are equal, else `MISSING` if one is not positive."""
    values = np.asarray(values, dtype=float)
    low, high = float(values.min()), float(values.max())
    if high - low <= 1e-9 * high:
        return significant(high, 4)
    return " to ".join(apart(low, high, digits=3)) if low > 0 else MISSING
