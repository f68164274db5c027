"""Variants of a problem file with different model discrepancies: the choices for ``--discrepancy``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple


class Variant(NamedTuple):
    """A choice of model discrepancy.

    Attributes
    ----------
    title : str
        Name in result tables.
    keys : mapping of str to object
        Keys in the ``[[discrepancy]]`` table; empty if there is no discrepancy.
    """

    title: str
    keys: Mapping[str, object]


VARIANTS = {
    "none": Variant("no discrepancy", {}),
    "inferred": Variant("independent errors of the modes", {"kind": "modes", "correlation": 0.0}),
    "modes": Variant("correlated errors of the modes", {"kind": "modes", "correlation": "inferred"}),
    "embedded": Variant("embedded", {"kind": "embedded", "by": "common"}),
    "embedded-by-group": Variant("embedded by group", {"kind": "embedded", "by": "group"}),
}
"""Discrepancies by their names on the command line; comparisons use the first one as reference."""


def with_discrepancy(text: str, variant: str) -> str:
    """Return a problem file's text with its model discrepancy replaced. Everything else stays, even comments.

    Parameters
    ----------
    text : str
        The content of a valid problem file.
    variant : str
        A key of `VARIANTS`: ``"none"``; ``"inferred"``, independent relative errors of the frequencies with one
        standard deviation, and errors of the shapes, if these are compared; ``"modes"``, the same with an inferred
        correlation between the frequency errors; ``"embedded"`` and ``"embedded-by-group"``, scatter of the
        parameters over the modes. If the file has a ``[[discrepancy]]`` table of the same kind, the table's other
        keys stay: a standard deviation or a τ is inferred unless the table gives it.
    """
    import tomlkit

    document = tomlkit.parse(text)
    keys = VARIANTS[variant].keys
    given = [table for table in document.get("discrepancy", ()) if keys and table.get("kind") == keys["kind"]]
    document.pop("discrepancy", None)
    if keys:
        table = tomlkit.table()
        table.update({**(given[0].unwrap() if given else {}), **keys})
        array = tomlkit.aot()
        array.append(table)
        document.append("discrepancy", array)
    return tomlkit.dumps(document)
