"""Which parameters, and combinations of them, the data inform: by the linearised model, and by the draws."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fmu.analysis.identifiability import Identifiability, combination, kept_identifiability
from fmu.analysis.trace.modal_states import MAXIMUM, START
from fmu.analysis.trace.reading import has, parameter_draws, parameter_names
from fmu.numbers import share
from fmu.types import FloatArray

if TYPE_CHECKING:
    import xarray as xr


LINEARISED_LEFT = 0.95
"""A direction is uninformed if this part of its prior standard deviation remains in the linearised model."""
_NAMED, _ALIKE = 0.25, 0.05


class Uninformed(NamedTuple):
    """A direction of the parameter space on which the data carry no information.

    Attributes
    ----------
    direction : ndarray, shape (ndim,)
        A unit vector, in prior standard deviations.
    names : tuple of str
        The parameters that make it up, in the order of theta.
    words : str
        ``"k"``, or the combination, the largest component first: ``"0.80 c − 0.60 b"``.
    told : str
        The combination that the data determine instead, if it has a simple form: ``"k/m"``; else empty.
    """

    direction: FloatArray
    names: tuple[str, ...]
    words: str
    told: str


def left_to_prior(found: Identifiability) -> list[Uninformed]:
    """Return the directions along which 95 % or more of the prior sd remains in a linearised model.

    Parameters on which no measured mode depends come first, one direction each. The other directions are given in
    the sparsest basis that elimination finds, since any basis of their span would do.
    """
    most = np.sqrt(LINEARISED_LEFT**-2 - 1.0)
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
    """Return a sentence for each direction that the measured modes cannot determine, with a remedy."""
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
                f"Individually, {listed(one.names)} are left to the prior: {left} along their joint change. "
                f"{_REMEDY}"
            )
        else:
            said.append(
                f"The measured modes are insensitive to the combination {one.words} (in prior standard "
                f"deviations): {left}, and {listed(one.names)} are left to the prior along it. {_REMEDY}"
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
    return Uninformed(
        direction,
        tuple(names[k] for k in sorted(large)),
        combination(direction, names),
        _told(relative, large, names),
    )


def _told(relative: FloatArray, large: NDArray[np.int64], names: tuple[str, ...]) -> str:
    """Return the ratio or product that is constant along a direction: ``"k/m"``; empty if there is none."""
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


DATA, PRIOR, COMBINED = "data", "prior", "combination"
"""What determines a parameter: the data, the prior alone, or the data in a combination only."""
LEFT = 0.9
"""A direction is uninformed if this part of the prior standard deviation remains in the draws.

It is below 1 because of the Monte-Carlo error: 3.5 % of a standard deviation at an ESS of 400.
"""
_LEAST_ALONG, _LEAST_BY_ENTROPY = 0.5, 0.7
_NAMED, _ALONE = 0.25, 0.9


@dataclass(frozen=True, eq=False)
class Information:
    """What the data determine, judged from the draws of a run: parameter by parameter, and along directions.

    Attributes
    ----------
    names : tuple of str
    remaining_sd : ndarray, shape (ndim,)
        Ratio of posterior to prior standard deviation of the `normal_scores`.
    basis : tuple of str
        What determines each parameter: ``"data"``, ``"prior"`` or ``"combination"``.
    uninformed : tuple of (Uninformed, float)
        The uninformed directions, each with the ratio of posterior to prior standard deviation.
    """

    names: tuple[str, ...]
    remaining_sd: FloatArray
    basis: tuple[str, ...]
    uninformed: tuple[tuple[Uninformed, float], ...]

    def warnings(self) -> list[str]:
        """Return a sentence for each direction that the data did not update."""
        said = []
        for one, remains in self.uninformed:
            left = f"{share(min(remains, 1.0))} of the prior standard deviation remains"
            if len(one.names) == 1:
                said.append(f"{one.words} was not updated by the data: {left}")
            elif one.told:
                said.append(
                    f"{listed(one.names)} were not updated individually: the data determine only {one.told}, "
                    f"and {left} along their joint change"
                )
            else:
                said.append(
                    f"the combination {one.words} (in prior standard deviations) was not updated by the data: "
                    f"{left} along it"
                )
        return said


def information(trace: xr.DataTree) -> Information | None:
    """Return what the data determine, from the draws and the linearised model stored in the trace.

    A direction is uninformed if 90 % of its prior standard deviation remains in the draws, in normal scores; or if
    the model linearised at the highest maximum leaves it to the prior (`left_to_prior`) and at least half of the
    prior standard deviation remains in the draws, since bounds and curvature shorten a direction too. A wide
    spread over separate maxima is not a lack of information: the entropy of the draws must be that of a wide
    distribution too.

    A parameter is determined by the prior if it is such a direction by itself; and in combination only if half
    of its variance, and a quarter of the prior standard deviation, come from such directions.

    Returns
    -------
    Information or None
        None if the trace has no draws from the prior, or all posterior draws are the same.
    """
    if not has(trace, "prior"):
        return None
    names = parameter_names(trace)
    z = normal_scores(trace)
    if len(z) < 2 or not np.any(z.std(axis=0) > 0):
        return None
    C = np.atleast_2d(np.cov(z.T))
    directions, told = _linearised_directions(trace, z)
    values, vectors = np.linalg.eigh(C)
    for variance, direction in zip(values[::-1], vectors.T[::-1], strict=True):
        if variance < LEFT**2 or _entropy_sd(z @ direction) < _LEAST_BY_ENTROPY:
            continue
        if np.sum((_orthonormal(directions, len(names)) @ direction) ** 2) < 0.5:
            directions.append(direction)
    U = _orthonormal(directions, len(names))
    found: list[tuple[Uninformed, float]] = []
    for row in eliminated(U):
        unit = row / np.linalg.norm(row)
        one = named(unit, names, np.full(len(names), np.nan))
        found.append((one._replace(told=told.get(frozenset(one.names), "")), float(np.sqrt(unit @ C @ unit))))
    from_prior = np.einsum("ui,uv,vi->i", U, U @ C @ U.T, U)
    share = from_prior / np.maximum(np.diag(C), 1e-12)
    basis = np.where(
        np.sum(U**2, axis=0) >= _ALONE,
        PRIOR,
        np.where((share >= 0.5) & (from_prior >= _NAMED**2), COMBINED, DATA),
    )
    return Information(names, np.sqrt(np.diag(C)), tuple(map(str, basis)), tuple(found))


def _linearised_directions(
    trace: xr.DataTree, z: FloatArray
) -> tuple[list[FloatArray], dict[frozenset[str], str]]:
    """Return the directions that the linearised model leaves to the prior and that the draws confirm.

    As directions of the normal scores `z` (n, ndim), with what the data determine instead for the parameters of
    each.
    """
    directions: list[FloatArray] = []
    told: dict[frozenset[str], str] = {}
    kept = kept_identifiability(trace)
    if not kept:
        return directions, told
    linearised = kept[MAXIMUM if MAXIMUM in kept else START]
    n = len(linearised.names)
    x = parameter_draws(trace).reshape(len(z), -1)[:, :n] / linearised.prior_sd
    for one in left_to_prior(linearised):
        along = x @ one.direction
        if along.std() >= _LEAST_ALONG:
            scores = (z - z.mean(axis=0)).T @ (along - along.mean())  # how much each of them moves along it
            directions.append(scores / np.linalg.norm(scores))
            told[frozenset(one.names)] = one.told
    return directions, told


def information_warnings(trace: xr.DataTree) -> list[str]:
    """Return `Information.warnings` of a trace; empty if it has no draws from the prior."""
    found = information(trace)
    return [] if found is None else found.warnings()


def normal_scores(trace: xr.DataTree) -> FloatArray:
    """Return the draws as normal scores with respect to the prior, shape (n, ndim).

    Φ⁻¹(F(θ)) with the distribution function F of the prior within the bounds, estimated from its draws. The scores
    are standard normal and independent if the data carry no information, for a prior of any shape.
    """
    from scipy.special import ndtri

    names = parameter_names(trace)
    draws = parameter_draws(trace).reshape(-1, len(names))
    scores = np.empty_like(draws)
    for k, name in enumerate(names):
        prior = np.sort(trace["prior"][name].to_numpy().ravel())
        scores[:, k] = ndtri(np.interp(draws[:, k], prior, (np.arange(len(prior)) + 0.5) / len(prior)))
    return scores


def _entropy_sd(x: FloatArray) -> float:
    """Return the standard deviation of the normal distribution that has the entropy of `x`, by a histogram."""
    width = 0.2
    counts = np.bincount(np.floor((x - x.min()) / width).astype(int))
    share = counts[counts > 0] / len(x)
    return float(width * np.exp(-np.sum(share * np.log(share))) / np.sqrt(2.0 * np.pi * np.exp(1.0)))


def _orthonormal(directions: Sequence[FloatArray], ndim: int) -> FloatArray:
    """Return an orthonormal basis of what `directions` span, a row each, shape (rank, ndim)."""
    if not directions:
        return np.zeros((0, ndim))
    _, s, rows = np.linalg.svd(np.array(directions), full_matrices=False)
    return np.asarray(rows[s > 1e-6])
