"""Certificates: records of the known errors of a cheap model that replaces a slow one."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Hashable, Mapping
from dataclasses import MISSING, asdict, dataclass, fields
from typing import Any, ClassVar, Self

import numpy as np

from fmu.numbers import apart, share, significant, typed, whole

_SCATTER = 1e-5
"""Relative scatter of a solver's frequencies from which on it is told."""


@dataclass(frozen=True)
class Certificate(ABC):
    """Errors of a cheap model at draws of the posterior, and what is allowed.

    Attributes
    ----------
    draws : int
        Draws that were solved with the true model.
    frequency_error : float
        The largest relative error of a frequency there.
    """

    draws: int
    frequency_error: float

    _others: ClassVar[Mapping[str, str]] = {}
    """The keys in a trace that are not ``certificate_`` and the name of the field."""

    @classmethod
    def from_trace(cls, attrs: Mapping[Hashable, Any]) -> Self | None:
        """Return the certificate in the attributes of a trace, None if there is none of this kind."""
        found: dict[str, Any] = {}
        for field in fields(cls):
            key = cls._key(field.name)
            if key in attrs:
                found[field.name] = np.asarray(attrs[key]).item()
            elif field.default is MISSING:
                return None
        return cls(**found)

    def attributes(self) -> dict[str, object]:
        """Return the attributes of a trace that contain the certificate."""
        return {self._key(name): value for name, value in asdict(self).items() if value is not None}

    @classmethod
    def _key(cls, name: str) -> str:
        return cls._others.get(name, f"certificate_{name}")

    @property
    @abstractmethod
    def ok(self) -> bool:
        """Whether the errors are as small as allowed."""

    @abstractmethod
    def sentences(self) -> list[str]:
        """Describe the errors, and the largest that are allowed."""


@dataclass(frozen=True)
class ReductionCertificate(Certificate):
    """Errors of a reduced basis at the draws of a run: bounds of them, and those at some draws.

    Attributes
    ----------
    log_prob_error : float
        The largest error of the log-probability among those of the solved draws whose likelihood is within e⁵⁰ of
        the highest: lower down, where a chain may have started, it is not bounded.
    pairing_changes : int
        Draws at which the true model pairs a measured mode with another computed mode.
    full_solves : int
        How often the true model was solved during the run, because a theta lay outside the trained box or the
        reduced solve failed.
    frequency_tolerance, log_prob_tolerance : float
        See `fmu.posterior.reduction.tolerance.Tolerance`.
    bound_draws : int
        Draws at which the errors of the frequencies were bounded by their residuals.
    bound, bound_median : float
        The largest bound of the relative error of a frequency, and the median over draws of the largest of each.
    bound_exceeded : int
        Solved draws at which an error is larger than its bound.
    full_share : float or None
        The share of the draws at which the true model answers, as they lie outside the box.
    frequency_elsewhere : float or None
        The tolerance of the frequencies where the posterior has no mass, if it is another one.
    """

    log_prob_error: float
    pairing_changes: int
    full_solves: int
    frequency_tolerance: float = 1e-6
    log_prob_tolerance: float = 1e-3
    bound_draws: int | None = None
    bound: float | None = None
    bound_median: float | None = None
    bound_exceeded: int | None = None
    full_share: float | None = None
    frequency_elsewhere: float | None = None

    @property
    def ok(self) -> bool:
        """Whether errors are within their tolerances and their bounds, and no pairing changed."""
        is_small = (
            self.frequency_error <= self.frequency_tolerance and self.log_prob_error <= self.log_prob_tolerance
        )
        return is_small and not self.pairing_changes and not self.bound_exceeded

    def sentences(self) -> list[str]:
        """Say by how much the reduced model misses its tolerance; nothing if it does not."""
        if self.ok:
            return []
        pairs = (
            ("frequency error", self.frequency_error, self.frequency_tolerance),
            ("log-probability error", self.log_prob_error, self.log_prob_tolerance),
        )
        off = [
            f"{words} up to {apart(found, allowed, digits=2)[0]} (tolerance: {typed(allowed)})"
            for words, found, allowed in pairs
        ]
        return [
            f"the reduced model is outside its tolerance; {self.draws} draws were solved again with the full "
            f"model: {', '.join(off)}, different pairing at {self.pairing_changes} draws, error above its "
            f"bound at {self.bound_exceeded} draws"
        ]


@dataclass(frozen=True)
class SurrogateCertificate(Certificate):
    """Errors of a surrogate at draws of its posterior that were solved when it was learnt (`fmu.surrogate`).

    Attributes
    ----------
    solves, design : int
        All solves of the model, and those from which the surrogate was learnt.
    failed : int
        Solves that failed.
    failed_where : str
        Where they did, in words.
    doubts : str
        A line for each mode that may have been taken for another.
    scatter : float
        The estimated scatter of the solver's frequencies, relative.
    log_prob_error : float
        The largest error of the log-probability from its mean, which with 95 % confidence holds for `share` of the
        posterior.
    share : float
    log_prob_sd : float
        The standard deviation of the error of the log-probability.
    shift, shift_tolerance : float
        How many posterior standard deviations a posterior mean, and how much, relative, a posterior standard
        deviation may be off with 95 % confidence; and how much is allowed.
    """

    solves: int
    design: int
    failed: int
    failed_where: str
    doubts: str
    scatter: float
    log_prob_error: float
    share: float
    log_prob_sd: float
    shift: float
    shift_tolerance: float

    _others: ClassVar[Mapping[str, str]] = {
        name: f"surrogate_{name}" for name in ("solves", "design", "failed", "failed_where", "doubts", "scatter")
    }

    @property
    def ok(self) -> bool:
        """Whether means and standard deviations are off by no more than is allowed."""
        return bool(self.shift <= self.shift_tolerance)

    def sentences(self) -> list[str]:
        """Say how the surrogate was learnt, how far off it may be, and where it is doubtful."""
        # to one decimal place where they are near to each other
        near = self.shift <= 10.0 * self.shift_tolerance
        found, limit = (
            apart(self.shift, self.shift_tolerance, digits=2)
            if near
            else (significant(self.shift, 2), typed(self.shift_tolerance))
        )
        said = [
            f"Gaussian processes stand for the model: they were learnt from {whole(self.design)} "
            f"solves, and {self.draws} draws of the posterior, unseen by them, were solved to check them: "
            f"{whole(self.solves)} solves in all."
        ]
        if np.isfinite(self.shift):
            said += [
                f"With 95 % confidence no posterior mean is off by more than {found} posterior standard "
                f"deviations, and no standard deviation by more than {found} of its size "
                f"({'allowed' if self.ok else 'more than the allowed'}: {limit}), to first order.",
                f"In the log-probability the largest error at these draws is "
                f"{significant(self.log_prob_error, 2)}, and with 95 % confidence "
                f"{share(self.share)} of the posterior has no larger one.",
            ]
        else:
            said.append("The model could not be solved at some of these draws, so that nothing is certified.")
        if self.failed_where:
            said.append(
                f"The model could not be solved everywhere: {self.failed_where}. The edge of that region is known "
                "only as closely as solves lie to it, which the certificate does not contain: where the posterior "
                "reaches it, its means may be off by more."
            )
        if self.scatter > _SCATTER:
            said.append(
                f"The solver's frequencies seem to scatter by {significant(self.scatter, 2)} of their size; the "
                "certificate has that of the solves that check."
            )
        return said + self.doubts.splitlines()

    def reason_against(self) -> list[str]:
        """Return why draws of the surrogate do not count; nothing if it keeps its tolerance."""
        if self.ok:
            return []
        is_known = np.isfinite(self.shift)
        off = f"by {significant(self.shift, 2)} posterior standard deviations" if is_known else "by any amount"
        return [
            f"the surrogate misses its tolerance: by its certificate posterior means may be off {off} (allowed: "
            f"{typed(self.shift_tolerance)}), whatever its draws say"
        ]
