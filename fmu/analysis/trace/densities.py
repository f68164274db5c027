"""What a log-density says of itself, and what is assumed where it does not."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol, TypeGuard

import numpy as np

from fmu.types import FloatArray, LogDensity

if TYPE_CHECKING:
    from fmu.posterior.problem import UpdatingProblem


def is_updating(problem: object) -> TypeGuard[UpdatingProblem]:
    """Say whether this is an updating problem, or an object with its attributes."""
    return hasattr(problem, "parameters") and hasattr(problem, "likelihood")


def has_several_tests(problem: object) -> TypeGuard[UpdatingProblem]:
    """Say whether this is an updating problem of several tests."""
    return len(getattr(problem, "tests", ())) > 1


class WithPrior(LogDensity, Protocol):
    """A log-density with a prior that can be drawn from."""

    def sample_prior(self, rng: np.random.Generator, n: int) -> FloatArray:
        """Draw `n` parameter vectors, shape (n, ndim)."""
        ...


def has_prior(density: LogDensity) -> TypeGuard[WithPrior]:
    """Say whether a log-density has a prior that can be drawn from."""
    return hasattr(density, "sample_prior")


def names_of(density: LogDensity) -> tuple[str, ...]:
    """Return the parameters' names; ``x0``, ``x1``, ... if the density has none."""
    return tuple(getattr(density, "names", (f"x{i}" for i in range(density.ndim))))


def units_of(density: LogDensity) -> tuple[str, ...]:
    """Return the parameters' units; empty where the density has none."""
    return tuple(getattr(density, "units", ("",) * density.ndim))


def start_of(density: LogDensity) -> FloatArray | None:
    """Return the start vector, shape (ndim,); None if the density has none."""
    start = getattr(density, "start", None)
    return None if start is None else np.asarray(start, dtype=float)
