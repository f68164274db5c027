"""Parameters and combinations of parameters that only the prior determines, or that the data cannot separate."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from fmu.analysis.identifiability import NAMED, Identifiability, combination
from fmu.numbers import names_in_words, share, significant
from fmu.types import BoolArray, FloatArray

_CONFUSED = 0.5
"""The data confuse two parameters if, in their least constrained combination, the smaller component is at least
this fraction of the larger one."""
LINEARISED_LEFT = 0.95
"""Fraction of the prior standard deviation that remains along an uninformed direction of a linearised model."""
_ALIKE = 0.05
_MOST_APART = 3
"""Largest number of similar directions that have a sentence each."""


class Uninformed(NamedTuple):
    """A direction in parameter space about which the data carry hardly any information.

    Attributes
    ----------
    direction : ndarray, shape (ndim,)
        A unit vector, in prior standard deviations.
    names : tuple of str
        Parameters with large components, in the order of theta.
    words : str
        The parameter ``"k"``, or the combination with the largest component first: ``"0.80 c − 0.60 b"``.
    told : str
        The combination that the data determine instead, such as ``"k/m"``; empty if it has no simple form.
    """

    direction: FloatArray
    names: tuple[str, ...]
    words: str
    told: str


def left_to_prior(found: Identifiability) -> list[Uninformed]:
    """Return the directions along which 95 % or more of the prior sd remains in a linearised model.

    Parameters on which the measured modes hardly depend, alone and together, come first, one direction each. Any
    basis of the remaining directions would be valid. A sparse basis, found by elimination, is returned.
    """
    most = float(np.sqrt(LINEARISED_LEFT**-2 - 1.0))
    S, n = found.sensitivity, len(found.names)
    alone = _weak(S, most)
    directions = list(np.eye(n)[alone])
    if not alone.all():
        rest = np.flatnonzero(~alone)
        values, rows = np.linalg.svd(S[:, rest])[1:]
        left = rows[np.concatenate([values, np.zeros(len(rest))])[: len(rest)] <= most]
        for row in eliminate(left):
            directions.append(np.zeros(n))
            directions[-1][rest] = row / np.linalg.norm(row)
    with np.errstate(divide="ignore", invalid="ignore"):  # a parameter that is 0 has no relative change
        relative = [direction * found.prior_sd / found.theta for direction in directions]
    return [
        name_direction(direction, found.names, change)
        for direction, change in zip(directions, relative, strict=True)
    ]


def _weak(S: FloatArray, most: float) -> BoolArray:
    """Return a mask of the columns of S, shape (ndim,), that are small alone and together.

    No singular value of these columns exceeds `most`, and the other columns have as many singular values above
    `most` as S has. A column is small if its length does not exceed a limit. The limit is the first of `most`,
    `most`/√m and 0 for which this holds, where m is the number of columns that are at most `most` long.
    """

    def count(part: FloatArray) -> int:
        return int(np.sum(np.linalg.svd(part, compute_uv=False) > most))

    size = np.linalg.norm(S, axis=0)
    m = max(1, int(np.sum(size <= most)))
    for limit in (most, most / float(np.sqrt(m))):
        weak = size <= limit
        if count(S[:, weak]) == 0 and count(S[:, ~weak]) == count(S):
            return np.asarray(weak)
    return np.asarray(size == 0.0)


def doubts(found: Identifiability) -> list[str]:
    """Return sentences on the directions that the measured modes cannot determine, with a remedy.

    Each direction has a sentence. More than three single parameters share one, and so do more than three
    combinations that have parameters in common.
    """
    left = left_to_prior(found)
    alone, combined = ([one for one in left if (len(one.names) == 1) is single] for single in (True, False))
    said = []
    for group in [*_split_small_groups([alone]), *_split_small_groups(_with_common_parameters(combined))]:
        span = np.linalg.qr(np.array([one.direction for one in group]).T)[0]
        remains = 1.0 / np.hypot(1.0, np.linalg.norm(found.sensitivity @ span, 2))
        said.append(_doubt(group, share(min(float(remains), 1.0)), found.names))
    return said


def _split_small_groups(groups: Iterable[list[Uninformed]]) -> list[list[Uninformed]]:
    """Return the groups of directions; small groups, of at most `_MOST_APART`, are split into groups of one."""
    return [part for group in groups for part in ([group] if len(group) > _MOST_APART else [[o] for o in group])]


def _with_common_parameters(directions: list[Uninformed]) -> list[list[Uninformed]]:
    """Return groups of directions, connected by the parameters that they have in common."""
    if not directions:
        return []
    common = [[not set(one.names).isdisjoint(other.names) for other in directions] for one in directions]
    label = connected_components(np.array(common))[1]
    return [[directions[i] for i in np.flatnonzero(label == k)] for k in range(label.max() + 1)]


def _doubt(group: list[Uninformed], remains: str, order: tuple[str, ...]) -> str:
    """Return a sentence on one direction or several, along which `remains` or more of the prior sd remains."""
    one, involved = group[0], {name for direction in group for name in direction.names}
    names = names_in_words([name for name in order if name in involved])
    least = "at least " if len(group) > 1 and remains != share(1.0) else ""
    left = f"{least}{remains} of the prior standard deviation remains, linearised at the start"
    k, n = len(involved) - len(group), len(involved)
    if k <= 0:
        them, are = ("it", "it is") if n == 1 else ("them", "they are")
        return (
            f"The measurement carries no information on {names}: {left}. Fix {them} if {are} known well, or "
            f"measure something that depends on {them}."
        )
    if len(group) > 1:
        return (
            f"The measurement cannot separate {names}: it determines at most {k} combination{'s' * (k > 1)} "
            f"of these {n}, and along the others {left}. {_REMEDY}"
        )
    if one.told:
        return (
            f"The measurement cannot separate {names}: it determines only {one.told}. Individually, {names} "
            f"are left to the prior: {left} along their joint change. {_REMEDY}"
        )
    return (
        f"The measurement is insensitive to the combination {one.words} (in prior standard deviations): "
        f"{left}; {names} are left to the prior along it. {_REMEDY}"
    )


_REMEDY = "Add a known mass, make a static test, measure other modes, or fix one of the parameters."


class Pair(NamedTuple):
    """Two parameters, and the combination of them that the data constrain least.

    Attributes
    ----------
    names : tuple of (str, str)
    direction : ndarray, shape (ndim,)
        The combination, a unit vector in prior standard deviations.
    remaining_sd : float
        Ratio of posterior to prior standard deviation along this direction.
    change : float
        Change of the data in the linearised model, in measurement standard deviations, for a step of one prior
        standard deviation along this direction.
    words : str
        The combination in words: ``"0.71 E1 − 0.70 E5"``.
    """

    names: tuple[str, str]
    direction: FloatArray
    remaining_sd: float
    change: float
    words: str

    def sentence(self, is_separated: bool) -> str:
        """Return two sentences on how well the data separate the two parameters.

        The first says whether they are separated (`is_separated`). The second gives `change` and `remaining_sd`.
        """
        names = names_in_words(self.names)
        first = f"Hardest to separate: {names}" if is_separated else f"The data cannot separate {names}"
        left = share(min(self.remaining_sd, 1.0))
        return (
            f"{first}. One prior standard deviation along {self.words} changes the data by "
            f"{significant(self.change, 2)} measurement sd; the data leave {left} of it."
        )


def hardest_pair(found: Identifiability, covariance: FloatArray) -> Pair | None:
    """Return the two parameters that the data separate least, judged by the posterior covariance.

    In the plane of two parameters, the combination that the data constrain least is the leading eigenvector of the
    posterior covariance in prior standard deviations. If it is mostly one parameter, the data do not confuse the
    two. The cosine between two columns of the sensitivity does not show whether they can be separated: columns
    with cosine 0.99 and length 50 differ by 7 measurement standard deviations.

    Parameters
    ----------
    found : Identifiability
    covariance : ndarray, shape (ndim, ndim)
        Posterior covariance of the parameters, in prior standard deviations.

    Returns
    -------
    Pair or None
        None if the data confuse no two parameters, or there is only one parameter.
    """
    hardest, most = None, 0.0
    for i, j in combinations(range(len(found.names)), 2):
        values, vectors = np.linalg.eigh(covariance[np.ix_((i, j), (i, j))])
        size = np.abs(vectors[:, 1])
        if size.min() >= _CONFUSED * size.max() and values[1] > most:
            most, hardest = float(values[1]), (i, j, vectors[:, 1])
    if hardest is None:
        return None
    i, j, weights = hardest
    direction = np.zeros(len(found.names))
    direction[[i, j]] = weights
    change = float(np.linalg.norm(found.sensitivity @ direction))
    names = found.names[i], found.names[j]
    return Pair(names, direction, float(np.sqrt(most)), change, combination(direction, found.names))


def eliminate(rows: FloatArray) -> FloatArray:
    """Return a sparse basis with the same span as the orthonormal `rows`, by Gauss–Jordan elimination."""
    rows = rows.copy()
    free = np.ones(rows.shape[1], dtype=bool)
    for i in range(len(rows)):
        left = np.abs(rows[i:]) * free
        k, j = np.unravel_index(np.argmax(left), left.shape)
        rows[[i, i + int(k)]] = rows[[i + int(k), i]]
        rows[i] /= rows[i, j]
        others = np.arange(len(rows)) != i
        rows[others] -= np.outer(rows[others, j], rows[i])
        free[j] = False
    return rows


def name_direction(direction: FloatArray, names: tuple[str, ...], relative: FloatArray) -> Uninformed:
    """Return a direction with a name made from its large components.

    `relative` (ndim,) is each parameter's relative change along the direction. If it is not finite
    for a parameter, the combination that the data determine instead is left empty.
    """
    size = np.abs(direction)
    large = np.argsort(-size, kind="stable")
    large = large[size[large] >= NAMED * size.max()]
    if len(large) == 1:
        return Uninformed(direction, (names[large[0]],), names[large[0]], "")
    return Uninformed(
        direction,
        tuple(names[k] for k in sorted(large)),
        combination(direction, names),
        _constant_in_words(relative, large, names),
    )


def _constant_in_words(relative: FloatArray, large: NDArray[np.int64], names: tuple[str, ...]) -> str:
    """Return the ratio or product that is constant along a direction, such as ``"k/m"``, or "" if none is."""
    change = relative[large]
    if not np.all(np.isfinite(relative)) or np.ptp(np.abs(change)) > _ALIKE * np.abs(change).max():
        return ""
    others = np.delete(relative, large)
    if np.any(np.abs(others) > _ALIKE * np.abs(change).max()):
        return ""
    one = [names[k] for k in sorted(large)]
    if np.all(np.sign(change) == np.sign(change[0])):
        return f"{one[0]}/{one[1]}" if len(one) == 2 else f"the ratios of {names_in_words(one)}"
    return f"the product of {names_in_words(one)}" if len(one) == 2 else ""
