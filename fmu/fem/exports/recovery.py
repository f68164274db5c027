"""Powers of the parameters, recovered from the entries of exported matrices."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, islice, product

import numpy as np

from fmu.arguments import ArgumentError, check_arguments
from fmu.fem.exports.entries import MOST_SAMPLED, ROUNDING, SAFETY, Entries
from fmu.fem.modes.terms import Term
from fmu.formats.models.exported import ExportedModel
from fmu.numbers import names_in_words, significant, typed
from fmu.types import BoolArray, FloatArray, IntArray

POWERS = (1, 2, 3, -1)
REPRODUCED = 1e-8
"""Largest error of an entry, relative to √(a_ii a_jj), in an export that was not used."""
_FITTED = 1e-9
_RANK = {0: 0, 1: 1, 2: 3, 3: 2, -1: 4}
"""What is tried first: elements with a square are rare."""
_FACTORS = 3
"""Most parameters in one term."""
_MOST_TRIED = 30_000
_MOST_MISSED = 50
_MOST_COMPARED = 2000
_MOST_CORNERS = 4096
_WORST_CONDITION = 1e12
TOLD = 3
Powers = tuple[int, ...]


class NotSeparableError(ArgumentError):
    """Matrices that are no sum of products of powers of the parameters."""


@check_arguments
@dataclass(frozen=True, eq=False)
class Export:
    """Matrices of another program, and the values of the parameters with which it made them.

    Attributes
    ----------
    values : mapping of str to float
        Of the parameters, SI units. What the first export has is not repeated.
    model : ExportedModel
        See `fmu.read_model`.
    check : bool
        Whether it is not used, but to be reproduced by what is recovered from the others.
    name : str
        For messages, such as that of its file.
    """

    values: Mapping[str, float]
    model: ExportedModel
    check: bool = False
    name: str = ""


@dataclass(frozen=True)
class Recovery:
    """How one of the two matrices was recovered.

    Attributes
    ----------
    terms : tuple of Term
    fitted, checked : float or None
        Largest error of an entry, relative to √(a_ii a_jj): in the exports used, and in those that were not.
    digits : int
        Significant digits of the exported numbers; 17 of binary files.
    rounding : float
        Bound of the error that these digits leave in an entry anywhere within the parameters' bounds, relative to
        √(a_ii a_jj).
    decided : bool
        Whether several sets of powers reproduced the exports used, and the check told which are right.
    """

    terms: tuple[Term, ...]
    fitted: float
    checked: float | None
    digits: int
    rounding: float
    decided: bool

    def sentences(self, what: str, names: Sequence[str]) -> list[str]:
        """Describe the findings on the matrix named `what` (``"stiffness"``), with the names of parameters."""
        terms = names_in_words([_in_words(term.powers, names) for term in self.terms])
        many = f"The {what} is a sum of {len(self.terms)} terms: {terms}."
        said = [many if len(self.terms) > 1 else f"The {what} has one term: {terms}."]
        if self.checked is None:
            said.append(f"No export checks the {what}: nothing shows that its powers are right.")
        else:
            said.append(
                f"The {what} of the exports kept for checking is reproduced to {significant(self.checked, 1)}."
            )
        if self.decided:
            said.append(f"Without it the powers of the {what} would be open: one more export would check them.")
        return said


@dataclass(frozen=True)
class _Fit:
    """The least squares of one set of terms; parameters relative to their values in the first export."""

    powers: tuple[Powers, ...]
    inverse: FloatArray  # (n_terms, n_used)
    of_exports: FloatArray  # (n_exports, n_terms)

    @classmethod
    def of(cls, powers: Sequence[Powers], relative: FloatArray, used: BoolArray) -> _Fit | None:
        """Return the fit; None if the exports used cannot tell the terms apart."""
        X = monomials(relative, powers)
        if len(powers) > used.sum() or np.linalg.cond(X[used]) > _WORST_CONDITION:
            return None
        return cls(tuple(powers), np.linalg.pinv(X[used]), X)

    def amplification(self, X: FloatArray) -> FloatArray:
        """Return how much larger errors are at points with monomials X (n, n_terms) than in the exports, (n,)."""
        return np.asarray(np.abs(X @ self.inverse).sum(axis=1))

    def solve(self, entry: FloatArray, used: BoolArray, noise: float) -> FloatArray:
        """Return the coefficients (n_terms, n) of entries (n_exports, n), without what rounding alone explains.

        A small coefficient is dropped unless the exports used are missed without it.
        """
        found = self.inverse @ entry[used]
        least = SAFETY * noise * np.abs(self.inverse).sum(axis=1)
        kept = np.where(np.abs(found) > least[:, None], found, 0.0)
        allowed = 2.0 * self.compute_errors(entry, used)[used] + SAFETY * (noise * np.abs(entry[used]) + ROUNDING)
        return np.where(np.any(self.missed_by(kept, entry)[used] > allowed, axis=0), found, kept)

    def error(self, entry: FloatArray, used: BoolArray) -> FloatArray:
        """Return the largest error in each export, shape (n_exports,)."""
        return np.asarray(self.compute_errors(entry, used).max(axis=1, initial=0.0))

    def compute_errors(self, entry: FloatArray, used: BoolArray) -> FloatArray:
        """Return the error of each entry in each export, shape (n_exports, n)."""
        return self.missed_by(self.inverse @ entry[used], entry)

    def missed_by(self, coefficients: FloatArray, entry: FloatArray) -> FloatArray:
        """Return the error of each entry in each export, (n_exports, n), by coefficients (n_terms, n)."""
        return np.asarray(np.abs(entry - self.of_exports @ coefficients))

    def reproduces(self, entry: FloatArray, used: BoolArray, which: BoolArray, noise: float) -> bool:
        """Say whether the exports in `which` are reproduced, as far as rounding lets one say."""
        allowed = np.where(used, _FITTED, REPRODUCED)
        allowed = np.maximum(allowed, SAFETY * noise * (1.0 + self.amplification(self.of_exports)))
        return bool(np.all((self.error(entry, used) <= allowed)[which]))


def monomials(relative: FloatArray, powers: Sequence[Powers]) -> FloatArray:
    """Return Π θ_j ** p_j at points (n, n_parameters), shape (n, n_terms)."""
    return np.asarray(np.prod(relative[:, None, :] ** np.array(powers)[None], axis=2))


def recover(
    what: str,
    names: Sequence[str],
    exports: Sequence[Export],
    values: FloatArray,
    used: BoolArray,
    entries: Entries,
    changed: BoolArray,
    bounds: FloatArray,
) -> Recovery:
    """Return one matrix as a sum of terms; `changed` (n_parameters, n) tells which entries a parameter changes.

    Entries changed by the same parameters have the same terms. Where a parameter alone changes an element, and
    another one its neighbour, the entries between them have the terms of both, which are known by then. Where the
    changes of two elements cancel in the exports, such an entry may depend on all that changes the diagonal of its
    row and of its column, where nothing cancels.
    """
    relative, everything = values / values[0], np.ones(len(used), dtype=bool)
    corners = _corners(bounds / values[0])
    found: dict[Powers, FloatArray] = {}
    decided, error, rounding = False, np.zeros(len(used)), 0.0
    diagonal = np.flatnonzero(entries.row == entries.column)
    of_row = np.zeros((len(names), len(entries.dofs)), dtype=bool)
    of_row[:, entries.row[diagonal]] = changed[:, diagonal]

    def on_diagonal(own: IntArray) -> BoolArray:
        """Return a mask of the parameters that change the diagonal of both the row and the column of entries."""
        return np.asarray(of_row[:, entries.row[own]] & of_row[:, entries.column[own]])

    by_parameters, of_entry = np.unique(changed, axis=1, return_inverse=True)
    for k in np.argsort(by_parameters.sum(axis=0), kind="stable"):
        own = np.flatnonzero(of_entry == k)
        groups = [np.flatnonzero(by_parameters[:, k]).tolist()]
        around = np.flatnonzero(on_diagonal(own).any(axis=1)).tolist()
        groups += [around] if len(around) > len(groups[0]) else []
        for group in groups:
            known = [powers for powers in found if any(powers) and set(np.flatnonzero(powers)) <= set(group)]
            chosen, first = _fewest_of_all(known, group, relative, used, entries.entry[:, own], entries.noise)
            if chosen is not None:
                break
        fit = None if chosen is None else _Fit.of(chosen, relative, used)
        if fit is None:
            raise _refusal(what, names, known, group, relative, used, exports, entries, own)
        if not fit.reproduces(entries.entry[:, own], used, everything, entries.noise):
            raise ArgumentError(
                "exports",
                f"the {what} must be the sum of what its parameters change "
                f"({_worst(fit, used, exports, entries, own)})",
            )
        decided |= chosen != first
        rounding = max(rounding, float(entries.noise * fit.amplification(monomials(corners, fit.powers)).max()))
        solution = fit.solve(entries.entry[:, own], used, entries.noise)
        error = np.maximum(error, fit.missed_by(solution, entries.entry[:, own]).max(axis=1, initial=0.0))
        for powers, entry in zip(fit.powers, solution, strict=True):
            found.setdefault(powers, np.zeros(len(entries.scale)))[own] = entry
    terms = [
        Term(entries.matrix(entry / float(np.prod(values[0] ** np.array(powers, dtype=float)))), powers)
        for powers, entry in found.items()
        if entry.any()
    ]
    checked = None if used.all() else float(error[~used].max())
    return Recovery(tuple(terms), float(error[used].max()), checked, entries.digits, rounding, decided)


def _corners(bounds: FloatArray) -> FloatArray:
    """Return corners of a box of bounds (2, n_parameters), shape (n, n_parameters)."""
    return np.array(list(islice(product(*bounds.T.tolist()), _MOST_CORNERS)))


def _fewest_of_all(
    known: Sequence[Powers],
    group: Sequence[int],
    relative: FloatArray,
    used: BoolArray,
    entry: FloatArray,
    noise: float,
) -> tuple[tuple[Powers, ...] | None, tuple[Powers, ...] | None]:
    """Return the terms of `_fewest`, found from some of the entries (n_exports, n).

    The entries that these terms miss, such as that of a single spring in a solid, are then looked at too.
    """
    some = np.arange(entry.shape[1])[:: max(entry.shape[1] // MOST_SAMPLED, 1)]
    while True:
        chosen, first = _fewest(known, group, relative, used, entry[:, some], noise)
        fit = None if chosen is None else _Fit.of(chosen, relative, used)
        if fit is None or len(some) == entry.shape[1]:
            return chosen, first
        if fit.reproduces(entry, used, np.ones(len(used), dtype=bool), noise):
            return chosen, first
        missed = np.setdiff1d(np.argsort(fit.compute_errors(entry, used).max(axis=0))[-_MOST_MISSED:], some)
        if not len(missed):
            return chosen, first
        some = np.concatenate([some, missed])


def _fewest(
    known: Sequence[Powers],
    group: Sequence[int],
    relative: FloatArray,
    used: BoolArray,
    entry: FloatArray,
    noise: float,
) -> tuple[tuple[Powers, ...] | None, tuple[Powers, ...] | None]:
    """Return the terms known and the fewest more that reproduce all exports, and those used; None if none do."""
    first = None
    everything = np.ones(len(used), dtype=bool)
    for powers in _sets_of_powers(known, group, relative.shape[1], int(used.sum())):
        fit = _Fit.of(powers, relative, used)
        if fit is None or not fit.reproduces(entry, used, used, noise):
            continue
        first = first or powers
        if fit.reproduces(entry, used, everything, noise):
            return powers, first
    return None, first


def _sets_of_powers(
    known: Sequence[Powers], group: Sequence[int], n_parameters: int, most: int
) -> Iterator[tuple[Powers, ...]]:
    """Yield the terms known with more of a group of parameters: the fewest first, and of these the simplest."""
    choices = []
    for size in range(min(len(group), _FACTORS) + 1):
        for those in combinations(group, size):
            for some in product(POWERS, repeat=size):
                powers = np.zeros(n_parameters, dtype=int)
                powers[list(those)] = some
                choices.append(tuple(powers.tolist()))
    choices = sorted((one for one in choices if one not in known), key=_complexity)
    sets = ((*known, *some) for size in range(most - len(known) + 1) for some in _simplest(choices, size))
    yield from islice((one for one in sets if one), _MOST_TRIED)


def _simplest(choices: Sequence[Powers], size: int) -> Iterable[tuple[Powers, ...]]:
    """Return sets of a size, the simplest first, as far as they will be tried."""
    some = islice(combinations(choices, size), 10 * _MOST_TRIED)
    return sorted(some, key=lambda one: sum(map(_complexity, one)))


def _complexity(powers: Powers) -> int:
    """Return a number by which sets of equally many terms are ordered, the simplest first."""
    return sum(_RANK[power] for power in powers)


def _refusal(
    what: str,
    names: Sequence[str],
    known: Sequence[Powers],
    group: Sequence[int],
    relative: FloatArray,
    used: BoolArray,
    exports: Sequence[Export],
    entries: Entries,
    own: IntArray,
) -> ArgumentError:
    """Return why no terms of a group of parameters reproduce the exports, with the entries that say so.

    They are those that the terms miss which suit most of the entries.
    """
    best, least = None, np.inf
    sample = entries.entry[:, own[:: max(len(own) // MOST_SAMPLED, 1)]]
    for powers in islice(_sets_of_powers(known, group, relative.shape[1], int(used.sum())), _MOST_COMPARED):
        fit = _Fit.of(powers, relative, used)
        error = np.inf if fit is None else float(np.median(fit.compute_errors(sample, used).max(axis=0)))
        if error < 0.1 * least:
            best, least = fit, error
    those = names_in_words([names[j] for j in group]) or "nothing"
    if best is None:
        told = names_in_words([_in_words(powers, names) for powers in known])
        return ArgumentError(
            "exports",
            f"more are needed, not kept for checking, in which {those} are changed together: there are "
            f"entries of the {what} that several of them change, and {told} cannot be told apart there",
        )
    return NotSeparableError(
        "exports",
        f"what {those} changes of the {what} must be a sum of products of powers from {min(POWERS)} to "
        f"{max(POWERS)} ({_worst(best, used, exports, entries, own)})",
    )


def _worst(fit: _Fit, used: BoolArray, exports: Sequence[Export], entries: Entries, own: IntArray) -> str:
    """Return the entries that are reproduced worst, in the export where they are."""
    error = fit.compute_errors(entries.entry[:, own], used)
    at = int(np.argmax(error.max(axis=1)))
    worst = np.argsort(error[at])[::-1][:TOLD]
    told = "; ".join(f"{entries.place(int(own[k]))} by {significant(float(error[at, k]))}" for k in worst)
    return f"{exports[at].name or f'export {at}'} is missed, relative to the diagonal, at {told}"


def _in_words(powers: Sequence[float], names: Sequence[str]) -> str:
    """Return a term as ``"E t³"``; that without parameters is ``"constant"``."""
    raised: Mapping[float, str] = {1: "", 2: "²", 3: "³", -1: "⁻¹"}
    factors = [
        f"{name}{raised.get(power, f'^{typed(power)}')}"
        for name, power in zip(names, powers, strict=True)
        if power
    ]
    return " ".join(factors) or "constant"
