"""Determination of the parameters' powers in each matrix term from the entries of exported matrices."""

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
"""Smallest tolerance for the error of an entry, relative to √(a_ii a_jj), in an export that is reserved for
checking."""
_FITTED = 1e-9
_RANK = {0: 0, 1: 1, 2: 3, 3: 2, -1: 4}
"""Order in which the powers are tried: elements with a square are rare."""
_FACTORS = 3
"""Largest number of parameters in one term."""
_MOST_TRIED = 30_000
_MOST_MISSED = 50
_MOST_COMPARED = 2000
_MOST_CORNERS = 4096
_WORST_CONDITION = 1e12
TOLD = 3
Powers = tuple[int, ...]


class NotSeparableError(ArgumentError):
    """Raised when matrices are not sums of products of parameter powers."""


@check_arguments
@dataclass(frozen=True, eq=False)
class Export:
    """Matrices exported by another program, and the parameter values for which they were computed.

    Attributes
    ----------
    values : mapping of str to float
        Parameter values, SI units. Values that are the same as in the first export may be omitted.
    model : ExportedModel
        See `fmu.read_model`.
    check : bool
        Whether the export is reserved for checking: it is not used for the recovery, but the recovered terms must
        reproduce it.
    name : str
        Name for messages, such as the file name.

    Raises
    ------
    ValueError
        If a value is not a finite number, or `model` is not an ExportedModel.
    """

    values: Mapping[str, float]
    model: ExportedModel
    check: bool = False
    name: str = ""


@dataclass(frozen=True)
class Recovery:
    """Terms recovered for the stiffness or mass matrix, with the accuracy of the recovery.

    Errors of entries are relative to √(a_ii a_jj), as in `fmu.fem.exports.entries.Entries`.

    Attributes
    ----------
    terms : tuple of Term
    fitted : float
        Largest error of an entry in the exports used.
    checked : float or None
        Largest error of an entry in the exports reserved for checking; None if there are none.
    digits : int
        Significant digits of the exported numbers; 17 if they are exact, as in binary files.
    rounding : float
        Bound on the error that these digits leave in an entry anywhere within the parameters' bounds.
    decided : bool
        Whether the check decided the powers for some entries: the first set of powers that reproduced the exports
        used did not reproduce the exports reserved for checking, but a later set reproduced all exports.
    """

    terms: tuple[Term, ...]
    fitted: float
    checked: float | None
    digits: int
    rounding: float
    decided: bool

    def sentences(self, what: str, names: Sequence[str]) -> list[str]:
        """Return sentences that describe the recovered matrix `what`, such as ``"stiffness"``."""
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


@dataclass(frozen=True, eq=False)
class _Points:
    """Parameter values in each export, and how accurate the matrix entries are.

    Attributes
    ----------
    relative : ndarray, shape (n_exports, n_parameters)
        Parameters relative to their values in the first export.
    used : ndarray of bool, shape (n_exports,)
        False for exports that are reserved for checking.
    noise : float
        Relative rounding error of an entry.
    """

    relative: FloatArray
    used: BoolArray
    noise: float

    def fit(self, powers: tuple[Powers, ...]) -> _Fit | None:
        """Return the least-squares fit of a set of terms, or None if the exports used cannot separate them."""
        X = monomials(self.relative, powers)
        if len(powers) > self.used.sum() or np.linalg.cond(X[self.used]) > _WORST_CONDITION:
            return None
        return _Fit(self, powers, np.linalg.pinv(X[self.used]), X)

    def find_fewest(
        self, known: Sequence[Powers], group: Sequence[int], entry: FloatArray
    ) -> tuple[_Fit | None, tuple[Powers, ...] | None]:
        """Return the fit that reproduces all exports with the fewest new terms in a group of parameters.

        Every fit includes the known terms. The fit is None if no terms reproduce all exports. Also return the
        terms of the first fit that reproduces the exports used, or None if no terms reproduce these exports.

        Both results are determined from a sample of the entries (n_exports, n). Entries that the fit does not
        reproduce, such as the entry of a single spring in a solid, are added to the sample, and the search is
        repeated. If the worst of these entries are in the sample already, the returned fit does not reproduce all
        entries.
        """
        some = np.arange(entry.shape[1])[:: max(entry.shape[1] // MOST_SAMPLED, 1)]
        while True:
            fit, first = self._find_fewest_of(known, group, entry[:, some])
            if fit is None or len(some) == entry.shape[1] or fit.reproduces(entry):
                return fit, first
            missed = np.setdiff1d(np.argsort(fit.compute_errors(entry).max(axis=0))[-_MOST_MISSED:], some)
            if not len(missed):
                return fit, first
            some = np.concatenate([some, missed])

    def _find_fewest_of(
        self, known: Sequence[Powers], group: Sequence[int], entry: FloatArray
    ) -> tuple[_Fit | None, tuple[Powers, ...] | None]:
        first = None
        for powers in self.sets_of_powers(known, group):
            fit = self.fit(powers)
            if fit is None or not fit.reproduces(entry, self.used):
                continue
            first = first or powers
            if fit.reproduces(entry):
                return fit, first
        return None, first

    def sets_of_powers(self, known: Sequence[Powers], group: Sequence[int]) -> Iterator[tuple[Powers, ...]]:
        """Yield sets of terms: the known terms plus new terms in a group of parameters.

        Sets with fewer new terms come first and, among sets of equal size, simpler ones. There are at most
        `_MOST_TRIED` sets, at most `_FACTORS` parameters in a term, and no more terms than exports used.
        """
        choices = []
        for size in range(min(len(group), _FACTORS) + 1):
            for those in combinations(group, size):
                for some in product(POWERS, repeat=size):
                    powers = np.zeros(self.relative.shape[1], dtype=int)
                    powers[list(those)] = some
                    choices.append(tuple(powers.tolist()))
        choices = sorted((one for one in choices if one not in known), key=_complexity)
        sizes = range(int(self.used.sum()) - len(known) + 1)
        sets = ((*known, *more) for size in sizes for more in _simplest(choices, size))
        yield from islice((one for one in sets if one), _MOST_TRIED)


@dataclass(frozen=True, eq=False)
class _Fit:
    """The least-squares fit of one set of terms, from `_Points.fit`."""

    points: _Points
    powers: tuple[Powers, ...]
    inverse: FloatArray  # (n_terms, n_used)
    of_exports: FloatArray  # (n_exports, n_terms)

    def amplification(self, X: FloatArray) -> FloatArray:
        """Return the factors (n,) by which export errors are amplified at points with monomials X (n, n_terms)."""
        return np.asarray(np.abs(X @ self.inverse).sum(axis=1))

    def solve(self, entry: FloatArray) -> FloatArray:
        """Return coefficients (n_terms, n) for entries (n_exports, n), with negligible coefficients set to zero.

        If an entry could then no longer be reproduced in the exports used, all of its coefficients are kept.
        """
        used, noise = self.points.used, self.points.noise
        found = self.inverse @ entry[used]
        least = SAFETY * noise * np.abs(self.inverse).sum(axis=1)
        kept = np.where(np.abs(found) > least[:, None], found, 0.0)
        allowed = 2.0 * self.compute_errors(entry)[used] + SAFETY * (noise * np.abs(entry[used]) + ROUNDING)
        return np.where(np.any(self.missed_by(kept, entry)[used] > allowed, axis=0), found, kept)

    def compute_errors(self, entry: FloatArray) -> FloatArray:
        """Return the error of this fit for each entry in each export, shape (n_exports, n)."""
        return self.missed_by(self.inverse @ entry[self.points.used], entry)

    def missed_by(self, coefficients: FloatArray, entry: FloatArray) -> FloatArray:
        """Return the errors (n_exports, n) that coefficients (n_terms, n) leave in entries (n_exports, n)."""
        return np.asarray(np.abs(entry - self.of_exports @ coefficients))

    def reproduces(self, entry: FloatArray, which: BoolArray | slice = slice(None)) -> bool:
        """Return True if the exports in `which` (by default all) are reproduced within rounding.

        The smallest tolerance is `_FITTED` for the exports used, and `REPRODUCED` for those reserved for checking.
        """
        allowed = np.where(self.points.used, _FITTED, REPRODUCED)
        allowed = np.maximum(allowed, SAFETY * self.points.noise * (1.0 + self.amplification(self.of_exports)))
        return bool(np.all((self.compute_errors(entry).max(axis=1, initial=0.0) <= allowed)[which]))


def monomials(relative: FloatArray, powers: Sequence[Powers]) -> FloatArray:
    """Return the monomials Π θ_j ** p_j at the points `relative` (n, n_parameters), shape (n, n_terms)."""
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
    """Recover one matrix as a sum of terms.

    `changed` (n_parameters, n) marks the entries that each parameter changes.

    Entries changed by the same parameters have the same terms. If two parameters change neighbouring elements, the
    entries at the common nodes have the terms of both parameters. These terms are already known, because entries
    changed by fewer parameters are treated first. The two changes may cancel in such an entry. If its own
    parameters give no fit, the entry is therefore assumed to depend on every parameter that changes the diagonal
    entries of both its row and its column, where nothing cancels.

    Raise NotSeparableError if no terms reproduce the exports, and ArgumentError if more exports are needed or some
    entries are not reproduced.
    """
    points = _Points(values / values[0], used, entries.noise)
    corners = np.array(list(islice(product(*(bounds / values[0]).T.tolist()), _MOST_CORNERS)))
    found: dict[Powers, FloatArray] = {}
    decided, error, rounding = False, np.zeros(len(used)), 0.0
    diagonal = np.flatnonzero(entries.row == entries.column)
    of_row = np.zeros((len(names), len(entries.dofs)), dtype=bool)
    of_row[:, entries.row[diagonal]] = changed[:, diagonal]
    by_parameters, of_entry = np.unique(changed, axis=1, return_inverse=True)
    for k in np.argsort(by_parameters.sum(axis=0), kind="stable"):
        own = np.flatnonzero(of_entry == k)
        entry = entries.entry[:, own]
        groups = [np.flatnonzero(by_parameters[:, k]).tolist()]
        on_diagonal = of_row[:, entries.row[own]] & of_row[:, entries.column[own]]  # of both row and column
        around = np.flatnonzero(on_diagonal.any(axis=1)).tolist()
        groups += [around] if len(around) > len(groups[0]) else []
        for group in groups:
            known = [powers for powers in found if any(powers) and set(np.flatnonzero(powers)) <= set(group)]
            fit, first = points.find_fewest(known, group, entry)
            if fit is not None:
                break
        if fit is None:
            raise _refusal(what, names, known, group, points, exports, entries, own)
        if not fit.reproduces(entry):
            raise ArgumentError(
                "exports",
                f"the {what} must be the sum of what its parameters change ({_worst(fit, exports, entries, own)})",
            )
        decided |= fit.powers != first
        rounding = max(rounding, float(entries.noise * fit.amplification(monomials(corners, fit.powers)).max()))
        solution = fit.solve(entry)
        error = np.maximum(error, fit.missed_by(solution, entry).max(axis=1, initial=0.0))
        for powers, coefficient in zip(fit.powers, solution, strict=True):
            found.setdefault(powers, np.zeros(len(entries.scale)))[own] = coefficient
    terms = [
        Term(entries.matrix(entry / float(np.prod(values[0] ** np.array(powers, dtype=float)))), powers)
        for powers, entry in found.items()
        if entry.any()
    ]
    checked = None if used.all() else float(error[~used].max())
    return Recovery(tuple(terms), float(error[used].max()), checked, entries.digits, rounding, decided)


def _simplest(choices: Sequence[Powers], size: int) -> Iterable[tuple[Powers, ...]]:
    """Return sets of `size` terms, simplest first.

    If there are very many sets, only the first 10 × `_MOST_TRIED` of them are sorted and returned.
    """
    some = islice(combinations(choices, size), 10 * _MOST_TRIED)
    return sorted(some, key=lambda one: sum(map(_complexity, one)))


def _complexity(powers: Powers) -> int:
    """Return the complexity of a term, the sum of its powers' ranks (`_RANK`): 0 for a constant term."""
    return sum(_RANK[power] for power in powers)


def _refusal(
    what: str,
    names: Sequence[str],
    known: Sequence[Powers],
    group: Sequence[int],
    points: _Points,
    exports: Sequence[Export],
    entries: Entries,
    own: IntArray,
) -> ArgumentError:
    """Return the error to raise if no terms reproduce the effects of a group of parameters.

    Its message names the entries with the largest errors under the terms that fit most entries best. If no set of
    terms can be fitted, it says which further exports are needed.
    """
    best, least = None, np.inf
    sample = entries.entry[:, own[:: max(len(own) // MOST_SAMPLED, 1)]]
    for powers in islice(points.sets_of_powers(known, group), _MOST_COMPARED):
        fit = points.fit(powers)
        error = np.inf if fit is None else float(np.median(fit.compute_errors(sample).max(axis=0)))
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
        f"{max(POWERS)} ({_worst(best, exports, entries, own)})",
    )


def _worst(fit: _Fit, exports: Sequence[Export], entries: Entries, own: IntArray) -> str:
    """Return a phrase that names the entries with the largest errors, and the export in which they occur."""
    error = fit.compute_errors(entries.entry[:, own])
    at = int(np.argmax(error.max(axis=1)))
    worst = np.argsort(error[at])[::-1][:TOLD]
    told = "; ".join(f"{entries.place(int(own[k]))} by {significant(float(error[at, k]))}" for k in worst)
    return f"{exports[at].name or f'export {at}'} is missed, relative to the diagonal, at {told}"


def _in_words(powers: Sequence[float], names: Sequence[str]) -> str:
    """Return a term in words, such as ``"E t³"``; a term without parameters is ``"constant"``."""
    raised: Mapping[float, str] = {1: "", 2: "²", 3: "³", -1: "⁻¹"}
    factors = [
        f"{name}{raised.get(power, f'^{typed(power)}')}"
        for name, power in zip(names, powers, strict=True)
        if power
    ]
    return " ".join(factors) or "constant"
