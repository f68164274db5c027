"""The modes of all tests as the modes of one model, for samplers, diagnostics and reports of a single test."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from fmu.fem.black_box import BlackBoxModel
from fmu.fem.modes.separable import SeparableModel
from fmu.fem.pairing.modal_model import ModalModel
from fmu.fem.pairing.prediction import ModalPrediction
from fmu.fem.programs.solves import Failure
from fmu.posterior.joint.layout import Layout
from fmu.types import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class Configuration:
    """Tests that share the matrices and the sensors, and are therefore solved in one batch.

    Attributes
    ----------
    model : ModalModel
        Paired with every mode that one of these tests has measured.
    tests : ndarray of int, shape (n_here,)
        Which tests.
    distinct : ndarray of int, shape (n_distinct,)
        Those of them that are solved: the others always have the parameters of one of these.
    parameters : ndarray of int, shape (p,)
        Which parameters of the structure the model takes; the others are known.
    columns : ndarray of int, shape (m,)
        Their modes among those of all tests.
    test, row, mode : ndarray of int, shape (m,)
        Of each: the row in `tests`, the row in `distinct`, and the mode of `model`.
    """

    model: ModalModel
    tests: IntArray
    distinct: IntArray
    parameters: IntArray
    columns: IntArray
    test: IntArray
    row: IntArray
    mode: IntArray

    def points(self, values: FloatArray) -> FloatArray:
        """Return the model's parameters, (n · n_distinct, p), from all of them, (n, n_tests, n_structural)."""
        own = values[:, self.distinct[:, None], self.parameters]
        return own.reshape(-1, len(self.parameters))

    def pick(self, found: FloatArray) -> FloatArray:
        """Return the measured modes, shape (n, m, …), from all modes at `points`, (n · n_distinct, modes, …)."""
        return found.reshape(-1, len(self.distinct), *found.shape[1:])[:, self.row, self.mode]


class JointModel(ModalModel):
    """One model that has the modes of every test, as a function of the parameters of all tests.

    An evaluation at one theta is counted as one solve, however many tests there are.

    Parameters
    ----------
    layout : Layout
    configurations : sequence of Configuration
        Every test is in one of them.
    n_modes : int
        Number of measured modes of all tests.

    Attributes
    ----------
    test : ndarray of int, shape (n_modes,)
        The test that each mode is of.
    """

    name = "JointModel"

    def __init__(self, layout: Layout, configurations: Sequence[Configuration], n_modes: int) -> None:
        self.layout, self.configurations = layout, tuple(configurations)
        self.n_parameters, self.n_modes, self.n_tests = len(layout.parameters), n_modes, layout.n_tests
        models = [part.model for part in self.configurations]
        self.gives_shapes = all(model.gives_shapes for model in models)
        self.by_shape = any(model.by_shape for model in models)
        self.solves_per_gradient = max(model.solves_per_gradient for model in models)
        self.solves_per_shape_gradient = max(model.solves_per_shape_gradient for model in models)
        self.test = np.empty(n_modes, dtype=np.int64)
        for part in self.configurations:
            self.test[part.columns] = part.tests[part.test]

    def __repr__(self) -> str:
        return f"JointModel({self.layout.n_tests} tests, {len(self.configurations)} configurations)"

    @property
    def parts(self) -> tuple[ModalModel, ...]:
        """The model of each configuration."""
        return tuple(part.model for part in self.configurations)

    @property
    def truth(self) -> JointModel:
        """The joint model of the true model of each configuration."""
        truths = [part.model.truth for part in self.configurations]
        return self if list(self.parts) == truths else self._with(truths)

    @property
    def full_solves(self) -> int:  # type: ignore[override]
        """How often a full model had to answer where there is a reduced one."""
        return sum(part.model.full_solves for part in self.configurations)

    @property
    def sizes(self) -> tuple[int, ...]:  # type: ignore[override]
        """Unknowns of each block of the reduced models."""
        return tuple(size for part in self.configurations for size in part.model.sizes)

    @property
    def reasons(self) -> Sequence[Failure]:
        """The first points at which a user's function failed, and why."""
        return tuple(reason for part in self.configurations for reason in part.model.reasons)

    @property
    def functions(self) -> tuple[BlackBoxModel, ...]:  # type: ignore[override]
        """Return the users' functions that answer, each once."""
        return tuple(dict.fromkeys(function for part in self.configurations for function in part.model.functions))

    def seconds_at(self, theta: FloatArray) -> float | None:
        """Return the seconds that users' functions take at a theta (n_parameters,), None without any."""
        values, found = self.layout.values(theta[None]), []
        for part in self.configurations:
            points = part.points(values)
            found.append((part.model.seconds_at(points[0]), len(points)))
        return sum(one * n for one, n in found if one is not None) if self.functions else None

    def coarser(self, share: float) -> Self:
        """Return the model with a coarser one of each configuration; itself if there is none."""
        coarse = [model.coarser(share) for model in self.parts]
        return self if list(self.parts) == coarse else self._with(coarse)

    def _with(self, models: Sequence[ModalModel]) -> Self:
        both = zip(self.configurations, models, strict=True)
        return type(self)(self.layout, [replace(part, model=model) for part, model in both], self.n_modes)

    def matrices_of(self, k: int) -> tuple[SeparableModel, int] | None:
        """Return the first matrices that parameter `k` of theta changes, and its number there, or None."""
        j = self.layout.roles[k].of if k < self.n_parameters else None
        for part in self.configurations:
            if j is not None and j in part.parameters:
                return part.model.matrices_of(int(np.flatnonzero(part.parameters == j)[0]))
        return None

    def failed_tests(self, theta: FloatArray) -> Iterator[tuple[str, ModalModel, FloatArray]]:
        """Yield the tests without frequencies at a theta (n_parameters,): name, model, and its own parameters."""
        values = self.layout.values(theta[None])
        for part in self.configurations:
            points = part.points(values)
            if part.model.functions:  # not called again
                failed = np.ones(len(points), dtype=bool)
            else:
                failed = ~np.isfinite(part.model.frequencies(points)).all(axis=1)
            for row in np.flatnonzero(failed):
                yield self.layout.tests[part.distinct[row]], part.model, points[row]

    def of_modes(self, theta: FloatArray, of: Callable[[Any, FloatArray], FloatArray]) -> FloatArray:
        """Apply `of` to each configuration's model and parameters; return its values for every measured mode."""
        values = self.layout.values(theta[:, : self.n_parameters])
        seen = [part.pick(of(part.model, part.points(values))) for part in self.configurations]
        found = np.empty((len(theta), self.n_modes, *seen[0].shape[2:]))
        for part, one in zip(self.configurations, seen, strict=True):
            found[:, part.columns] = one
        return found

    def frequencies(self, theta: FloatArray) -> FloatArray:
        """Return frequencies in Hz, shape (n, n_modes), at theta (n, n_parameters); NaN where a solve failed."""
        return self.of_modes(theta, lambda model, points: model.frequencies(points))

    def frequencies_and_gradient(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return frequencies (n, n_modes) and their gradients (n, n_modes, n_parameters)."""
        values = self.layout.values(theta)
        frequencies = np.empty((len(theta), self.n_modes))
        slopes = np.zeros((len(theta), self.n_modes, values.shape[2]))
        for part in self.configurations:
            found, gradient = part.model.frequencies_and_gradient(part.points(values))
            frequencies[:, part.columns] = part.pick(found)
            slopes[:, part.columns[:, None], part.parameters] = part.pick(gradient)
        return frequencies, self._chain_slopes(theta, slopes)

    def observed(self, theta: FloatArray, gradient: bool = False) -> ModalPrediction:
        """Return frequencies and shapes at the sensors, at theta (n, n_parameters), with derivatives if wanted."""
        values = self.layout.values(theta)
        n, m = len(theta), self.n_modes
        seen = [part.model.observed(part.points(values), gradient) for part in self.configurations]
        q, p = seen[0].shapes.shape[1], values.shape[2]
        frequencies, shapes = np.empty((n, m)), np.empty((n, q, m))
        by_frequency, by_shape = np.zeros((n, m, p)), np.zeros((n, q, m, p))
        for part, one in zip(self.configurations, seen, strict=True):
            frequencies[:, part.columns] = part.pick(one.frequencies)
            shapes[:, :, part.columns] = np.moveaxis(part.pick(np.moveaxis(one.shapes, 1, 2)), 1, 2)
            if gradient:
                columns = part.columns[:, None]
                by_frequency[:, columns, part.parameters] = part.pick(np.asarray(one.frequency_slopes))
                moved = part.pick(np.moveaxis(np.asarray(one.shape_slopes), 1, 2))
                by_shape[:, :, columns, part.parameters] = np.moveaxis(moved, 1, 2)
        if not gradient:
            return ModalPrediction(frequencies, shapes)
        chained = [self._chain_slopes(theta, by_shape[:, s]) for s in range(q)]
        return ModalPrediction(
            frequencies, shapes, self._chain_slopes(theta, by_frequency), np.stack(chained, axis=1)
        )

    def configuration(self) -> dict[str, Any]:
        """Return the data that identify the model, in plain Python types."""
        return {
            "configurations": [
                {"tests": part.tests.tolist(), "model": part.model.configuration()} for part in self.configurations
            ],
        }

    def _chain_slopes(self, theta: FloatArray, slopes: FloatArray) -> FloatArray:
        return self.layout.chain_slopes(theta, slopes, self.test)


class SlopesByTest(JointModel):
    """The same model with derivatives by the parameters of the structure in the mode's own test, (n, n_modes, P).

    They are few; by all parameters of all tests most derivatives are zero.

    Parameters
    ----------
    model : JointModel
    """

    def __init__(self, model: JointModel) -> None:
        vars(self).update(vars(model))

    def _chain_slopes(self, theta: FloatArray, slopes: FloatArray) -> FloatArray:
        return slopes
