"""Find the parameters, and combinations of parameters, that the data inform, judged by the draws of a run."""

from __future__ import annotations

import html
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from fmu.analysis.identifiability import Identifiability, combination, kept_identifiability
from fmu.analysis.prediction import at_bounds
from fmu.analysis.trace.modal_states import MAXIMUM, START
from fmu.analysis.trace.reading import (
    check_trace,
    columns_of,
    has,
    parameter_draws,
    parameter_names,
    problem_of,
    without_scores,
)
from fmu.analysis.uninformed import (
    LINEARISED_LEFT,
    Uninformed,
    eliminate,
    hardest_pair,
    left_to_prior,
    name_direction,
)
from fmu.arguments import check_arguments
from fmu.numbers import fixed, given, names_in_words, share, significant
from fmu.tables import data_frame, text_table, wrap_text
from fmu.types import BoolArray, FloatArray

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr


DATA, PRIOR, COMBINED = "data", "prior", "combination"
"""Sources of the information on a parameter: the data, the prior alone, or the data in a combination only."""
CONTRACTED = 0.3
"""Contraction below which the data do not inform a parameter or direction."""
CRITERION = (
    "Contraction: 1 − posterior variance / prior variance, from the draws; 1 where the data determine a "
    "parameter, 0 where they do not narrow it. Below 0.3, where 84 % or more of the prior standard deviation "
    "remains, the data have not informed it, and what is shown for it is its prior."
)
_LEAST_BY_ENTROPY = 0.7
_ALONE, _AGREE = 0.9, 0.1


@dataclass(frozen=True, eq=False)
class Information:
    """Parameters and directions that the data determine, judged by the draws of a run.

    Attributes
    ----------
    names : tuple of str
    contraction : ndarray, shape (ndim,)
        1 − the ratio of posterior to prior variance (Betancourt 2018, "Towards a principled Bayesian workflow").
        Where `of_logarithm` is True, both are variances of the logarithm.
    of_logarithm : tuple of bool
        Whether the prior of each parameter is log-normal.
    informed : ndarray of bool, shape (ndim,)
        Whether the contraction is at least `CONTRACTED`, or the draws lie in separate narrow peaks.
    basis : tuple of str
        Source of the information on each parameter: ``"data"``, ``"prior"`` or ``"combination"``.
    directions : ndarray, shape (ndim, ndim)
        Principal directions of the draws in prior standard deviations, one per row, the least informed first.
    remaining_sd : ndarray, shape (ndim,)
        Ratio of posterior to prior standard deviation along each direction.
    is_left : ndarray of bool, shape (ndim,)
        Whether each direction is determined by the prior alone.
    uninformed : tuple of (Uninformed, float)
        Combinations of few parameters that span the uninformed directions, each with its ratio of posterior to
        prior standard deviation.
    """

    names: tuple[str, ...]
    contraction: FloatArray
    of_logarithm: tuple[bool, ...]
    informed: BoolArray
    basis: tuple[str, ...]
    directions: FloatArray
    remaining_sd: FloatArray
    is_left: BoolArray
    uninformed: tuple[tuple[Uninformed, float], ...]

    @property
    def not_informed(self) -> tuple[str, ...]:
        """Names of the parameters that the data did not inform."""
        return tuple(name for name, is_told in zip(self.names, self.informed, strict=True) if not is_told)

    @property
    def n_informed(self) -> int:
        """Number of directions that the data inform."""
        return int(np.sum(~self.is_left))

    def warnings(self) -> list[str]:
        """Return one sentence for each direction that the data did not inform."""
        said = []
        for one, remains in self.uninformed:
            left = f"{share(min(remains, 1.0))} of the prior standard deviation remains"
            if len(one.names) == 1:
                said.append(f"{one.words} was not updated by the data: {left}")
            elif one.told:
                said.append(
                    f"{names_in_words(one.names)} were not updated individually: the data determine only "
                    f"{one.told}, and {left} along their joint change"
                )
            else:
                said.append(
                    f"the combination {one.words} (in prior standard deviations) was not updated by the data: "
                    f"{left} along it"
                )
        return said

    def sentences(self) -> list[str]:
        """Return sentences on the number of informed directions and on each uninformed direction.

        If the data inform all directions, the least informed one is named.
        """
        n, k = len(self.names), self.n_informed
        said = [
            f"By the draws the data inform {k} of {n} directions of the parameter space, with a contraction of "
            f"{given(CONTRACTED)} or more."
        ]
        if k == n:
            left = f"{share(float(self.remaining_sd[0]))} of the prior standard deviation remains"
            said.append(f"The least informed is {combination(self.directions[0], self.names)}: {left} along it.")
        return said + [f"{one.replace('the combination', 'The combination', 1)}." for one in self.warnings()]

    def table(self) -> pd.DataFrame:
        """Return a table with one row per parameter.

        The columns are ``contraction``, ``of_logarithm``, ``informed`` and ``determined_by``.
        """
        columns = {
            "contraction": self.contraction,
            "of_logarithm": self.of_logarithm,
            "informed": self.informed,
            "determined_by": self.basis,
        }
        return data_frame(columns, "parameter", self.names)

    def __str__(self) -> str:
        each = zip(self.names, self.contraction, self.basis, strict=True)
        rows = [[name, fixed(float(contraction), 2), by] for name, contraction, by in each]
        text = text_table(["", "contraction", "determined by"], rows, words=(0, 2))
        return "\n".join([*map(wrap_text, [*self.sentences(), CRITERION]), "", text])

    def _repr_html_(self) -> str:
        said = "".join(f"<p>{html.escape(sentence)}</p>" for sentence in [*self.sentences(), CRITERION])
        return said + str(self.table().to_html(float_format=significant))


@check_arguments
def information(trace: xr.DataTree) -> Information | None:
    """Find the parameters and directions that the data determine, from the contraction of the draws.

    Contraction is 1 minus the ratio of posterior to prior variance. Parameters, and the principal directions of
    the draws, are not informed by the data if their contraction is below 0.3 (`CONTRACTED`). Draws in separate
    narrow peaks have a large variance but are informed. A parameter or direction therefore counts as uninformed
    only if the entropy of its draws is also as large as for a wide distribution.

    A parameter counts as determined only in a combination if it is not informed, or if the uninformed directions
    leave it at least 0.3 of its prior variance. The exception is a parameter that is itself nearly an uninformed
    direction: the data or the prior alone determine it.

    Parameters
    ----------
    trace : xarray.DataTree
        A trace with draws from the prior, as returned by `fmu.sample`.

    Returns
    -------
    Information or None
        None if the trace has no draws from the prior, or all posterior draws are the same.

    Raises
    ------
    ValueError
        If `trace` is not an xarray.DataTree.
    """
    check_trace(trace)
    if not has(trace, "prior"):
        return None
    names = parameter_names(trace)
    x, prior, of_logarithm = standardise_draws(trace)
    if len(x) < 2 or not np.any(np.ptp(x, axis=0) > 0):
        return None
    n = len(names)
    C = np.atleast_2d(np.cov(x.T))
    values, vectors = np.linalg.eigh(C)
    values, directions = np.maximum(values[::-1], 0.0), vectors.T[::-1]

    is_left = np.array([not _is_informed(x, prior, direction) for direction in directions])
    told, U = _determined_instead(trace), directions[is_left]
    found: list[tuple[Uninformed, float]] = []
    for row in eliminate(U):
        unit = row / np.linalg.norm(row)
        one = name_direction(unit, names, np.full(n, np.nan))
        found.append((one._replace(told=told.get(frozenset(one.names), "")), float(np.sqrt(unit @ C @ unit))))
    from_prior = np.einsum("ui,uv,vi->i", U, U @ C @ U.T, U)
    informed = np.array([_is_informed(x, prior, direction) for direction in np.eye(n)])
    alone = np.sum(U**2, axis=0) >= _ALONE
    combined = ~alone & (~informed | (from_prior >= CONTRACTED))
    basis = np.where(combined, COMBINED, np.where(informed, DATA, PRIOR))
    return Information(
        names,
        1.0 - np.diag(C),
        of_logarithm,
        informed,
        tuple(map(str, basis)),
        directions * np.sign(directions[np.arange(n), np.argmax(np.abs(directions), axis=1)])[:, None],
        np.sqrt(values),
        is_left,
        tuple(found),
    )


def _is_informed(x: FloatArray, prior: FloatArray, direction: FloatArray) -> bool:
    """Return True if the data informed a direction. `x` and `prior` (n, ndim) are in prior standard deviations."""
    along = x @ direction
    return float(np.var(along, ddof=1)) <= 1.0 - CONTRACTED or (
        _entropy_sd(along, prior @ direction) < _LEAST_BY_ENTROPY
    )


def separation_in_words(trace: xr.DataTree, linearised: Identifiability) -> str:
    """Return a sentence on the two parameters that the data separate least, or "" if they confuse no parameters.

    The sentence is based on the draws and on the criterion of `information`. If `information` returns None, for
    example because the trace has no draws from the prior, the sentence is based on the linearised model.
    """
    if information(trace) is None:
        pair = hardest_pair(linearised, linearised.covariance)
        return "" if pair is None else pair.sentence(pair.remaining_sd < LINEARISED_LEFT)
    columns = columns_of(trace, linearised.names)
    x, prior = (draws[:, columns] for draws in standardise_draws(trace)[:2])
    pair = hardest_pair(linearised, np.atleast_2d(np.cov(x.T)))
    return "" if pair is None else pair.sentence(_is_informed(x, prior, pair.direction))


def _determined_instead(trace: xr.DataTree) -> dict[frozenset[str], str]:
    """Return the combination that the data determine for each set of parameters that they cannot separate.

    The sets are the dict's keys and follow from the linearised model stored in the trace. A combination without a
    simple form is an empty string. The dict is empty if the trace stores no linearised model.
    """
    kept = kept_identifiability(trace)
    if not kept:
        return {}
    return {frozenset(one.names): one.told for one in left_to_prior(kept[MAXIMUM if MAXIMUM in kept else START])}


def left_along(trace: xr.DataTree, linearised: Identifiability) -> FloatArray:
    """Return the ratio of posterior to prior standard deviation along each linearised direction, shape (n,).

    The ratio comes from the draws. It corresponds to ``remaining_sd`` in the linearised model's table, but without
    linearisation.
    """
    x = parameter_draws(trace).reshape(-1, len(parameter_names(trace)))[:, columns_of(trace, linearised.names)]
    prior = np.stack([trace["prior"].variables[name].to_numpy().ravel() for name in linearised.names], axis=1)
    scaled = (linearised.directions / linearised.prior_sd).T
    return np.asarray((x @ scaled).std(axis=0) / (prior @ scaled).std(axis=0))


def compared_with_draws(
    trace: xr.DataTree, linearised: Identifiability, place: str, n_maxima: int, converged: bool
) -> list[str]:
    """Return sentences on how a linearised model differs from the draws, why, and which of them is reliable.

    Parameters
    ----------
    trace : xarray.DataTree
        A trace with draws from the prior.
    linearised : Identifiability
    place : str
        The point of linearisation in words: ``"the start"``.
    n_maxima : int
        Number of maxima with a significant probability.
    converged : bool
        Whether the draws are reliable.
    """
    s, drawn = linearised.singular_values, left_along(trace, linearised)
    left = 1.0 / np.hypot(1.0, s)
    k = int(np.argmax(np.abs(drawn - left)))
    apart = float(abs(drawn[k] - left[k]))
    if apart < _AGREE:
        return [
            f"The model linearised at {place} agrees with the draws: along each of its directions the two differ "
            f"by at most {share(apart)} of the prior standard deviation."
        ]
    words = combination(linearised.directions[k], linearised.names)
    said = [
        f"The model linearised at {place} differs from the draws: along {words} it would leave "
        f"{share(left[k])} of the prior standard deviation, and the draws have {share(float(drawn[k]))}."
    ]
    if not converged:
        return [*said, "Neither is to be relied on before the draws have converged."]
    involved = name_direction(linearised.directions[k], linearised.names, np.full(len(s), np.nan)).names
    why = [
        f"{share(one.near)} of the draws of {one.name} lie at its {one.side} bound"
        for one in at_bounds(trace)
        if one.name in involved
    ]
    if n_maxima > 1:
        why.append(f"the posterior has {n_maxima} maxima, of which a linearised model sees one")
    if not why:
        why.append(
            "frequencies are not linear in the parameters, or priors not normal, over the width of the posterior"
        )
    return [*said, f"Believe the draws, which count bounds, curvature and all maxima: {' and '.join(why)}."]


def why_unknown(trace: xr.DataTree) -> str:
    """Return in words why `information` gives None for a trace."""
    return "all posterior draws are the same" if has(trace, "prior") else "there are no draws from the prior"


def not_informed(trace: xr.DataTree) -> tuple[str, ...]:
    """Return the names of the parameters that the data did not inform; empty if `information` gives None."""
    found = information(trace)
    return () if found is None else found.not_informed


def information_warnings(trace: xr.DataTree) -> list[str]:
    """Return a trace's `Information.warnings`, or an empty list if `information` gives None.

    Test scores of populations are left out if there are many parameters, as in tables and figures.
    """
    found = information(without_scores(trace))
    return [] if found is None else found.warnings()


def standardise_draws(trace: xr.DataTree) -> tuple[FloatArray, FloatArray, tuple[bool, ...]]:
    """Return posterior draws, prior draws, and whether each parameter was replaced by its logarithm.

    The draws, (n, ndim), are distances from the prior mean in prior standard deviations. The logarithm is used for
    a log-normal prior. Normal scores are not used, because they stretch the range next to a bound where the prior
    density is positive: if the prior is uniform, draws spread evenly over the 1 % of the range at the bound would
    have 31 % of the prior's standard deviation.
    """
    names = parameter_names(trace)
    x = parameter_draws(trace).reshape(-1, len(names))
    prior = np.stack([trace["prior"].variables[name].to_numpy().ravel() for name in names], axis=1)
    kinds = {p["name"]: p["prior"].get("distribution") for p in problem_of(trace).get("parameters", ())}
    logs = np.array([kinds.get(name) == "log-normal" for name in names])
    x[:, logs], prior[:, logs] = np.log(x[:, logs]), np.log(prior[:, logs])
    mean, sd = prior.mean(axis=0), prior.std(axis=0, ddof=1)
    return (x - mean) / sd, (prior - mean) / sd, tuple(map(bool, logs))


def _entropy_sd(x: FloatArray, prior: FloatArray) -> float:
    """Return exp(entropy of `x`) divided by exp(entropy of the prior draws), with entropies from histograms.

    For two distributions of the same shape this is the ratio of their standard deviations.
    """
    return float(np.exp(_entropy(x) - _entropy(prior)))


def _entropy(x: FloatArray) -> float:
    """Return the entropy of `x` in nats, from a histogram with bins of width 0.2."""
    width = 0.2
    counts = np.bincount(np.floor((x - x.min()) / width).astype(int))
    part = counts[counts > 0] / len(x)
    return float(np.log(width) - np.sum(part * np.log(part)))
