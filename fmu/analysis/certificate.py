"""The certificate of a run: bounds of the reduced model's error at the draws, confirmed by full solves of some."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from fmu.analysis.trace.reading import parameter_draws
from fmu.fem.modes.modal import frequency_hz
from fmu.fem.pairing.paired_model import elsewhere
from fmu.fem.reduced.confirming import LARGE
from fmu.numbers import apart, share, significant, typed, whole
from fmu.posterior.train_reduced import PLAUSIBLE, Tolerance
from fmu.progress.phases import by_parts
from fmu.types import FloatArray

if TYPE_CHECKING:
    import xarray as xr


_AT_ONCE = 16  # draws
_SCATTER = 1e-5
"""Relative scatter of a solver\'s frequencies from which on it is told."""
_MOST_BY_FULL = 0.03
"""Share of the draws at which the full model may answer in place of the reduced one without a word."""


@dataclass(frozen=True)
class Effort:
    """How many draws a certificate is of.

    Attributes
    ----------
    work : int
        Degrees of freedom times draws at which the bound is evaluated.
    fewest, most : int
        At least and at most so many draws.
    each : int
        One of so many of these draws is solved with the full model.
    solved, solved_of_large : int
        At least so many are solved; of structures with `large` degrees of freedom or more, so many.
    worst : int
        So many of them are those with the largest bounds.
    large : int
    rounding : float
        Part of the tolerance by which the full model's own rounding may exceed the bound.
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
    """The reduced model misses its tolerance at retained draws, or the bound of its error."""


def certify(
    trace: xr.DataTree, problem: Any, full_solves: int = 0, effort: Effort | None = None
) -> dict[str, Any]:
    """Bound the error of the reduced model at retained draws, and solve some of them with the full model.

    Parameters
    ----------
    trace : xarray.DataTree
    problem : UpdatingProblem
        The problem that was sampled. Without a reduced model or a surrogate the certificate is empty.
    full_solves : int
        ``problem.model.full_solves`` before the run.
    effort : Effort, optional
        `USUAL` by default.

    Returns
    -------
    dict of str to float, int or str
        ``certificate_bound_draws``, the draws at which the errors of the frequencies were bounded by their
        residuals (`fmu.fem.reduced.residuals`): up to 1024 of small structures, and fewer of larger ones or of
        several tests, chosen at random by the seed of the trace; ``certificate_bound``, the largest bound of the
        relative error of a frequency, and ``certificate_bound_median``, the median over draws of the largest of
        each. It is 0 where the full model answers, outside the trained box.

        ``certificate_draws``, those of them that were solved with the full model, the four with the largest bounds
        among them: one in twelve, and at least 16, or 8 where the structure has 20 000 degrees of freedom or more
        (`fmu.fem.reduced.confirming`);
        ``certificate_frequency_error``, the largest relative error of a frequency there;
        ``certificate_bound_exceeded``, draws at which an error is larger than its bound;
        ``certificate_log_prob_error``, the largest error of the log-probability among those of these draws whose
        likelihood is within e⁵⁰ of the highest: lower down, where a chain may have started, it is not bounded;
        ``certificate_pairing_changes``, draws at which the full model pairs a measured mode with another computed
        mode; ``certificate_full_solves``, how often the full model was solved during the run because a theta lay
        outside the trained box or the reduced solve failed; ``certificate_full_share``, the share of the draws at
        which it lies outside; ``certificate_frequency_tolerance`` and ``certificate_log_prob_tolerance``
        (`fmu.posterior.train_reduced.Tolerance`); ``certificate_frequency_elsewhere``, the tolerance of the
        frequencies where the posterior has no mass, only where it is another one.

        Of a surrogate it is ``problem.model.record``, from draws of its posterior that were solved when it was
        learnt (`fmu.surrogate`): ``surrogate_solves``, all solves of the model; ``surrogate_design``, those from
        which the surrogate was learnt; ``surrogate_failed``, those that failed, and ``surrogate_failed_where`` in
        words; ``surrogate_doubts``, a line for each mode that may have been taken for another;
        ``surrogate_scatter``, the estimated scatter of the solver's frequencies, relative;
        ``certificate_draws`` and ``certificate_frequency_error`` as above; ``certificate_log_prob_sd``, the
        standard deviation of the error of the log-probability; ``certificate_log_prob_error``, the largest from
        its mean, which with 95 % confidence holds for ``certificate_share`` of the posterior;
        ``certificate_shift``, how many posterior standard deviations a posterior mean, and how much, relative, a
        posterior standard deviation may be off with 95 % confidence, and ``certificate_shift_tolerance``.

    Warns
    -----
    CertificateWarning
        If an error is above its tolerance, 1e-6 (frequency, relative) and 1e-3 (log-probability) unless the
        problem was given another one, or above its bound, or if a pairing changed; or if the full model answered
        at more than 3 % of the draws.
    """
    model: Any = getattr(problem, "model", None)
    if model is not None and model.is_uncertain:
        return dict(model.record)
    structures = () if model is None else model.structures()
    if not structures or any(structure.reduced is None for structure in structures):
        return {}
    draws = np.unique(parameter_draws(trace).reshape(-1, problem.ndim), axis=0)
    rng = np.random.default_rng(int(trace.attrs["seed"]))
    largest = max(len(block.dofs) for structure in structures for block in structure.full.blocks)
    effort = effort or USUAL
    enough = effort.solved_of_large if largest >= effort.large else effort.solved
    fewest, fewest_solved, worst = (-(-n // model.n_tests) for n in (effort.fewest, enough, effort.worst))
    most = int(np.clip(effort.work // (largest * model.n_tests), fewest, effort.most))
    outside = float(np.mean(model.of_modes(draws, _is_outside)))
    theta = draws[rng.permutation(len(draws))[:most]]
    bound = np.concatenate(
        by_parts("certificate", lambda part: model.of_modes(part, _bound), theta, _AT_ONCE, _AT_ONCE)
    )
    n_bounded = len(theta)
    # where a basis is poor is not left to chance
    solved = np.argsort(-np.max(bound, axis=1), kind="stable")[:worst]
    others = np.setdiff1d(np.arange(n_bounded), solved)
    solved = np.concatenate([solved, others[: max(n_bounded // effort.each, fewest_solved) - worst]])
    theta = theta[solved]
    exact = np.concatenate(by_parts("certificate", lambda part: model.of_modes(part, _by_full), theta, _AT_ONCE))
    reduced = model.of_modes(theta, _by_reduced)
    exact_hz, reduced_hz = frequency_hz(exact[..., 0]), frequency_hz(reduced[..., 0])
    tolerance = getattr(problem, "tolerance", None) or Tolerance()
    errors = np.abs(reduced_hz / exact_hz - 1.0)
    frequency_error = float(np.max(errors))
    log_prob_error = 0.0
    likelihood = problem.likelihood
    if likelihood.of_modes:
        if likelihood.error is not None:  # no need to solve again
            both = (likelihood.error.log_prob_terms(hz) for hz in (exact_hz, reduced_hz))
            of_exact, of_reduced = map(likelihood.of_used, both)
        else:
            of_exact = np.concatenate(by_parts("certificate", likelihood.full_terms, theta, _AT_ONCE))
            of_reduced = likelihood.terms(theta)
        total = of_exact.sum(axis=1)
        plausible = total >= total.max() - PLAUSIBLE
        log_prob_error = float(np.max(np.abs(np.sum(of_reduced - of_exact, axis=1)[plausible])))
    changed = np.any(exact[..., 1:] != reduced[..., 1:], axis=(1, 2))
    # with another pairing these are not the modes that were bounded
    exceeded = ~changed & np.any(errors > bound[solved] + effort.rounding * tolerance.frequency, axis=1)
    certificate = {
        "certificate_bound_draws": n_bounded,
        "certificate_bound": float(np.max(bound)),
        "certificate_bound_median": float(np.median(np.max(bound, axis=1))),
        "certificate_bound_exceeded": int(np.sum(exceeded)),
        "certificate_draws": len(theta),
        "certificate_frequency_error": frequency_error,
        "certificate_log_prob_error": log_prob_error,
        "certificate_pairing_changes": int(np.sum(changed)),
        "certificate_full_solves": int(model.full_solves) - full_solves,
        "certificate_full_share": outside,
        "certificate_frequency_tolerance": tolerance.frequency,
        "certificate_log_prob_tolerance": tolerance.log_prob,
    }
    away = elsewhere(structures)
    if away is not None:
        certificate["certificate_frequency_elsewhere"] = away
    is_within = frequency_error <= tolerance.frequency and log_prob_error <= tolerance.log_prob
    if outside > _MOST_BY_FULL:
        warnings.warn(_by_full_too_often(outside), CertificateWarning, stacklevel=2)
    if not is_within or changed.any() or exceeded.any():
        warnings.warn(_excess_in_words(certificate), CertificateWarning, stacklevel=2)
    return certificate


def surrogate_in_words(record: Mapping[Any, Any]) -> list[str]:
    """Return the certificate of a surrogate in sentences; see `certify`."""
    n, shift, allowed = (record[f"certificate_{name}"] for name in ("draws", "shift", "shift_tolerance"))
    is_kept = float(shift) <= float(allowed)
    # to one decimal place where they are near to each other
    near = float(shift) <= 10.0 * float(allowed)
    found, limit = (
        apart(float(shift), float(allowed), digits=2)
        if near
        else (significant(float(shift), 2), typed(float(allowed)))
    )
    said = [
        f"Gaussian processes stand for the model: they were learnt from {whole(record['surrogate_design'])} "
        f"solves, and {n} draws of the posterior, unseen by them, were solved to check them: "
        f"{whole(record['surrogate_solves'])} solves in all."
    ]
    if np.isfinite(float(shift)):
        said += [
            f"With 95 % confidence no posterior mean is off by more than {found} posterior standard deviations, "
            f"and no standard deviation by more than {found} of its size "
            f"({'allowed' if is_kept else 'more than the allowed'}: {limit}), to first order.",
            f"In the log-probability the largest error at these draws is "
            f"{significant(float(record['certificate_log_prob_error']), 2)}, and with 95 % confidence "
            f"{share(float(record['certificate_share']))} of the posterior has no larger one.",
        ]
    else:
        said.append("The model could not be solved at some of these draws, so that nothing is certified.")
    if record["surrogate_failed_where"]:
        said.append(
            f"The model could not be solved everywhere: {record['surrogate_failed_where']}. The edge of that "
            "region is known only as closely as solves lie to it, which the certificate does not contain: where "
            "the posterior reaches it, its means may be off by more."
        )
    if float(record["surrogate_scatter"]) > _SCATTER:
        scatter = significant(float(record["surrogate_scatter"]), 2)
        said.append(
            f"The solver's frequencies seem to scatter by {scatter} of their size; the certificate has that of "
            "the solves that check."
        )
    said += str(record["surrogate_doubts"]).splitlines()
    return said


def certificate_failures(attrs: Mapping[Any, Any]) -> list[str]:
    """Return why draws of a surrogate do not count: its certificate is not kept. Exact draws need none."""
    if "certificate_shift" not in attrs or "second_stage_proposals" in attrs:
        return []
    shift, allowed = (float(attrs[f"certificate_{name}"]) for name in ("shift", "shift_tolerance"))
    if shift <= allowed:
        return []
    off = f"by {significant(shift, 2)} posterior standard deviations" if np.isfinite(shift) else "by any amount"
    return [
        f"the surrogate misses its tolerance: by its certificate posterior means may be off {off} (allowed: "
        f"{typed(allowed)}), whatever its draws say"
    ]


def exact_in_words(attrs: Mapping[Any, Any]) -> list[str]:
    """Return sentences on the second stage of delayed acceptance; none if the run has none."""
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


def _bound(structure: Any, points: FloatArray) -> FloatArray:
    """Return the bounds of the errors, (n, n_modes): none where the full model answers."""
    bound = structure.frequency_bound(points)
    bound[~structure.within(points)] = 0.0
    return np.asarray(bound)


def _is_outside(structure: Any, points: FloatArray) -> FloatArray:
    """Return 1 where the full model answers because a point lies outside the trained box, (n, n_modes)."""
    outside = ~structure.within(points[:, : structure.n_parameters])
    return np.repeat(outside[:, None].astype(float), structure.n_modes, axis=1)


def _by_full_too_often(outside: float) -> str:
    return (
        f"the full model answered at {share(outside)} of the draws, which lie outside the reduced model's box "
        f"(at most {share(_MOST_BY_FULL)} should); data and priors disagree: give the parameters wider priors, or "
        "reduction = false"
    )


def _by_full(structure: Any, points: FloatArray) -> FloatArray:
    return _stack_modes(structure.confirmed_modes(points))


def _by_reduced(structure: Any, points: FloatArray) -> FloatArray:
    return _stack_modes(structure.modes(points))


def _stack_modes(modes: Any) -> FloatArray:
    """Return eigenvalue, block and rank of each mode, (n, n_modes, 3)."""
    return np.stack([modes.eigenvalues, modes.block, modes.rank], axis=2)


def _excess_in_words(certificate: dict[str, Any]) -> str:
    """Return the errors of the reduced model beyond their tolerances, in words."""
    off = []
    for words, name in (("frequency error", "frequency"), ("log-probability error", "log_prob")):
        found, tolerance = (float(certificate[f"certificate_{name}_{what}"]) for what in ("error", "tolerance"))
        off.append(f"{words} up to {apart(found, tolerance, digits=2)[0]} (tolerance: {typed(tolerance)})")
    return (
        f"the reduced model is outside its tolerance; {certificate['certificate_draws']} draws were solved "
        f"again with the full model: {', '.join(off)}, different pairing at "
        f"{certificate['certificate_pairing_changes']} draws, error above its bound at "
        f"{certificate['certificate_bound_exceeded']} draws"
    )
