"""Find the directions in parameter space that the measured modes constrain, with a model linearised at a point."""

from __future__ import annotations

import html
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from fmu.analysis.maxima.results import Maxima
from fmu.analysis.trace.densities import is_updating
from fmu.analysis.trace.modal_states import MAXIMUM, START
from fmu.analysis.trace.reading import has, with_group
from fmu.arguments import ArgumentError, check_arguments
from fmu.box import find_inside
from fmu.numbers import fixed, share, significant
from fmu.progress.phases import phase
from fmu.tables import data_frame, distinct, text_table, wrap_text
from fmu.types import FloatArray

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

    from fmu.posterior.parameters import Parameter
    from fmu.posterior.problem import UpdatingProblem


GROUP = "identifiability"
"""Name of the trace group that stores the identifiability."""
INFORMED = 1.0
"""Singular value above which the data constrain a direction more than the prior does."""
_INTEGRATED = ("score", "effect", "covariate")
_OMITTED = ("sd", "correlation", "correlation time", "share", "date", "kink")
"""Kinds of parameters (`fmu.posterior.joint.varies.base.Role`) that are marginalised, and kinds that are
omitted."""
_NODES = 256
NAMED = 0.25
"""A component is named if it is at least this fraction of the largest component."""
_SENTENCES = 3


def combination(direction: FloatArray, names: Sequence[str]) -> str:
    """Describe a direction by its larger components in descending order: ``"0.71 E3 − 0.70 E4"``."""
    size = np.abs(direction)
    large = [k for k in np.argsort(-size, kind="stable") if size[k] >= NAMED * size.max()]
    sign = np.sign(direction[large[0]])
    parts = (f"{'−' if sign * direction[k] < 0 else '+'} {fixed(size[k], 2)} {names[k]}" for k in large)
    return " ".join(parts).removeprefix("+ ")


@dataclass(frozen=True, eq=False)
class Identifiability:
    """Directions in parameter space that the data constrain, linearised at one parameter vector.

    With S = L⁻¹ (∂f/∂θ) D, where f are the measured quantities, LLᵀ is their covariance and D the diagonal matrix
    of prior standard deviations within the bounds, SᵀS is the Fisher information in prior standard deviations. The
    singular value decomposition of S orders directions by the information in the data: along a direction of
    singular value s, a posterior with a Gaussian prior has 1/√(1 + s²) of the prior's standard deviation (Cui et
    al. 2014, Inverse Problems 30, 114015, section 2). Truncation of the posterior at the bounds is not included.

    Attributes
    ----------
    names, units : tuple of str
        Parameter names and units. Parameters that `fmu.identifiability` holds fixed, marginalises or omits are not
        included; ndim below is the number of the others.
    labels : tuple of str
        Row labels of `sensitivity`: the measured modes, or their frequencies and shape components.
    theta : ndarray, shape (ndim,), SI units
        Parameter vector at which the model is linearised.
    prior_sd : ndarray, shape (ndim,), SI units
        Diagonal of D.
    sensitivity : ndarray, shape (n_measured, ndim)
        The matrix S: change of each frequency or shape component, in standard deviations of its measurement, for a
        change of each parameter by one prior standard deviation. If the errors are correlated, each row is
        conditional on the modes before it.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    labels: tuple[str, ...]
    theta: FloatArray
    prior_sd: FloatArray
    sensitivity: FloatArray

    @property
    def singular_values(self) -> FloatArray:
        """Singular values of S in descending order, (ndim,), 0 where parameters outnumber measured quantities."""
        return self._svd[0]

    @property
    def directions(self) -> FloatArray:
        """Orthonormal directions, one per row, in units of the prior standard deviations, shape (ndim, ndim)."""
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
        """Fisher information JᵀΣ⁻¹J in 1/(SI units of the two parameters), (ndim, ndim); J = ∂f/∂θ, Σ = LLᵀ."""
        information: FloatArray = (self.sensitivity.T @ self.sensitivity) / np.outer(self.prior_sd, self.prior_sd)
        return information

    @property
    def remaining_sd(self) -> FloatArray:
        """Each parameter's linearised posterior standard deviation, divided by its prior one, shape (ndim,)."""
        return np.asarray(np.sqrt(np.sum(self.directions**2 / (1.0 + self.singular_values**2)[:, None], axis=0)))

    @property
    def covariance(self) -> FloatArray:
        """Linearised posterior covariance (I + SᵀS)⁻¹, in units of the prior standard deviations, (ndim, ndim)."""
        V, s = self.directions, self.singular_values
        return np.asarray((V.T / (1.0 + s**2)) @ V)

    def table(self) -> pd.DataFrame:
        """Return a table with one row per direction: ``singular_value``, ``remaining_sd`` and the components."""
        s = self.singular_values
        names = distinct(["singular_value", "remaining_sd", *self.names])
        columns = dict(zip(names, (s, 1.0 / np.sqrt(1.0 + s**2), *self.directions.T), strict=True))
        return data_frame(columns, "direction", range(1, len(s) + 1))

    def sentences(self) -> list[str]:
        """Return sentences on the directions of the linearised model, which ignores the bounds."""
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
    """Find the directions in parameter space that the data constrain, using a linearised model.

    Parameters
    ----------
    problem : UpdatingProblem
        A problem with errors of modes or FRFs. Inferred standard deviations of errors are held fixed. With a
        population, the model is linearised at the population mean, where the test scores are 0. Test scores,
        group effects and unknown covariates are marginalised. The standard deviation, correlations and correlation
        time of a population and the share of outliers are omitted, because they change no mode of a test at the
        population mean. Dates of damage and kinks are omitted too, because they change no mode if the loss or the
        slope is zero.
    theta : array_like, shape (ndim,), optional
        Point of linearisation, SI units, within the bounds. Defaults to the problem's starting point.

    Returns
    -------
    Identifiability

    Raises
    ------
    ValueError
        If `theta` does not have ndim values within the bounds, the model has no finite derivative there, `problem`
        is not an UpdatingProblem, or it has no errors of modes or FRFs, as with the modal residual.
    """
    if not (is_updating(problem) and problem.likelihood.of_modes):
        raise ArgumentError("problem", "must be an UpdatingProblem with errors in the modes")
    point = problem.start if theta is None else np.asarray(theta, dtype=float)
    if point.shape != (problem.ndim,) or not find_inside(point, problem.lower, problem.upper)[1]:
        raise ArgumentError("theta", f"must be {problem.ndim} numbers within the bounds", point.tolist())
    roles = problem.layout.roles
    if problem.is_hierarchical:  # linearise at the population mean, where all scores are zero
        problem = problem.with_layout(problem.layout.remove_centring())
        point = np.where([role.kind == "score" for role in problem.roles], 0.0, point)
    prior_sd = np.array([truncated_sd(parameter) for parameter in problem.parameters[: len(roles)]])
    sensitivity = problem.sensitivity(point[None])[0] * prior_sd
    if not np.all(np.isfinite(sensitivity)):
        raise ArgumentError("theta", "the modes must have finite derivatives", f"none at {point.tolist()}")
    labels = problem.likelihood.labels(tuple(map(str, problem.data.labels)))
    scores = [k for k, role in enumerate(roles) if role.kind in _INTEGRATED]
    kept = [k for k, role in enumerate(roles) if role.kind not in (*_INTEGRATED, *_OMITTED)]
    names, units = (tuple(of[k] for k in kept) for of in (problem.names, problem.units))
    marginal = _integrate_out(sensitivity[:, kept], sensitivity[:, scores])
    return Identifiability(names, units, labels, point[kept], prior_sd[kept], marginal)


def _integrate_out(sensitivity: FloatArray, by_scores: FloatArray) -> FloatArray:
    """Rescale sensitivities so that the test-to-test scatter counts as part of the measurement error.

    The scatter comes from the test scores. `by_scores` contains the derivatives of the measured quantities with
    respect to them.
    """
    if not by_scores.size:
        return sensitivity
    root = np.linalg.cholesky(np.eye(len(by_scores)) + by_scores @ by_scores.T)
    return np.asarray(np.linalg.solve(root, sensitivity))


def with_identifiability(
    trace: xr.DataTree, problem: UpdatingProblem, maxima: Maxima | None = None
) -> xr.DataTree:
    """Return the trace with the identifiability at the starting point and, if known, at the highest maximum.

    A point at which the model has no derivative is skipped: an error here would lose the draws. If no point is
    left, the trace is returned unchanged.
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
        "theta": (("state", "parameter"), np.array([one.theta for one in found])),
        "prior_sd": (("state", "parameter"), np.array([one.prior_sd for one in found])),
        "sensitivity": (("state", "mode", "parameter"), np.array([one.sensitivity for one in found])),
    }
    coordinates = {
        "state": list(linearised),
        "parameter": list(found[0].names),
        "unit": ("parameter", list(found[0].units)),
        "mode": list(found[0].labels),
    }
    return with_group(trace, GROUP, xr.Dataset(variables, coords=coordinates))


def kept_identifiability(trace: xr.DataTree) -> dict[str, Identifiability]:
    """Return the results stored by `with_identifiability`, keyed by point name; empty if nothing is stored."""
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
    node, weight = _legendre_nodes()
    x = 0.5 * (lower + upper) + 0.5 * (upper - lower) * node
    log_pdf = parameter.prior.log_pdf(x)
    weight = weight * np.exp(log_pdf - np.max(log_pdf))
    mean = np.sum(weight * x) / np.sum(weight)
    return float(np.sqrt(np.sum(weight * (x - mean) ** 2) / np.sum(weight)))


@cache
def _legendre_nodes() -> tuple[FloatArray, FloatArray]:
    """Return the Gauss–Legendre nodes on [−1, 1] and their weights, cached because computing them takes 0.1 s."""
    node, weight = np.polynomial.legendre.leggauss(_NODES)
    return node, weight
