"""Certificates: records of a cheap model's errors and of the largest errors allowed."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Hashable, Mapping
from dataclasses import MISSING, asdict, dataclass, fields
from typing import Any, ClassVar, Self

import numpy as np

from fmu.numbers import apart, share, significant, typed, whole

_SCATTER = 1e-5
"""Relative scatter of a solver's frequencies above which it is reported."""


@dataclass(frozen=True)
class Certificate(ABC):
    """A cheap model's errors at posterior draws, and the largest errors allowed.

    Attributes
    ----------
    draws : int
        Number of posterior draws that were solved with the true model.
    frequency_error : float
        Largest relative frequency error at these draws.
    """

    draws: int
    frequency_error: float

    _others: ClassVar[Mapping[str, str]] = {}
    """Keys of fields in a trace, where the key is not ``certificate_`` followed by the field's name."""

    @classmethod
    def from_trace(cls, attrs: Mapping[Hashable, Any]) -> Self | None:
        """Return the certificate in a trace's attributes, or None if no certificate of this class is stored."""
        found: dict[str, Any] = {}
        for field in fields(cls):
            key = cls._key(field.name)
            if key in attrs:
                found[field.name] = np.asarray(attrs[key]).item()
            elif field.default is MISSING:
                return None
        return cls(**found)

    def attributes(self) -> dict[str, object]:
        """Return the trace attributes that store the certificate, without fields that are None."""
        return {self._key(name): value for name, value in asdict(self).items() if value is not None}

    @classmethod
    def _key(cls, name: str) -> str:
        return cls._others.get(name, f"certificate_{name}")

    @property
    @abstractmethod
    def ok(self) -> bool:
        """Whether the errors are within their tolerances."""

    @abstractmethod
    def sentences(self) -> list[str]:
        """Return sentences that describe the errors and the largest errors allowed."""


@dataclass(frozen=True)
class ReductionCertificate(Certificate):
    """Errors of a reduced basis at a run's posterior draws: bounds, and exact errors at some of the draws.

    Attributes
    ----------
    log_prob_error : float
        Largest log-probability error at the solved draws whose log-likelihood is at most `Tolerance.depth` below
        the highest; 0 if no measured mode enters the likelihood. At lower likelihoods, where a chain may have
        started, the error is not bounded.
    pairing_changes : int
        Number of solved draws at which the true model pairs a measured mode with a different computed mode.
    full_solves : int
        Number of solves of the true model during the run, because theta lay outside the trained box or the reduced
        solve failed.
    frequency_tolerance, log_prob_tolerance : float
        See `fmu.posterior.reduction.tolerance.Tolerance`.
    bound_draws : int or None
        Number of draws at which bounds on the frequency errors were computed from residuals.
    bound, bound_median : float or None
        Largest bound on a relative frequency error at these draws, and the median over the draws of each draw's
        largest bound.
    bound_exceeded : int or None
        Number of solved draws at which an error exceeds its bound by more than rounding. Draws at which the
        pairing changes do not count.
    full_share : float or None
        Share of the draws that lie outside the trained box, where the true model is solved.
    frequency_elsewhere : float or None
        Frequency tolerance in the part of the box without noticeable posterior mass, if it differs from
        `frequency_tolerance`.
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
        return not self.what_fails

    @property
    def what_fails(self) -> str:
        """What is wrong with the reduced model's error, as a phrase; empty if `ok`."""
        is_small = (
            self.frequency_error <= self.frequency_tolerance and self.log_prob_error <= self.log_prob_tolerance
        )
        if not is_small or self.pairing_changes:
            return "outside its tolerance"
        return "above its bound, but within its tolerance" if self.bound_exceeded else ""

    def sentences(self) -> list[str]:
        """Return a list with a sentence on errors, pairing changes and exceeded bounds, or [] if `ok`."""
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
            f"the error of the reduced model is {self.what_fails}; {self.draws} draws were solved again with the "
            f"full model: {', '.join(off)}, different pairing at {self.pairing_changes} draws, error above its "
            f"bound at {self.bound_exceeded} draws"
        ]


@dataclass(frozen=True)
class SurrogateCertificate(Certificate):
    """Errors of a surrogate (`fmu.surrogate`) at posterior draws that were solved to check it.

    Attributes
    ----------
    solves, design : int
        Total number of model solves, and number of solves from which the surrogate was built.
    failed : int
        Number of solves that failed.
    failed_where : str
        Where the solves of the design failed, in words; empty if none did.
    doubts : str
        Warnings on modes that may have been confused with other modes, one line per mode; empty if there are none.
    scatter : float
        Estimated relative scatter of the solver's frequencies.
    log_prob_error : float
        Largest deviation of the log-probability error from its mean; with 95 % confidence, `share` of the
        posterior has no larger deviation.
    share : float
        Share of the posterior for which `log_prob_error` holds.
    log_prob_sd : float
        Standard deviation of the log-probability error.
    shift, shift_tolerance : float
        Largest error, with 95 % confidence, in any posterior mean (in posterior standard deviations) or posterior
        standard deviation (relative); and the largest value allowed. `shift` is not finite if some of the draws
        could not be solved.
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
        """Whether the errors in posterior means and standard deviations are within the tolerance."""
        return bool(self.shift <= self.shift_tolerance)

    def sentences(self) -> list[str]:
        """Return sentences on how the surrogate was built, its errors and where it is unreliable."""
        # to a common decimal place if the values are of similar size
        near = 0.1 * self.shift_tolerance <= self.shift <= 10.0 * self.shift_tolerance
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
        """Return a list with the reason why the surrogate's draws do not count, or [] if they do."""
        if self.ok:
            return []
        is_known = np.isfinite(self.shift)
        off = f"by {significant(self.shift, 2)} posterior standard deviations" if is_known else "by any amount"
        return [
            f"the surrogate misses its tolerance: by its certificate posterior means may be off {off} (allowed: "
            f"{typed(self.shift_tolerance)}), whatever its draws say"
        ]
