"""Properties of a log-density, and the defaults for properties that it does not define."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol, TypeGuard

import numpy as np

from fmu.types import FloatArray, LogDensity

if TYPE_CHECKING:
    from fmu.posterior.discrepancy.likelihood import DiscrepantLikelihood
    from fmu.posterior.problem import UpdatingProblem


def is_updating(problem: object) -> TypeGuard[UpdatingProblem]:
    """Return True if `problem` is an updating problem, or an object with its attributes."""
    return hasattr(problem, "parameters") and hasattr(problem, "likelihood")


def discrepant_likelihood(problem: UpdatingProblem) -> DiscrepantLikelihood | None:
    """Return the likelihood of a problem whose model has errors of its own; None for any other problem."""
    from fmu.posterior.discrepancy.likelihood import DiscrepantLikelihood

    likelihood = problem.likelihood
    return likelihood if isinstance(likelihood, DiscrepantLikelihood) else None


def has_several_tests(problem: object) -> TypeGuard[UpdatingProblem]:
    """Return True if `problem` is an updating problem of several tests."""
    return len(getattr(problem, "tests", ())) > 1


class WithPrior(LogDensity, Protocol):
    """A log-density with a prior from which draws can be made."""

    def sample_prior(self, rng: np.random.Generator, n: int) -> FloatArray:
        """Draw `n` parameter vectors, shape (n, ndim)."""
        ...


def has_prior(density: LogDensity) -> TypeGuard[WithPrior]:
    """Return True if a log-density has a prior from which draws can be made."""
    return hasattr(density, "sample_prior")


def names_of(density: LogDensity) -> tuple[str, ...]:
    """Return the names of the parameters; ``x0``, ``x1``, ... if the density has no names."""
    return tuple(getattr(density, "names", (f"x{i}" for i in range(density.ndim))))


def units_of(density: LogDensity) -> tuple[str, ...]:
    """Return the units of the parameters; empty strings if the density has no units."""
    return tuple(getattr(density, "units", ("",) * density.ndim))


def start_of(density: LogDensity) -> FloatArray | None:
    """Return the starting point, shape (ndim,); None if the density has none."""
    start = getattr(density, "start", None)
    return None if start is None else np.asarray(start, dtype=float)
