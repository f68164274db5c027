"""Constraint equations in Ansys archives (``CDWRITE``), including those that CERIG and RBE3 have made.

Each equation begins with its number of terms and has two terms per line, along the axes of the nodes. The first
term is the dependent one. Ansys, *Mechanical APDL command reference*, CE::

    CE,R5.0,DEFI,       3,       1,  0.00000000
    CE,R5.0,NODE,      12,UX  ,  1.00000000    ,      40,UX  , -1.00000000
    CE,R5.0,NODE,      40,ROTZ,  0.50000000

Coupled sets are read in the form of the command, ``CP,1,UX,12,13,14``: all nodes move as the first one does. No
public archive shows the form in which ``CDWRITE`` writes them (``CP,R5.0,…``); these lines are not read, and a
note says so.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from fmu.formats.constraints.equations import Equation, explicit_equation
from fmu.formats.matrices.limits import MOST_DOFS, DofName, RefusedError
from fmu.formats.matrices.nastran.cards import number
from fmu.formats.shown import quote
from fmu.types import DIRECTIONS

_DIRECTION = dict(zip(("UX", "UY", "UZ", "ROTX", "ROTY", "ROTZ"), DIRECTIONS, strict=True))


def equations_of(lines: Iterable[str]) -> tuple[list[Equation], list[str]]:
    """Return the constraint equations in the lines of an archive, and notes on constraints that are not read.

    Raises
    ------
    RefusedError, ValueError
        If an equation is malformed, cut short, or does not determine its first degree of freedom.
    """
    found: list[Equation] = []
    coupled = _CoupledSets()
    unread = 0
    terms: list[tuple[DofName, float]] = []
    missing = 0
    for line in lines:
        if line[:3].upper() not in ("CE,", "CP,"):
            continue
        words = [word.strip().upper() for word in line.split(",")]
        if words[0] == "CP":
            if len(words) > 2 and words[1][:1] == "R":  # the release, as R5.0
                unread += words[2] == "DEFI"
            else:
                coupled.add([*words[1:], "", ""])
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
    found += coupled.equations()
    how = "write each as CP,number,direction,nodes"
    return found, [f"{unread} couplings (CP,R5.0,DEFI) are not read: {how}."] if unread else []


class _CoupledSets:
    """The sets of ``CP,NSET,Lab,NODE1,…,NODE17``: all nodes move as the first (Ansys, *Command reference*, CP)."""

    def __init__(self) -> None:
        self.sets: dict[int, tuple[str, dict[int, None]]] = {}
        self.highest = 0
        self.n_nodes = 0

    def add(self, words: Sequence[str]) -> None:
        """Add the nodes of a line to a new or an existing set."""
        highest = self.highest
        which = {"": max(highest, 1), "HIGH": max(highest, 1), "NEXT": highest + 1}.get(words[0])
        which = _whole(words[0], "CP: the number of a set") if which is None else which
        label, nodes = words[1], [_whole(word, f"CP {which}: a node") for word in words[2:] if word]
        before, members = self.sets.get(which, ("", {}))
        direction = _DIRECTION.get(label, "" if label else before)
        if not direction or not nodes:
            got = f"got {quote(label)}, {len(nodes)} nodes"
            raise ValueError(f"CP {which} must have a direction of {', '.join(_DIRECTION)} and nodes ({got})")
        members.update(dict.fromkeys(nodes))
        self.sets[which], self.highest = (direction, members), max(highest, which)
        self.n_nodes += len(nodes)
        if self.n_nodes > MOST_DOFS:
            raise RefusedError(f"must have coupled sets of at most {MOST_DOFS} nodes in all")

    def equations(self) -> list[Equation]:
        """Return an equation for every node of each set except the first."""
        found: list[Equation] = []
        for which, (direction, (first, *others)) in self.sets.items():
            found += [Equation((node, direction), {(first, direction): 1.0}, f"CP {which}") for node in others]
        return found


def _name(node: str, label: str, source: str) -> DofName:
    if label not in _DIRECTION:
        raise ValueError(f"{source}: a direction must be one of {', '.join(_DIRECTION)} (got {quote(label)})")
    return _whole(node, f"{source}: a node"), _DIRECTION[label]


def _whole(word: str, what: str) -> int:
    if not (word.isdecimal() and len(word) <= 10):
        raise ValueError(f"{what} must be a whole number (got {quote(word)})")
    return int(word)
