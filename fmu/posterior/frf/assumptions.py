"""State the assumptions about frequency response functions and damping as sentences."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from fmu.numbers import given, names_in_words, significant, whole
from fmu.plain_data import list_in

_PLURAL = {"receptance": "receptances", "mobility": "mobilities", "accelerance": "accelerances"}
NO_DATA = (
    "The modes are no data: they are paired with modes of the model, and the search for maxima begins with them."
)

BESIDE_MODES = (
    "The modes and the frequency response functions are independent data: modes that were identified from these "
    "functions would count twice."
)


def assumptions_on_frfs(one: Mapping[str, Any]) -> list[str]:
    """Return sentences about a test's frequency response functions, their errors and the damping.

    Parameters
    ----------
    one : mapping
        The result of `FRFTerm.as_dict`.
    """
    data = one["data"]
    n, used = len(data["drives"]), int(data["n_used"])
    kind = _PLURAL[data["kind"]] if n > 1 else data["kind"]
    low, high = (significant(f, 4) for f in data["frequencies_hz"])
    what = "H" if one["scale"] == "linear" else "log H, that is of log amplitude and phase"
    shape = "Gaussian"
    if data["freedom"] is not None:
        shape = f"Student's with {significant(data['freedom'])} degrees of freedom"
    test = f"{one['test']}: " if "test" in one else ""
    said = [
        f"{test}Frequency response functions: {n} {kind} from {low} to {high} Hz, {whole(used)} complex values "
        "used.",
        f"Errors of {what}: {shape}, independent from line to line, from FRF to FRF and between real and "
        f"imaginary part, with the standard deviations of the data{_of_model(one['model_sd'])}.",
    ]
    if "window" in data:
        name, length = data["window"]
        said.append(f"The model's FRFs are smoothed by the {name} window of segments of {given(length)} s.")
    if "discrepancy" in one:
        said.append(_of_modes(one["discrepancy"]))
    for key, name, unit in (
        ("gain_sd", "gains of response channels", ""),
        ("force_gain_sd", "gains of forces", ""),
        ("delay_sd", "delays of response channels", " s"),
    ):
        if one.get(key):
            each = names_in_words([f"{channel} (sd {given(sd)}{unit})" for channel, sd in one[key].items()])
            said.append(f"Unknown {name}: {each}.")
    said.append(f"Damping: {'; '.join(map(_damping, one['damping']))}.")
    return said


def _of_model(sd: float | str) -> str:
    if isinstance(sd, str):
        return f", and an error of the model relative to |H| that is inferred, {sd}"
    return f", and an error of the model of {significant(100.0 * sd)} % of |H|" if sd else ""


def _of_modes(one: Mapping[str, Any]) -> str:
    """Return a sentence about the model discrepancy in the modes."""
    sd, shapes = significant(100.0 * one["sd"]), one["shape_sd"]
    size = f"is inferred, {shapes}" if isinstance(shapes, str) else f"is {significant(100.0 * shapes)} %"
    return (
        f"Errors of the model: the frequencies of {one['modes']} modes err by {sd} %, with a correlation of "
        f"{given(one['correlation'])}, and their residues in each FRF independently by a share of the root mean "
        f"square of all FRFs that {size}."
    )


def _damping(one: Mapping[str, Any]) -> str:
    """Return a description of a damping model, with its values or parameters."""
    match one["damping"]:
        case "ModalDamping":
            ratios = list_in(one["ratios"])
            if ratios is None:
                return f"one ratio {_value(one['ratios'])} of all modes"
            last = ", the last one for all higher modes" if len(ratios) > 1 else ""
            return f"modal ratios {names_in_words([_value(ratio) for ratio in ratios])}{last}"
        case "RayleighDamping":
            return f"α M + β K with α = {_value(one['alpha'])} per s and β = {_value(one['beta'])} s"
        case "StructuralDamping":
            parts = [f"{_value(loss)} of {name}" for name, loss in one["of"].items()]
            return f"loss factors {names_in_words([_value(one['loss']), *parts])}"
        case "Dashpot":
            ends = [" ".join(map(str, end)) for end in (one["at"], one["to"] or ("the ground",))]
            unit = "N·m·s/rad" if "r" in str(one["at"][-1]) else "N·s/m"
            return f"a dashpot of {_value(one['coefficient'])} {unit} from {ends[0]} to {ends[1]}"
    return f"a damping matrix times {_value(one['coefficient'])}"


def _value(value: float | str) -> str:
    return value if isinstance(value, str) else given(value)
