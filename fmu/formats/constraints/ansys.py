"""Constraint equations in Ansys archives (``CDWRITE``), among them those that CERIG and RBE3 have made.

Each begins with the number of its terms and has two terms a line, along the axes of the nodes. Its first term is
the dependent one. Ansys, *Mechanical APDL command reference*, CE::

    CE,R5.0,DEFI,       3,       1,  0.00000000
    CE,R5.0,NODE,      12,UX  ,  1.00000000    ,      40,UX  , -1.00000000
    CE,R5.0,NODE,      40,ROTZ,  0.50000000
"""

from __future__ import annotations

from collections.abc import Iterable

from fmu.formats.constraints.equations import Equation, explicit_equation
from fmu.formats.matrices.limits import MOST_DOFS, DofName, RefusedError
from fmu.formats.matrices.nastran.cards import number
from fmu.formats.shown import quote
from fmu.types import DIRECTIONS

_DIRECTION = dict(zip(("UX", "UY", "UZ", "ROTX", "ROTY", "ROTZ"), DIRECTIONS, strict=True))


def equations_of(lines: Iterable[str]) -> tuple[list[Equation], list[str]]:
    """Return the constraint equations among the lines of an archive, and notes on constraints that are not read.

    Raises
    ------
    RefusedError, ValueError
        If an equation is malformed, cut short, or does not determine its first degree of freedom.
    """
    found: list[Equation] = []
    couplings = 0
    terms: list[tuple[DofName, float]] = []
    missing = 0
    for line in lines:
        if line[:3].upper() not in ("CE,", "CP,"):
            continue
        words = [word.strip().upper() for word in line.split(",")]
        if words[0] == "CP":
            couplings += len(words) > 2 and words[2] == "DEFI"
            continue
        source = f"CE {len(found) + 1}"
        if len(words) > 3 and words[2] == "DEFI":
            if missing:
                raise ValueError(f"{source} must have {missing} more terms")
            missing = _whole(words[3], f"{source}: the number of terms")
            if not 1 <= missing <= MOST_DOFS or len(found) > MOST_DOFS:
                raise RefusedError(
                    f"must have at most {MOST_DOFS} equations and terms ({source}: {missing} terms)"
                )
            terms = []
        elif len(words) > 2 and words[2] == "NODE":
            for at in range(3, len(words) - 2, 3):
                if words[at]:
                    terms.append(
                        (_name(words[at], words[at + 1], source), number(words[at + 2], f"{source}: a factor"))
                    )
                    missing -= 1
            if missing == 0:
                found.append(explicit_equation(terms, source))
            elif missing < 0:
                raise ValueError(f"{source} must have the terms that it begins with (it has more)")
    if missing:
        raise ValueError(f"CE {len(found) + 1} must have {missing} more terms")
    return found, [f"{couplings} couplings (CP) are not read."] if couplings else []


def _name(node: str, label: str, source: str) -> DofName:
    if label not in _DIRECTION:
        raise ValueError(f"{source}: a direction must be one of {', '.join(_DIRECTION)} (got {quote(label)})")
    return _whole(node, f"{source}: a node"), _DIRECTION[label]


def _whole(word: str, what: str) -> int:
    if not (word.isdecimal() and len(word) <= 10):
        raise ValueError(f"{what} must be a whole number (got {quote(word)})")
    return int(word)
