"""What the measured modes cannot tell: parameters, and combinations of them, that are left to the prior."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fmu.analysis.data.identifiability import Identifiability
from fmu.numbers import fixed, share
from fmu.types import FloatArray

LEFT = 0.95
"""Part of the prior's standard deviation: a direction that keeps as much in the linearised model is uninformed."""
_NAMED, _ALIKE = 0.25, 0.05


class Uninformed(NamedTuple):
    """A direction of the parameter space that the data leave to the prior.

    Attributes
    ----------
    direction : ndarray, shape (ndim,)
        Of unit length, in prior standard deviations.
    names : tuple of str
        The parameters that make it up, in the order of theta.
    words : str
        ``"k"``, or the combination, the largest component first: ``"0.80 c − 0.60 b"``.
    told : str
        What the data tell of these parameters instead, where that has a name: ``"k/m"``.
    """

    direction: FloatArray
    names: tuple[str, ...]
    words: str
    told: str


def left_to_prior(found: Identifiability) -> list[Uninformed]:
    """Return the directions along which a linearised model keeps 95 % or more of the prior's standard deviation.

    Parameters on which no measured mode depends come first, each by itself. What else is left is given in the
    basis with the fewest parameters that elimination finds: of several such directions any mixture would do.
    """
    most = np.sqrt(LEFT**-2 - 1.0)
    S, n = found.sensitivity, len(found.names)
    alone = np.linalg.norm(S, axis=0) <= most
    directions = list(np.eye(n)[alone])
    if not alone.all():
        rest = np.flatnonzero(~alone)
        values, rows = np.linalg.svd(S[:, rest])[1:]
        left = rows[np.concatenate([values, np.zeros(len(rest))])[: len(rest)] <= most]
        for row in eliminated(left):
            directions.append(np.zeros(n))
            directions[-1][rest] = row / np.linalg.norm(row)
    with np.errstate(divide="ignore", invalid="ignore"):  # a parameter that is 0 has no relative change
        relative = [direction * found.prior_sd / found.theta for direction in directions]
    return [named(direction, found.names, change) for direction, change in zip(directions, relative, strict=True)]


def doubts(found: Identifiability) -> list[str]:
    """Say what the measured modes will not tell, a sentence a direction, and what to do about it."""
    said = []
    for one in left_to_prior(found):
        remains = 1.0 / np.sqrt(1.0 + np.sum((found.sensitivity @ one.direction) ** 2))
        left = f"{share(min(remains, 1.0))} of the prior standard deviation remains"
        if len(one.names) == 1:
            said.append(
                f"The measured modes carry no information on {one.words}: {left}. Fix it if it is known well, "
                f"or measure something that depends on it."
            )
        elif one.told:
            said.append(
                f"The measured modes cannot separate {listed(one.names)}: they determine only {one.told}. "
                f"Individually, {listed(one.names)} keep the prior: {left} along their joint change. {_REMEDY}"
            )
        else:
            said.append(
                f"The measured modes are insensitive to the combination {one.words} (in prior standard "
                f"deviations): {left}, and {listed(one.names)} keep the prior along it. {_REMEDY}"
            )
    return said


_REMEDY = "Add a known mass, make a static test, measure other modes, or fix one of the parameters."


def eliminated(rows: FloatArray) -> FloatArray:
    """Return a basis of the span of orthonormal `rows` with zeros in it, by Gauss–Jordan elimination."""
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


def named(direction: FloatArray, names: tuple[str, ...], relative: FloatArray) -> Uninformed:
    """Name a direction; `relative` is the change of each parameter along it over its own size."""
    size = np.abs(direction)
    large = np.argsort(-size, kind="stable")
    large = large[size[large] >= _NAMED * size.max()]
    if len(large) == 1:
        return Uninformed(direction, (names[large[0]],), names[large[0]], "")
    sign = np.sign(direction[large[0]])
    parts = [f"{'-' if sign * direction[k] < 0 else '+'} {fixed(size[k], 2)} {names[k]}" for k in large]
    words = " ".join(parts).removeprefix("+ ")
    return Uninformed(direction, tuple(names[k] for k in sorted(large)), words, _told(relative, large, names))


def _told(relative: FloatArray, large: NDArray[np.int64], names: tuple[str, ...]) -> str:
    """Return what stays the same along a direction if it is a common factor: ``"k/m"``; empty if it is none."""
    change = relative[large]
    if not np.all(np.isfinite(relative)) or np.ptp(np.abs(change)) > _ALIKE * np.abs(change).max():
        return ""
    others = np.delete(relative, large)
    if np.any(np.abs(others) > _ALIKE * np.abs(change).max()):
        return ""
    one = [names[k] for k in sorted(large)]
    if np.all(np.sign(change) == np.sign(change[0])):
        return f"{one[0]}/{one[1]}" if len(one) == 2 else f"the ratios of {listed(one)}"
    return f"the product of {listed(one)}" if len(one) == 2 else ""


def listed(names: Sequence[str]) -> str:
    """Return ``"a, b and c"``."""
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
