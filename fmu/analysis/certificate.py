"""Certificate of a reduced model: bounds on its error at the draws of a run, confirmed by some full solves."""

from __future__ import annotations

import warnings
from collections.abc import Hashable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from fmu.analysis.trace.densities import is_updating
from fmu.analysis.trace.reading import parameter_draws
from fmu.fem.certificates import Certificate, ReductionCertificate, SurrogateCertificate
from fmu.fem.modes.modal import ModalSolution, frequency_hz
from fmu.fem.modes.solver import LARGE
from fmu.fem.modes.terms import coefficients
from fmu.fem.reduced.reduced_structure import ReducedStructure, largest_tolerance_elsewhere, reduced_structures
from fmu.numbers import share, whole
from fmu.posterior.reduction.tolerance import Tolerance
from fmu.progress.phases import by_parts
from fmu.types import FloatArray

if TYPE_CHECKING:
    import xarray as xr

    from fmu.posterior.problem import UpdatingProblem

_AT_ONCE = 16  # draws
_MOST_BY_FULL = 0.03
"""Largest fraction of the draws at which the full model may replace the reduced model without a warning."""


@dataclass(frozen=True)
class Effort:
    """How many draws a certificate uses to bound the error, and how many of them it solves with the full model.

    With several tests, `fewest`, `solved`, `solved_of_large` and `worst` are divided by the number of tests.

    Attributes
    ----------
    work : int
        Largest product of a block's degrees of freedom, the number of tests, and the number of draws at which the
        bound is evaluated. At least `fewest` draws are used, even if the product is then larger.
    fewest, most : int
        Smallest and largest number of draws at which the bound is evaluated.
    each : int
        One in `each` of these draws is solved with the full model.
    solved, solved_of_large : int
        Smallest number of full solves, for small structures and for large structures.
    worst : int
        Number of full solves at the draws with the largest bounds.
    large : int
        A structure is large if one of its blocks has at least this number of degrees of freedom.
    rounding : float
        Fraction of the tolerance by which the error may exceed the bound. If the full model's rounding error is
        larger, the error may exceed the bound by this amount instead, but not by more than the tolerance.
    """

    work: int = 150_000
    fewest: int = 64
    most: int = 512
    each: int = 12
    solved: int = 16
    solved_of_large: int = 8
    worst: int = 4
    large: int = LARGE
    rounding: float = 0.01


USUAL = Effort()


class CertificateWarning(UserWarning):
    """Warns that a reduced model is inaccurate, changes a pairing, or is replaced too often by the full model."""


def certify(
    trace: xr.DataTree, problem: object, full_solves: int = 0, effort: Effort | None = None
) -> Certificate | None:
    """Bound the reduced model's error at retained draws, and solve the full model at some of them.

    Residuals bound the frequency errors (`fmu.fem.reduced.residuals`). The bound is evaluated at up to 512 draws
    for small structures, and at fewer, but at least 64, for larger structures or several tests. The draws are
    chosen at random with the trace's seed. Repeated draws count once; if there are too few distinct draws, all of
    them are used. One in twelve of the chosen draws, but at least 16 of them, is solved with the full model
    (`fmu.fem.reduced.confirming`). The four draws with the largest bounds are always solved. If a block of the
    structure has 20 000 degrees of freedom or more, at least 8 draws are solved instead of 16. With several tests,
    the numbers 64, 16, 8 and 4 are divided by the number of tests. Log-probabilities are compared only at draws
    where they are not far below the highest.

    Parameters
    ----------
    trace : xarray.DataTree
    problem : UpdatingProblem
        The problem that was sampled.
    full_solves : int
        ``problem.model.full_solves`` before the run.
    effort : Effort, optional
        Defaults to `USUAL`.

    Returns
    -------
    Certificate or None
        For a surrogate, the certificate made when the surrogate was built. None if the problem is not an updating
        problem, or its model is neither a surrogate nor reduced in every configuration.

    Warns
    -----
    CertificateWarning
        If an error exceeds its bound or its tolerance; if a pairing changed; or if more than 3 % of the distinct
        draws lie outside the training bounds, where the full model is used. The default tolerances are 1e-6
        (frequency, relative) and 1e-3 (log-probability), or 1e-3 and 1e-2 for a block of 20 000 degrees of freedom
        or more.
    """
    if not is_updating(problem):
        return None
    model = problem.model
    if model.is_uncertain:
        return model.certificate
    parts = reduced_structures(model)
    if len(parts) < len(model.parts):
        return None
    draws = np.unique(parameter_draws(trace).reshape(-1, problem.ndim), axis=0)
    rng = np.random.default_rng(int(trace.attrs["seed"]))
    largest = max(len(block.dofs) for one in parts for block in one.truth.blocks)
    effort = effort or USUAL
    enough = effort.solved_of_large if largest >= effort.large else effort.solved
    fewest, fewest_solved, worst = (-(-n // model.n_tests) for n in (effort.fewest, enough, effort.worst))
    most = int(np.clip(effort.work // (largest * model.n_tests), fewest, effort.most))
    draws = problem.layout.of_model(draws)
    outside = float(np.mean(model.of_modes(draws, _is_outside)))
    theta = draws[rng.permutation(len(draws))[:most]]
    bound = np.concatenate(
        by_parts("certificate", lambda part: model.of_modes(part, _bound), theta, _AT_ONCE, _AT_ONCE)
    )
    n_bounded = len(theta)
    # the draws with the largest bounds are always solved, because the basis may be poor there
    solved = np.argsort(-np.max(bound, axis=1), kind="stable")[:worst]
    others = np.setdiff1d(np.arange(n_bounded), solved)
    solved = np.concatenate([solved, others[: max(n_bounded // effort.each, fewest_solved) - worst]])
    theta = theta[solved]
    exact = np.concatenate(
        by_parts("certificate", lambda part: model.of_modes(part, _by_full), theta, _AT_ONCE, _AT_ONCE)
    )
    found = model.of_modes(theta, _by_reduced)
    exact_hz, reduced_hz = frequency_hz(exact[..., 0]), frequency_hz(found[..., 0])
    tolerance = problem.tolerance or Tolerance()
    errors = np.abs(reduced_hz / exact_hz - 1.0)
    frequency_error = float(np.max(errors))
    log_prob_error = 0.0
    if problem.likelihood.of_modes:
        of_exact, of_reduced = _terms_of_both(problem, theta, exact_hz, reduced_hz)
        total = of_exact.sum(axis=1)
        plausible = total >= total.max() - tolerance.depth
        log_prob_error = float(np.max(np.abs(np.sum(of_reduced - of_exact, axis=1)[plausible])))
    changed = np.any(exact[..., 1:] != found[..., 1:], axis=(1, 2))
    allowed = np.maximum(model.of_modes(theta, _rounding) / exact[..., 0], effort.rounding * tolerance.frequency)
    # if the pairing differs, the bounds belong to other modes
    exceeded = ~changed & np.any(errors > bound[solved] + np.minimum(allowed, tolerance.frequency), axis=1)
    certificate = ReductionCertificate(
        draws=len(theta),
        frequency_error=frequency_error,
        log_prob_error=log_prob_error,
        pairing_changes=int(np.sum(changed)),
        full_solves=int(model.full_solves) - full_solves,
        frequency_tolerance=tolerance.frequency,
        log_prob_tolerance=tolerance.log_prob,
        bound_draws=n_bounded,
        bound=float(np.max(bound)),
        bound_median=float(np.median(np.max(bound, axis=1))),
        bound_exceeded=int(np.sum(exceeded)),
        full_share=outside,
        frequency_elsewhere=largest_tolerance_elsewhere(model),
    )
    if outside > _MOST_BY_FULL:
        warnings.warn(_by_full_too_often(outside), CertificateWarning, stacklevel=2)
    for sentence in certificate.sentences():
        warnings.warn(sentence, CertificateWarning, stacklevel=2)
    return certificate


def _terms_of_both(
    problem: UpdatingProblem, theta: FloatArray, exact_hz: FloatArray, reduced_hz: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the log-likelihood terms of the full and the reduced model, each of shape (n, n_terms).

    `exact_hz` and `reduced_hz` (n, n_modes) are the frequencies of the two models. The n rows of `theta` contain
    the model's parameters followed by the error parameters.
    """
    likelihood = problem.likelihood
    of_reduced = likelihood.terms_of_frequencies(reduced_hz, theta)
    if likelihood.by_frequencies:
        return likelihood.terms_of_frequencies(exact_hz, theta), of_reduced
    by_full = problem.with_model(problem.model.truth).likelihood
    return np.concatenate(by_parts("certificate", by_full.terms, theta, _AT_ONCE, _AT_ONCE)), of_reduced


def certificate_failures(attrs: Mapping[Hashable, str | float]) -> list[str]:
    """Return the reasons why draws made with a surrogate are unreliable.

    The list is empty if there was no surrogate, if delayed acceptance made the draws exact, or if the surrogate's
    certificate is valid.
    """
    found = SurrogateCertificate.from_trace(attrs)
    return [] if found is None or "second_stage_proposals" in attrs else found.reason_against()


def exact_in_words(attrs: Mapping[Hashable, str | float]) -> list[str]:
    """Return sentences on the second stage of delayed acceptance, or an empty list if the run had none."""
    if "second_stage_proposals" not in attrs:
        return []
    proposals, accepted, failed = (
        int(attrs[f"second_stage_{name}"]) for name in ("proposals", "accepted", "failed")
    )
    said = [
        f"The draws are exact: {whole(accepted)} of {whole(proposals)} draws of the surrogate were accepted after "
        "a solve of the model itself (delayed acceptance). They have a Monte-Carlo error only."
    ]
    if failed:
        said.append(f"At {whole(failed)} of these draws the solve failed; they were rejected.")
    if attrs["surrogate_failed_where"]:
        said.append("Where the surrogate expects solves to fail it proposes no draws.")
    return said


def _bound(structure: ReducedStructure, points: FloatArray) -> FloatArray:
    """Return a bound on each relative frequency error, shape (n, n_modes).

    The bound is 0 where the full model is used.
    """
    bound = structure.frequency_bound(points)
    bound[~structure.within(points)] = 0.0
    return np.asarray(bound)


def _is_outside(structure: ReducedStructure, points: FloatArray) -> FloatArray:
    """Return 1 where a point lies outside the training bounds, otherwise 0, repeated for each mode: (n, n_modes).

    Outside these bounds, the full model replaces the reduced one.
    """
    outside = ~structure.within(points[:, : structure.n_parameters])
    return np.repeat(outside[:, None].astype(float), structure.n_modes, axis=1)


def _by_full_too_often(outside: float) -> str:
    return (
        f"the full model answered at {share(outside)} of the draws, which lie outside the reduced model's box "
        f"(at most {share(_MOST_BY_FULL)} should); data and priors disagree: give the parameters wider priors, or "
        "reduction = false"
    )


def _by_full(structure: ReducedStructure, points: FloatArray) -> FloatArray:
    return _stack_modes(structure.confirmed_modes(points))


def _rounding(structure: ReducedStructure, points: FloatArray) -> FloatArray:
    """Return the rounding error of the full model's eigenvalues, 2e-16 λ_max, once for each mode: (n, n_modes).

    The largest ratio of diagonal entries, K_ii / M_ii, estimates λ_max from below.
    """
    full = structure.truth.structure
    stiffness, mass = (
        coefficients(terms, points) @ np.array([term.matrix.diagonal() for term in terms])
        for terms in (full.K_terms, full.M_terms)
    )
    highest = np.max(stiffness / np.where(mass > 0.0, mass, np.inf), axis=1)
    return np.repeat(np.finfo(float).eps * highest[:, None], structure.n_modes, axis=1)


def _by_reduced(structure: ReducedStructure, points: FloatArray) -> FloatArray:
    return _stack_modes(structure.modes(points))


def _stack_modes(modes: ModalSolution) -> FloatArray:
    """Return each mode's eigenvalue, block and rank, shape (n, n_modes, 3)."""
    return np.stack([modes.eigenvalues, modes.block, modes.rank], axis=2)
