"""Variants of a problem file that differ in the discrepancy of the model: the kinds of ``--discrepancy``."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

from fmu.arguments import ArgumentError

if TYPE_CHECKING:
    from tomlkit import TOMLDocument

NOISE = "model error"
"""Name of the inferred standard deviation of the variant ``inferred``."""
INFERRED_SD = 0.05
"""Standard deviation of its half-normal prior, relative to the frequency: that of moduli with a scatter of 0.1."""


class Variant(NamedTuple):
    """A discrepancy of the model.

    Attributes
    ----------
    title : str
        Its name in tables.
    kind : str
        Kind of the table ``[[discrepancy]]``; no table if empty.
    by : str
        The key ``by`` of the table; none if empty.
    """

    title: str
    kind: str = ""
    by: str = ""


VARIANTS = {
    "none": Variant("no discrepancy"),
    "inferred": Variant("one error of all modes"),
    "embedded": Variant("embedded", "embedded", "common"),
    "embedded-by-group": Variant("embedded by group", "embedded", "group"),
    "modes": Variant("errors of the modes", "modes"),
}
"""The discrepancies by their names on the command line; the first one is the reference of comparisons."""


def with_discrepancy(text: str, variant: str) -> str:
    """Return a problem file with another discrepancy of the model; all else, comments included, is kept.

    Parameters
    ----------
    text : str
        The content of a valid problem file.
    variant : str
        A key of `VARIANTS`: ``"none"``; ``"inferred"``, an inferred standard deviation for all frequencies alike,
        relative to them; ``"embedded"`` and ``"embedded-by-group"``, scatter of the parameters over the modes;
        ``"modes"``, errors of the modes themselves that have a part in common. A table ``[[discrepancy]]`` of the
        same kind in the file keeps its other keys.

    Raises
    ------
    ArgumentError
        If the file has no frequencies with an error to which the standard deviation can be added.
    """
    import tomlkit

    document = tomlkit.parse(text)
    _, kind, by = VARIANTS[variant]
    given = [table for table in document.get("discrepancy", ()) if table.get("kind") == kind]
    document.pop("discrepancy", None)
    if kind:
        table = tomlkit.table()
        table.update({**(given[0].unwrap() if given else {}), "kind": kind, **({"by": by} if by else {})})
        array = tomlkit.aot()
        array.append(table)
        document.append("discrepancy", array)
    elif variant == "inferred":
        _infer_sd(document)
    return tomlkit.dumps(document)


def _infer_sd(document: TOMLDocument) -> None:
    """Add an inferred standard deviation to the errors of the frequencies."""
    import tomlkit

    errors = document.get("error", "frequency")
    if isinstance(errors, str) and errors != "frequency":
        raise ArgumentError("error", "must be of frequencies for an inferred standard deviation", repr(errors))
    if isinstance(errors, str):
        table = tomlkit.table()
        table.update({"of": "frequencies", "kind": "relative", **_known_sd(document)})
        errors = tomlkit.aot()
        errors.append(table)
        document.pop("error", None)
        document.append("error", errors)
    found = [one for one in errors if one.get("of") == "frequencies"]
    if not found:
        raise ArgumentError("error", "must be of frequencies for an inferred standard deviation")
    names = {str(one["name"]) for one in document.get("noise", ())}
    if any(str(found[0].get(key)) in names for key in ("sd", "discrepancy")):
        return  # one is inferred already
    size = {"relative": 1.0, "eigenvalue": 2.0}.get(str(found[0].get("kind", "relative")))
    if size is None:
        frequencies = _frequencies(document)
        size = sum(frequencies) / len(frequencies)
    found[0]["discrepancy"] = NOISE
    table = tomlkit.table()
    prior = tomlkit.inline_table()
    prior.update({"distribution": "half-normal", "sd": INFERRED_SD * size})
    table.update({"name": NOISE, "start": 0.5 * INFERRED_SD * size, "prior": prior})
    noise = document.pop("noise", None) or tomlkit.aot()
    noise.append(table)
    document.append("noise", noise)


def _known_sd(document: TOMLDocument) -> dict[str, list[float]]:
    """Return the key ``sd`` of relative errors that are given by β; empty where the data have deviations."""
    beta = document.get("measurement", {}).get("beta")
    if beta is None:
        return {}
    frequencies = _frequencies(document)
    betas = list(beta) if isinstance(beta, Sequence) else [beta] * len(frequencies)
    return {"sd": [1.0 / math.sqrt(2.0 * b) / f for b, f in zip(betas, frequencies, strict=True)]}


def _frequencies(document: TOMLDocument) -> list[float]:
    found = document.get("measurement", {}).get("frequencies")
    if not found:
        rule = "must be given in the file for errors in Hz with an inferred standard deviation"
        raise ArgumentError("measurement.frequencies", rule)
    return [float(value) for value in found]
