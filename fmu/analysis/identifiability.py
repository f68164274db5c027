"""Which parameters, and combinations of them, the measured modes constrain, by the model linearised at a point."""

from __future__ import annotations

import html
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fmu.analysis.maxima.results import Maxima
from fmu.analysis.maxima.search import is_updating
from fmu.analysis.trace.modal_states import MAXIMUM, START
from fmu.analysis.trace.reading import has, with_group
from fmu.arguments import ArgumentError, check_arguments
from fmu.box import find_inside
from fmu.numbers import fixed, names_in_words, share, significant
from fmu.progress.phases import phase
from fmu.tables import data_frame, distinct, text_table, wrap_text
from fmu.types import FloatArray

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

    from fmu.posterior.parameters import Parameter
    from fmu.posterior.problem import UpdatingProblem


GROUP = "identifiability"
"""Group of a trace that stores it."""
INFORMED = 1.0
"""Singular value above which the data constrain a direction more than the prior does."""
_NODES = 256
_NAMED = 0.25
"""A component is named if it is at least this part of the largest."""
_CONFUSED = 0.5
"""Two parameters are confused if the smaller component of a combination is at least this part of the larger."""
_SENTENCES = 3


def combination(direction: FloatArray, names: Sequence[str]) -> str:
    """Return a direction as a sum of its larger components, the largest first: ``"0.71 E3 − 0.70 E4"``."""
    size = np.abs(direction)
    large = [k for k in np.argsort(-size, kind="stable") if size[k] >= _NAMED * size.max()]
    sign = np.sign(direction[large[0]])
    parts = (f"{'−' if sign * direction[k] < 0 else '+'} {fixed(size[k], 2)} {names[k]}" for k in large)
    return " ".join(parts).removeprefix("+ ")


@dataclass(frozen=True, eq=False)
class Identifiability:
    """Which directions of the parameter space the data constrain, linearised at one parameter vector.

    With S = L⁻¹ (∂f/∂θ) D, where LLᵀ is the covariance of the measurement and D the standard deviations of the
    prior within its bounds, SᵀS is the Fisher information in prior standard deviations. Its singular value
    decomposition orders directions by the information in the data: along a direction of singular value s, a
    posterior with a Gaussian prior has 1/√(1 + s²) of the prior's standard deviation (Cui et al. 2014, Inverse
    Problems 30, 114015, section 2). Truncation of the posterior by the bounds is not included.

    Attributes
    ----------
    names, units : tuple of str
        Names and units of the parameters.
    labels : tuple of str
        Labels of the rows of `sensitivity`: the measured modes, or their frequencies and shape components.
    theta : ndarray, shape (ndim,), SI units
        Where the model is linearised.
    prior_sd : ndarray, shape (ndim,), SI units
        Diagonal of D.
    sensitivity : ndarray, shape (n_measured, ndim)
        S: change of each frequency or shape component, in standard deviations of its measurement, for a change
        of one prior standard deviation. If the errors are correlated, conditional on the modes before it.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    labels: tuple[str, ...]
    theta: FloatArray
    prior_sd: FloatArray
    sensitivity: FloatArray

    @property
    def singular_values(self) -> FloatArray:
        """Singular values of S, shape (ndim,), descending; zero where there are more parameters than modes."""
        return self._svd[0]

    @property
    def directions(self) -> FloatArray:
        """Orthonormal directions, shape (ndim, ndim), a row each, in units of the prior's standard deviations."""
        return self._svd[1]

    @property
    def _svd(self) -> tuple[FloatArray, FloatArray]:
        values, directions = np.linalg.svd(self.sensitivity)[1:]
        padded = np.zeros(len(self.names))
        padded[: len(values)] = values
        largest = np.argmax(np.abs(directions), axis=1)
        sign = np.sign(directions[np.arange(len(directions)), largest])
        return padded, directions * sign[:, None]

    @property
    def n_informed(self) -> int:
        """Number of directions that the data constrain more than the prior does."""
        return int(np.sum(self.singular_values > INFORMED))

    @property
    def fisher_information(self) -> FloatArray:
        """JᵀΣ⁻¹J of the parameters themselves, shape (ndim, ndim), 1/SI units²."""
        information: FloatArray = (self.sensitivity.T @ self.sensitivity) / np.outer(self.prior_sd, self.prior_sd)
        return information

    @property
    def remaining_sd(self) -> FloatArray:
        """Posterior over prior standard deviation of each parameter, shape (ndim,), in the linearised model."""
        return np.asarray(np.sqrt(np.sum(self.directions**2 / (1.0 + self.singular_values**2)[:, None], axis=0)))

    @property
    def covariance(self) -> FloatArray:
        """Posterior covariance (I + SᵀS)⁻¹ in prior standard deviations, shape (ndim, ndim), linearised."""
        V, s = self.directions, self.singular_values
        return np.asarray((V.T / (1.0 + s**2)) @ V)

    def table(self) -> pd.DataFrame:
        """Return one row per direction: ``singular_value``, ``remaining_sd``, and each parameter's component."""
        s = self.singular_values
        names = distinct(["singular_value", "remaining_sd", *self.names])
        columns = dict(zip(names, (s, 1.0 / np.sqrt(1.0 + s**2), *self.directions.T), strict=True))
        return data_frame(columns, "direction", range(1, len(s) + 1))

    def sentences(self) -> list[str]:
        """Return the findings on the directions of the linearised model, which ignores the bounds, in words."""
        n, k = len(self.names), self.n_informed
        said = [
            f"Linearised, and without the bounds, the data constrain {k} of {n} directions of the parameter space "
            "more than the prior does."
        ]
        left = [share(1.0 / np.sqrt(1.0 + s**2)) + " of the prior standard deviation" for s in self._svd[0]]
        for direction, remains in list(zip(self.directions, left, strict=True))[k : k + _SENTENCES]:
            said.append(
                f"Along {combination(direction, self.names)} the prior and the bounds say more than the data: "
                f"{remains} would remain."
            )
        if n - k > _SENTENCES:
            said.append(f"The same holds for {n - k - _SENTENCES} more.")
        if k == n:
            least = combination(self.directions[-1], self.names)
            said.append(f"The least constrained direction is {least}: {left[-1]} would remain.")
        return said

    def __str__(self) -> str:
        table = self.table()
        rows = [[str(k), *map(significant, row)] for k, row in zip(table.index, table.to_numpy(), strict=True)]
        text = text_table(["", *map(str, table.columns)], rows)
        return "\n".join([*map(wrap_text, self.sentences()), "", "Directions, in prior standard deviations", text])

    def _repr_html_(self) -> str:
        said = "".join(f"<p>{html.escape(sentence)}</p>" for sentence in self.sentences())
        return said + str(self.table().to_html(float_format=significant))


@check_arguments
def identifiability(problem: UpdatingProblem, theta: ArrayLike | None = None) -> Identifiability:
    """Find the directions of the parameter space that the data constrain, by a linearised model.

    Parameters
    ----------
    problem : UpdatingProblem
        With errors in the modes. Inferred standard deviations of errors are held fixed.
    theta : array_like, shape (ndim,), optional
        Point of linearisation, SI units, within the bounds; the start if not given.

    Returns
    -------
    Identifiability

    Raises
    ------
    ValueError
        If theta is not within the bounds, the model has no finite derivative there, or the problem's errors are
        not those of modes (the modal residual).
    """
    if not (is_updating(problem) and problem.likelihood.of_modes):
        raise ArgumentError("problem", "must be an UpdatingProblem with errors in the modes")
    point = problem.start if theta is None else np.asarray(theta, dtype=float)
    if point.shape != (problem.ndim,) or not find_inside(point, problem.lower, problem.upper)[1]:
        raise ArgumentError("theta", f"must be {problem.ndim} numbers within the bounds", point.tolist())
    n = problem.n_structural
    prior_sd = np.array([truncated_sd(parameter) for parameter in problem.parameters[:n]])
    sensitivity = problem.likelihood.sensitivity(point[None])[0] * prior_sd
    if not np.all(np.isfinite(sensitivity)):
        raise ArgumentError("theta", "the modes must have finite derivatives", f"none at {point.tolist()}")
    labels = problem.likelihood.labels(tuple(map(str, problem.data.labels)))
    return Identifiability(problem.names[:n], problem.units[:n], labels, point[:n], prior_sd, sensitivity)


def with_identifiability(
    trace: xr.DataTree, problem: UpdatingProblem, maxima: Maxima | None = None
) -> xr.DataTree:
    """Return the trace with the identifiability at the start and, if known, at the highest maximum stored in it.

    A point at which the model has no derivative is left out, so that the draws are not lost.
    """
    import xarray as xr

    states = {START: problem.start} | ({} if maxima is None else {MAXIMUM: maxima[0].theta})
    linearised = {}
    with phase("identifiability", len(states)) as under_way:
        for name, theta in states.items():
            with suppress(ValueError):
                linearised[name] = identifiability(problem, theta)
            under_way.advance()
    if not linearised:
        return trace
    found = list(linearised.values())
    variables = {
        name: (("state", *dims), np.array([getattr(one, name) for one in found]))
        for name, dims in (
            ("theta", ("parameter",)),
            ("prior_sd", ("parameter",)),
            ("sensitivity", ("mode", "parameter")),
        )
    }
    coordinates = {
        "state": list(linearised),
        "parameter": list(found[0].names),
        "unit": ("parameter", list(found[0].units)),
        "mode": list(found[0].labels),
    }
    return with_group(trace, GROUP, xr.Dataset(variables, coords=coordinates))


def kept_identifiability(trace: xr.DataTree) -> dict[str, Identifiability]:
    """Return the results that `with_identifiability` stored, by name of the state; empty if there is nothing."""
    if not has(trace, GROUP):
        return {}
    kept = trace[GROUP].to_dataset()
    names, units, labels = (tuple(map(str, kept[name].to_numpy())) for name in ("parameter", "unit", "mode"))
    arrays = [kept[name].to_numpy() for name in ("theta", "prior_sd", "sensitivity")]
    return {
        str(state): Identifiability(names, units, labels, *(array[i] for array in arrays))
        for i, state in enumerate(kept["state"].to_numpy())
    }


def truncated_sd(parameter: Parameter) -> float:
    """Return the standard deviation of a parameter's prior within its bounds, by Gauss–Legendre quadrature."""
    lower, upper = parameter.prior.box(parameter.lower, parameter.upper)
    node, weight = np.polynomial.legendre.leggauss(_NODES)
    x = 0.5 * (lower + upper) + 0.5 * (upper - lower) * node
    log_pdf = parameter.prior.log_pdf(x)
    weight = weight * np.exp(log_pdf - np.max(log_pdf))
    mean = np.sum(weight * x) / np.sum(weight)
    return float(np.sqrt(np.sum(weight * (x - mean) ** 2) / np.sum(weight)))


LINEARISED_LEFT = 0.95
"""A direction is uninformed if this part of its prior standard deviation remains in the linearised model."""
_ALIKE = 0.05


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
        for row in eliminate(left):
            directions.append(np.zeros(n))
            directions[-1][rest] = row / np.linalg.norm(row)
    with np.errstate(divide="ignore", invalid="ignore"):  # a parameter that is 0 has no relative change
        relative = [direction * found.prior_sd / found.theta for direction in directions]
    return [
        name_direction(direction, found.names, change)
        for direction, change in zip(directions, relative, strict=True)
    ]


def doubts(found: Identifiability) -> list[str]:
    """Return a sentence for each direction that the measured modes cannot determine, with a remedy."""
    said = []
    for one in left_to_prior(found):
        names = names_in_words(one.names)
        remains = 1.0 / np.sqrt(1.0 + np.sum((found.sensitivity @ one.direction) ** 2))
        left = f"{share(min(remains, 1.0))} of the prior standard deviation remains, linearised at the start"
        if len(one.names) == 1:
            said.append(
                f"The measured modes carry no information on {one.words}: {left}. Fix it if it is known well, "
                f"or measure something that depends on it."
            )
        elif one.told:
            said.append(
                f"The measured modes cannot separate {names}: they determine only {one.told}. Individually, "
                f"{names} are left to the prior: {left} along their joint change. {_REMEDY}"
            )
        else:
            said.append(
                f"The measured modes are insensitive to the combination {one.words} (in prior standard "
                f"deviations): {left}; {names} are left to the prior along it. {_REMEDY}"
            )
    return said


_REMEDY = "Add a known mass, make a static test, measure other modes, or fix one of the parameters."


class Pair(NamedTuple):
    """Two parameters, and the combination of them that the data narrow least.

    Attributes
    ----------
    names : tuple of (str, str)
    direction : ndarray, shape (ndim,)
        The combination, a unit vector in prior standard deviations.
    remaining_sd : float
        Posterior over prior standard deviation along it.
    change : float
        By how many standard deviations of the measurement the data change for one prior standard deviation along
        it, in the linearised model.
    words : str
        ``"0.71 E1 − 0.70 E5"``.
    """

    names: tuple[str, str]
    direction: FloatArray
    remaining_sd: float
    change: float
    words: str

    def sentence(self, is_separated: bool) -> str:
        """Return in words whether the data separate the two, with both numbers."""
        names = names_in_words(self.names)
        first = f"Hardest to separate: {names}" if is_separated else f"The data cannot separate {names}"
        left = share(min(self.remaining_sd, 1.0))
        return (
            f"{first}. One prior standard deviation along {self.words} changes the data by "
            f"{significant(self.change, 2)} measurement sd; the data leave {left} of it."
        )


def hardest_pair(found: Identifiability, covariance: FloatArray) -> Pair | None:
    """Return the two parameters that the data separate least, by the posterior covariance.

    In the plane of two parameters the data narrow one combination least: the leading eigenvector of their
    posterior covariance in prior standard deviations. If it is mostly one parameter, the data do not confuse the
    two. The cosine between two columns of the sensitivity does not say whether they can be separated: columns of
    cosine 0.99 and length 50 differ by 7 standard deviations of the measurement.

    Parameters
    ----------
    found : Identifiability
    covariance : ndarray, shape (ndim, ndim)
        Posterior covariance of its parameters, in prior standard deviations.

    Returns
    -------
    Pair or None
        None if the data confuse no two parameters, or there is only one.
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


def name_direction(direction: FloatArray, names: tuple[str, ...], relative: FloatArray) -> Uninformed:
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
        _constant_in_words(relative, large, names),
    )


def _constant_in_words(relative: FloatArray, large: NDArray[np.int64], names: tuple[str, ...]) -> str:
    """Return the ratio or product that is constant along a direction: ``"k/m"``; empty if there is none."""
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
