"""Several tests of a structure, stacked in one `ModalData`. Each of them may be the mean of repeated tests."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.data.repeated import RepeatedTests
from fmu.types import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class StackedTests:
    """Repeated tests of each part of stacked modal data; a part is one of the structure's tests.

    The class has the methods of `RepeatedTests` that error models call. Each part has an estimated scatter of its
    own. The errors of different parts are independent.

    Attributes
    ----------
    parts : tuple of RepeatedTests or None
        None for a part whose standard deviations are not estimated from repeated tests.
    first : ndarray of int, shape (n_parts + 1,)
        Index of the first mode of each part in the stacked data, followed by the number of modes.
    """

    parts: tuple[RepeatedTests | None, ...]
    first: IntArray

    def normal_scores(self, z: FloatArray, used: IntArray | None = None) -> FloatArray:
        """Convert errors (..., n_modes) to normal scores; see `RepeatedTests.normal_scores`."""
        return self._each(used, lambda part, at, own: part.normal_scores(z[..., at], own), z)

    def freedom_given_others(self, used: IntArray | None) -> FloatArray:
        """Return degrees of freedom, (n_modes,), or infinity; see `RepeatedTests.freedom_given_others`."""
        gaussian = np.full(self.first[-1], np.inf)
        return self._each(used, lambda part, _, own: part.freedom_given_others(own), gaussian)

    def widened_given_others(self, squares: FloatArray, own: FloatArray, used: IntArray | None) -> FloatArray:
        """Return factors (n, n_modes) on standard deviations; see `RepeatedTests.widened_given_others`."""

        def of(part: RepeatedTests, at: slice, of_part: IntArray | None) -> FloatArray:
            return part.widened_given_others(squares[:, at], own[:, at], of_part)

        return self._each(used, of, np.ones_like(own))

    def standard_errors(self, rng: np.random.Generator, size: int) -> FloatArray:
        """Draw errors of means of new tests, (size, n_modes); see `RepeatedTests.standard_errors`."""
        gaussian = rng.standard_normal((size, self.first[-1]))
        return self._each(None, lambda part, _at, _own: part.standard_errors(rng, size), gaussian)

    def _each(
        self,
        used: IntArray | None,
        of: Callable[[RepeatedTests, slice, IntArray | None], FloatArray],
        gaussian: FloatArray,
    ) -> FloatArray:
        """Return a copy of `gaussian`, (…, n_modes), with the results of `of` for the parts with repeated tests.

        `of` is called with the part's repeated tests, the slice of its modes, and the indices of its used modes. A
        part without a used mode keeps its entries of `gaussian`.
        """
        found = np.array(gaussian)
        for part, (first, end) in zip(self.parts, pairwise(self.first.tolist()), strict=True):
            own = None if used is None else used[(used >= first) & (used < end)] - first
            if part is not None and (own is None or len(own)):
                found[..., first:end] = of(part, slice(first, end), own)
        return found


type Scatter = RepeatedTests | StackedTests
"""Tests whose scatter gave standard deviations."""


@dataclass(frozen=True, eq=False)
class StackedData(ModalData):
    """Modes of several tests of a structure.

    Attributes
    ----------
    repeated : StackedTests or None
        The repeated tests that gave the frequency uncertainty of at least one test.
    freedom_of_shapes : ndarray, shape (n_modes,), or None
        Degrees of freedom of `shapes_sd`, infinite where repeated tests did not give it; None if none did.
    """

    repeated: StackedTests | None = None
    freedom_of_shapes: FloatArray | None = None


def stacked_tests(every: Sequence[ModalData]) -> StackedTests | None:
    """Return the repeated tests that gave the frequency uncertainty of each of `every`; None if none did."""
    parts = tuple(tests if isinstance(tests, RepeatedTests) else None for tests in map(scatter_of, every))
    first = np.cumsum([0, *(data.n_modes for data in every)])
    return StackedTests(parts, first) if any(parts) else None


def scatter_of(data: ModalData) -> Scatter | None:
    """Return the repeated tests that gave the frequency uncertainty in `data`; None if none did."""
    if isinstance(data, StackedData):
        return data.repeated
    tests = data.tests
    return tests if tests is not None and tests.gave(data.sd_hz, data.covariance_hz2) else None


def freedom_of_shapes(data: ModalData) -> FloatArray | None:
    """Return the degrees of freedom ν of each mode's `shapes_sd`, (n_modes,); None if no tests gave them."""
    if isinstance(data, StackedData):
        return data.freedom_of_shapes
    return None if data.tests is None else data.tests.freedom_of_shapes(data.shapes_sd)


def stacked_freedom_of_shapes(every: Sequence[ModalData]) -> FloatArray | None:
    """Return `freedom_of_shapes` of `every`, infinite where no tests gave it; None if none did."""
    found = [freedom_of_shapes(data) for data in every]
    if all(nu is None for nu in found):
        return None
    return np.concatenate(
        [np.full(data.n_modes, np.inf) if nu is None else nu for nu, data in zip(found, every, strict=True)]
    )
