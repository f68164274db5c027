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
        parameters over the modes. If the file has ``[[discrepancy]]`` tables of the same kind, these stay with
        their other keys: a standard deviation or a τ is inferred unless its table gives it. Of tables that then
        differ only in their names, the first stays.
    """
    import tomlkit

    document = tomlkit.parse(text)
    keys = VARIANTS[variant].keys
    given = [table.unwrap() for table in document.pop("discrepancy", ())]
    if keys:
        changed = [{**table, **keys} for table in given if table["kind"] == keys["kind"]] or [dict(keys)]
        nameless = [{**one, "name": None} for one in changed]
        array = tomlkit.aot()
        for i, one in enumerate(changed):
            if nameless[i] not in nameless[:i]:
                table = tomlkit.table()
                table.update(one)
                array.append(table)
        document.append("discrepancy", array)
    return tomlkit.dumps(document)
