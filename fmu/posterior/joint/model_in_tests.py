"""Evaluate one structural model in several tests, as a function of the structural parameters in each test."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

import numpy as np

from fmu.fem.black_box import BlackBoxModel
from fmu.fem.modes.separable import SeparableModel
from fmu.fem.pairing.modal_model import ModalModel
from fmu.fem.pairing.prediction import ModalPrediction
from fmu.fem.pairing.sensitivities import Sensitivities, Steps
from fmu.fem.programs.solves import Failure
from fmu.types import FloatArray, IntArray, Plain


@dataclass(frozen=True, eq=False)
class Configuration:
    """A group of tests with the same matrices and sensors, which are therefore solved in one batch.

    Attributes
    ----------
    model : ModalModel
        The model, paired with every mode that was measured in at least one of these tests.
    tests : ndarray of int, shape (n_here,)
        Indices of the tests.
    distinct : ndarray of int, shape (n_distinct,)
        Indices of the tests that are solved. Every other test always has the same parameters as one of them.
    parameters : ndarray of int, shape (p,)
        Indices of the structural parameters that are parameters of `model`. The others are known in these tests,
        or are damping parameters.
    columns : ndarray of int, shape (m,)
        Indices of these tests' measured modes among the modes of all tests.
    test, row, mode : ndarray of int, shape (m,)
        For each of these measured modes, the index into `tests`, the index into `distinct`, and the index among
        the modes of `model`.
    """

    model: ModalModel
    tests: IntArray
    distinct: IntArray
    parameters: IntArray
    columns: IntArray
    test: IntArray
    row: IntArray
    mode: IntArray

    @cached_property
    def without_repetition(self) -> list[IntArray]:
        """Indices of the measured modes, split into sets in which each mode of each solve occurs at most once."""
        pairs = list(zip(self.row.tolist(), self.mode.tolist(), strict=True))
        times = np.array([pairs[:i].count(pair) for i, pair in enumerate(pairs)])
        return [np.flatnonzero(times == k) for k in range(int(times.max()) + 1)]

    def points(self, values: FloatArray) -> FloatArray:
        """Return the model parameters of all solves, (n · n_distinct, p).

        `values`, (n, n_tests, n_structural), are the structural parameters in all tests.
        """
        own = values[:, self.distinct[:, None], self.parameters]
        return own.reshape(-1, len(self.parameters))

    def pick(self, found: FloatArray) -> FloatArray:
        """Select the measured modes' entries, (n, m, …), from an array (n · n_distinct, n_modes, …)."""
        return found.reshape(-1, len(self.distinct), *found.shape[1:])[:, self.row, self.mode]

    def pick_shapes(self, found: FloatArray) -> FloatArray:
        """Select the measured modes' entries, (n, q, m, …), from an array (n · n_distinct, q, n_modes, …)."""
        return np.moveaxis(self.pick(np.moveaxis(found, 1, 2)), 1, 2)


class ModelInTests(ModalModel):
    """The modes of a structure in all tests, as a function of the structural parameters in each test.

    An evaluation of all tests counts as one solve. A mode's derivatives are with respect to the P structural
    parameters in its own test only, because the derivatives with respect to other tests' parameters are zero.

    Parameters
    ----------
    configurations : sequence of Configuration
        Every test belongs to exactly one configuration.
    tests : sequence of str
        Names of the tests.
    n_structural : int
        P, the number of structural parameters.
    n_modes : int
        Number of measured modes in all tests together.

    Attributes
    ----------
    n_parameters : int
        The product n_tests P. The parameters in the first test come first, then the parameters in the second
        test, and so on.
    """

    name = "ModelInTests"

    def __init__(
        self, configurations: Sequence[Configuration], tests: Sequence[str], n_structural: int, n_modes: int
    ) -> None:
        self.configurations, self.tests = tuple(configurations), tuple(tests)
        self.n_tests, self.n_structural, self.n_modes = len(tests), n_structural, n_modes
        self.n_parameters = self.n_tests * n_structural
        models = self.parts
        self.gives_shapes = all(model.gives_shapes for model in models)
        self.gives_shape_curvature = all(model.gives_shape_curvature for model in models)
        self.has_exact_curvature = all(model.has_exact_curvature for model in models)
        self.by_shape = any(model.by_shape for model in models)
        self.solves_per_gradient = max(model.solves_per_gradient for model in models)
        self.solves_per_shape_gradient = max(model.solves_per_shape_gradient for model in models)

    def __repr__(self) -> str:
        return f"ModelInTests({self.n_tests} tests, {len(self.configurations)} configurations)"

    @property
    def parts(self) -> tuple[ModalModel, ...]:
        """The model of each configuration."""
        return tuple(part.model for part in self.configurations)

    @cached_property
    def test_of_modes(self) -> IntArray:
        """For each measured mode, the index of its test, shape (n_modes,)."""
        found = np.empty(self.n_modes, dtype=np.int64)
        for part in self.configurations:
            found[part.columns] = part.tests[part.test]
        return found

    @property
    def truth(self) -> ModelInTests:
        """The same model with each configuration's true model in place of its approximation."""
        return self._with([model.truth for model in self.parts])

    @property
    def full_solves(self) -> int:  # type: ignore[override]
        """Number of solves of full models so far in the configurations whose model is reduced."""
        return sum(model.full_solves for model in self.parts)

    @property
    def sizes(self) -> tuple[int, ...]:  # type: ignore[override]
        """Number of unknowns in each block of each configuration's reduced model; empty if none is reduced."""
        return tuple(size for model in self.parts for size in model.sizes)

    @property
    def reasons(self) -> Sequence[Failure]:
        """The first points at which a user's function failed, each with the reason."""
        return tuple(reason for model in self.parts for reason in model.reasons)

    @property
    def functions(self) -> tuple[BlackBoxModel, ...]:  # type: ignore[override]
        """The different user functions that the configurations' models call."""
        return tuple(dict.fromkeys(function for model in self.parts for function in model.functions))

    def seconds_at(self, theta: FloatArray) -> float | None:
        """Return the time in s that all calls of users' functions take at theta (n_parameters,).

        Return None if no functions are called. In each configuration, only the first solved test is timed, and the
        other tests are assumed to take as long. The function is called for this test unless its result is already
        stored.
        """
        found = []
        for part in self.configurations:
            points = part.points(self._in_tests(theta[None]))
            found.append((part.model.seconds_at(points[0]), len(points)))
        return sum(one * n for one, n in found if one is not None) if self.functions else None

    def coarser(self, share: float) -> Self:
        """Return a copy in which each configuration's reduced model has only the given share of its basis vectors.

        Models that are not reduced stay unchanged. If no model is reduced, return `self`.
        """
        return self._with([model.coarser(share) for model in self.parts])

    def _with(self, models: Sequence[ModalModel]) -> Self:
        if tuple(models) == self.parts:
            return self
        both = [replace(part, model=model) for part, model in zip(self.configurations, models, strict=True)]
        return type(self)(both, self.tests, self.n_structural, self.n_modes)

    def matrices_of(self, k: int) -> tuple[SeparableModel, int] | None:
        """Return the first model whose matrices depend on structural parameter `k`, and the index of `k` there.

        Return None if no matrices depend on it.
        """
        for part in self.configurations:
            if k in part.parameters:
                return part.model.matrices_of(int(np.flatnonzero(part.parameters == k)[0]))
        return None

    def failed_tests(self, theta: FloatArray) -> Iterator[tuple[str, ModalModel, FloatArray]]:
        """Yield the name, model and model parameters of each solved test in which a frequency is not finite.

        `theta` has the shape (n_parameters,). If the model is a user's function, every solved test is yielded,
        because the function is not called again.
        """
        for part in self.configurations:
            points = part.points(self._in_tests(theta[None]))
            if part.model.functions:  # a user's function is not called again
                failed = np.ones(len(points), dtype=bool)
            else:
                failed = ~np.isfinite(part.model.frequencies(points)).all(axis=1)
            for row in np.flatnonzero(failed):
                yield self.tests[part.distinct[row]], part.model, points[row]

    def of_modes(self, theta: FloatArray, of: Callable[[Any, FloatArray], FloatArray]) -> FloatArray:
        """Apply `of` to each configuration's model and parameters; return the results for all measured modes.

        The result has the shape (n, n_modes, …).
        """
        values = self._in_tests(theta)
        seen = [part.pick(of(part.model, part.points(values))) for part in self.configurations]
        found = np.empty((len(theta), self.n_modes, *seen[0].shape[2:]))
        for part, one in zip(self.configurations, seen, strict=True):
            found[:, part.columns] = one
        return found

    def frequencies(self, theta: FloatArray) -> FloatArray:
        """Return frequencies in Hz, shape (n, n_modes), at theta (n, n_parameters); NaN where a solve failed."""
        return self.of_modes(theta, lambda model, points: model.frequencies(points))

    def in_test(self, test: int) -> tuple[ModalModel, IntArray]:
        """Return the model of one test, with its changes, and the indices of its structural parameters."""
        part = self._part(test)
        return part.model, part.parameters

    def frequencies_of_test(self, test: int, values: FloatArray) -> FloatArray:
        """Return the frequencies of the modes measured in one test, in Hz, shape (n, n_here).

        `values`, (n, n_structural), are the structural parameters in this test.
        """
        part = self._part(test)
        modes = part.mode[part.tests[part.test] == test]
        return part.model.frequencies(values[:, part.parameters])[:, modes]

    def frequencies_and_gradient(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return frequencies in Hz, (n, n_modes), and their derivatives, (n, n_modes, n_structural).

        A mode's derivatives are with respect to the structural parameters in its own test.
        """
        values = self._in_tests(theta)
        frequencies = np.empty((len(theta), self.n_modes))
        slopes = np.zeros((len(theta), self.n_modes, self.n_structural))
        for part in self.configurations:
            found, gradient = part.model.frequencies_and_gradient(part.points(values))
            frequencies[:, part.columns] = part.pick(found)
            slopes[:, part.columns[:, None], part.parameters] = part.pick(gradient)
        return frequencies, slopes

    def sensitivities(self, theta: FloatArray, steps: Steps, shapes: bool = False) -> Sensitivities:
        """Return frequencies and derivatives; see `ModalModel`.

        The gradient, the directions and the bounds in `steps` have n_structural components, as in
        `frequencies_and_gradient`; the step sizes have n_parameters components.
        """
        values, sizes = self._in_tests(theta), self._in_tests(steps.size)
        parts = []
        for part in self.configurations:
            own = Steps(part.points(sizes), steps.bounds[:, part.parameters])
            parts.append((part, part.model.sensitivities(part.points(values), own, shapes)))
        return _SensitivitiesInTests(parts, (len(theta), self.n_modes, self.n_structural))

    def observed(self, theta: FloatArray, gradient: bool = False) -> ModalPrediction:
        """Return frequencies and mode shapes at the sensors.

        If `gradient` is True, they have derivatives as in `frequencies_and_gradient`.
        """
        values = self._in_tests(theta)
        n, m, p = len(theta), self.n_modes, self.n_structural
        seen = [part.model.observed(part.points(values), gradient) for part in self.configurations]
        q = seen[0].shapes.shape[1]
        frequencies, shapes = np.empty((n, m)), np.empty((n, q, m))
        by_frequency, by_shape = np.zeros((n, m, p)), np.zeros((n, q, m, p))
        for part, one in zip(self.configurations, seen, strict=True):
            frequencies[:, part.columns] = part.pick(one.frequencies)
            shapes[:, :, part.columns] = part.pick_shapes(one.shapes)
            if gradient:
                columns = part.columns[:, None]
                by_frequency[:, columns, part.parameters] = part.pick(np.asarray(one.frequency_slopes))
                by_shape[:, :, columns, part.parameters] = part.pick_shapes(np.asarray(one.shape_slopes))
        if not gradient:
            return ModalPrediction(frequencies, shapes)
        return ModalPrediction(frequencies, shapes, by_frequency, by_shape)

    def configuration(self) -> dict[str, Plain]:
        """Return the data that identify the model as a dict of plain Python types."""
        return {
            "configurations": [
                {"tests": part.tests.tolist(), "model": part.model.configuration()} for part in self.configurations
            ],
        }

    def _part(self, test: int) -> Configuration:
        """Return the configuration of a test, an index."""
        return next(one for one in self.configurations if test in one.tests)

    def _in_tests(self, theta: FloatArray) -> FloatArray:
        """Return the parameters in each test, (n, n_tests, n_structural), from theta (n, n_parameters or more)."""
        return theta[:, : self.n_parameters].reshape(len(theta), self.n_tests, self.n_structural)


class _SensitivitiesInTests(Sensitivities):
    """Sensitivities in several tests, joined over all configurations.

    The gradient has the shape (n, m, n_structural).
    """

    def __init__(self, parts: Sequence[tuple[Configuration, Sensitivities]], shape: tuple[int, int, int]) -> None:
        self._parts = parts
        self.frequencies, self.gradient = np.empty(shape[:2]), np.zeros(shape)
        for part, found in parts:
            self.frequencies[:, part.columns] = part.pick(found.frequencies)
            self.gradient[:, part.columns[:, None], part.parameters] = part.pick(found.gradient)
        first = parts[0][1].shapes
        if first is None:
            return
        (n, m, p), q = shape, first.shape[1]
        self.shapes, self.shape_slopes = np.empty((n, q, m)), np.zeros((n, q, m, p))
        for part, found in parts:
            self.shapes[:, :, part.columns] = part.pick_shapes(np.asarray(found.shapes))
            moved = part.pick_shapes(np.asarray(found.shape_slopes))
            self.shape_slopes[:, :, part.columns[:, None], part.parameters] = moved

    def curvature(self, d: FloatArray, of_shapes: FloatArray | None = None) -> FloatArray:
        """Return second derivatives along `d`, plus weighted second derivatives of mode shapes.

        See `Sensitivities.curvature`.
        """
        found = np.zeros(d.shape)
        for part, model in self._parts:
            own = d[:, part.columns[:, None], part.parameters]
            weights = None if of_shapes is None else of_shapes[:, :, part.columns[:, None], part.parameters]
            picked = np.empty(own.shape)
            for some in part.without_repetition:  # tests that share a solve still have different directions
                along = np.zeros((len(d), len(part.distinct), *model.gradient.shape[1:]))
                along[:, part.row[some], part.mode[some]] = own[:, some]
                of_model = None
                if weights is not None:
                    q = weights.shape[1]
                    spread = np.zeros((len(d), len(part.distinct), q, *model.gradient.shape[1:]))
                    spread[:, part.row[some], :, part.mode[some]] = np.moveaxis(weights[:, :, some], 2, 0)
                    of_model = spread.reshape(-1, *spread.shape[2:])
                turned = model.curvature(along.reshape(model.gradient.shape), of_model).reshape(along.shape)
                picked[:, some] = turned[:, part.row[some], part.mode[some]]
            found[:, part.columns[:, None], part.parameters] = picked
        return found
