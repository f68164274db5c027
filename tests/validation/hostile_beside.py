"""Files that a problem file names, broken by hand or changed at random: matrices, tables, modes, Python."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np

from tests.validation import hostile_decks as decks
from tests.validation import hostile_matrices as matrices
from tests.validation import hostile_measured as measured
from tests.validation.hostile_bases import Base, bases, put
from tests.validation.hostile_files import SEED, Hostile, other_bytes
from tests.validation.hostile_functions import FUNCTIONS

LEAST = 300
"""How many there are at least; what is missing is made by changing bytes."""


@cache
def crafted(folder: Path) -> list[Hostile]:
    """Return the files made by hand; `folder` is for what bases are made of."""
    known = bases(folder)
    found = [_matrix(name, write, known["matrices"]) for name, write in matrices.crafted().items()]
    found += [_beside("table", name, known["tables"], *file) for name, file in measured.tables().items()]
    uff = known["universal file"]
    right = uff.beside["modes.uff"]
    found += [
        _beside("universal file", name, uff, "modes.uff", text) for name, text in measured.universal(right).items()
    ]
    oma = known["operational"]
    found += [_beside("operational", name, oma, "oma.npz", text) for name, text in measured.operational().items()]
    for file, texts in (("deck.bdf", decks.bulk_data()), ("deck.inp", decks.input_decks())):
        for name, text in texts.items():
            found.append(_beside(f"constraints, {file}", name, decks.base(file, text), file, text.encode()))
    python = known["python"]
    return found + [_beside("function", name, python, "storeys.py", code) for name, code in FUNCTIONS.items()]


def count(folder: Path) -> int:
    """Return how many files there are: those made by hand, and a third as many changed at random."""
    return max(len(crafted(folder)) * 4 // 3, LEAST)


def beside_file(number: int, folder: Path, seed: int = SEED) -> Hostile:
    """Return the file of a number, from 0."""
    made = crafted(folder)
    if number < len(made):
        return made[number]
    rng = np.random.default_rng([seed, number, 1])
    number -= len(made)
    kinds = [*matrices.KINDS, "tables", "universal file", "operational", "python"]
    kind = kinds[number % len(kinds)]
    known = bases(folder)
    if kind in matrices.KINDS:
        right = matrices.right(kind, folder / "right.bin")
        return _matrix(
            f"bytes changed{kind}", lambda path: path.write_bytes(other_bytes(rng, right)), known["matrices"]
        )
    base = known[kind]
    name = sorted(base.beside)[number // len(kinds) % len(base.beside)]
    return Hostile(
        f"{kind}: bytes changed",
        lambda into: put(
            into,
            base._replace(beside=base.beside | {name: other_bytes(rng, base.beside[name])}),
            base.text.encode(),
        ),
    )


def _matrix(name: str, write: Callable[[Path], object], base: Base) -> Hostile:
    """Return a problem whose second stiffness is a file; what is huge is checked by a process of its own."""
    file = "K1" + _ending(name)

    def into(folder: Path) -> None:
        put(folder, base, base.text.replace("K1.mtx", file).encode())
        write(folder / file)

    return Hostile(name if name.startswith("huge") else f"matrix: {name}", into)


def _ending(name: str) -> str:
    return ".mtx.gz" if name.endswith(".mtx.gz") else name[name.rindex(".") :]


def _beside(kind: str, name: str, base: Base, file: str, content: bytes) -> Hostile:
    beside = {**base.beside, file: content}
    return Hostile(f"{kind}: {name}", lambda folder: put(folder, base._replace(beside=beside), base.text.encode()))
