"""Read the optional properties of a log-density, with defaults if it lacks them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol, TypeGuard

import numpy as np

from fmu.types import FloatArray, LogDensity

if TYPE_CHECKING:
    from fmu.posterior.discrepancy.likelihood import DiscrepantLikelihood
    from fmu.posterior.problem import UpdatingProblem


def is_updating(problem: object) -> TypeGuard[UpdatingProblem]:
    """Return True if `problem` is an updating problem, or has the attributes of one."""
    return hasattr(problem, "parameters") and hasattr(problem, "likelihood")


def discrepant_likelihood(problem: UpdatingProblem) -> DiscrepantLikelihood | None:
    """Return the problem's likelihood if it includes model discrepancy, otherwise None."""
    from fmu.posterior.discrepancy.likelihood import DiscrepantLikelihood

    likelihood = problem.likelihood
    return likelihood if isinstance(likelihood, DiscrepantLikelihood) else None


def has_several_tests(problem: object) -> TypeGuard[UpdatingProblem]:
    """Return True if `problem` is an updating problem with several tests."""
    return len(getattr(problem, "tests", ())) > 1


class WithPrior(LogDensity, Protocol):
    """A log-density whose prior can be sampled."""

    def sample_prior(self, rng: np.random.Generator, n: int) -> FloatArray:
        """Draw `n` parameter vectors from the prior, shape (n, ndim)."""
        ...


def has_prior(density: LogDensity) -> TypeGuard[WithPrior]:
    """Return True if a log-density has a prior that can be sampled."""
    return hasattr(density, "sample_prior")


def names_of(density: LogDensity) -> tuple[str, ...]:
    """Return the parameter names, or ``x0``, ``x1``, ... if the density has none."""
    return tuple(getattr(density, "names", (f"x{i}" for i in range(density.ndim))))


def units_of(density: LogDensity) -> tuple[str, ...]:
    """Return the parameter units, or empty strings if the density has none."""
    return tuple(getattr(density, "units", ("",) * density.ndim))


def start_of(density: LogDensity) -> FloatArray | None:
    """Return the starting point, shape (ndim,), or None if the density has none."""
    start = getattr(density, "start", None)
    return None if start is None else np.asarray(start, dtype=float)
