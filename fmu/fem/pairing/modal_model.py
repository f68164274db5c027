"""Interface for models whose modes are paired with measured modes, and its simple implementations."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from typing import Any, Protocol, Self

import numpy as np

from fmu.engines.base import Engine
from fmu.fem.black_box import BlackBoxModel
from fmu.fem.certificates import Certificate
from fmu.fem.modes.full_block import FullBlock
from fmu.fem.modes.separable import SeparableModel
from fmu.fem.pairing.prediction import ModalPrediction
from fmu.fem.pairing.sensitivities import Sensitivities, SensitivitiesByDifferences, Steps
from fmu.fem.programs.solves import Failure
from fmu.formats.shown import in_words
from fmu.types import Dof, FloatArray, IntArray


class FrequencyMap(Protocol):
    """Protocol for a user's own model: it maps parameters to the frequencies of the measured modes.

    To compare mode shapes too, the model needs the method ``observed``, which returns a
    `fmu.fem.pairing.prediction.ModalPrediction`. The other optional attributes, ``gives_shapes``,
    ``configuration``, ``solves_per_gradient`` and ``reasons``, have the same meaning as in `ModalModel`, but
    ``gives_shapes`` is True by default if there is an ``observed``.

    Attributes
    ----------
    n_parameters, n_modes : int
    """

    n_parameters: int
    n_modes: int

    def frequencies(self, theta: FloatArray) -> FloatArray:
        """Return frequencies in Hz, (n, n_modes), at theta (n, n_parameters), with NaN where a solve failed."""
        ...

    def frequencies_and_gradient(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return frequencies in Hz, shape (n, n_modes), and their gradients, shape (n, n_modes, n_parameters)."""
        ...


class ModalModel:
    """A model whose modes are paired with the measured modes.

    The defaults describe a model that gives frequencies with exact gradients, and nothing else.

    Attributes
    ----------
    n_parameters, n_modes : int
    name : str
        Name used in descriptions of a problem.
    structure : SeparableModel or None
        The model's matrices, if it has any.
    functions : tuple of BlackBoxModel
        User functions that the model calls; empty for other kinds of model.
    full_blocks : tuple of FullBlock
        Matrix blocks that are solved in full; empty for other kinds of model.
    gives_shapes : bool
        Whether `observed` gives shapes at the sensors.
    gives_shape_curvature : bool
        Whether `sensitivities` gives shapes and weighted sums of their second derivatives.
    has_exact_curvature : bool
        Whether `sensitivities` takes one solve. Otherwise, second derivatives take 2 n_modes more gradients.
    is_soft : bool
        Whether every measured mode is paired with all candidates, with weights
        (`fmu.fem.pairing.rules.SoftPairing`).
    is_uncertain : bool
        Whether `observed` gives the variances of the model's own errors, as a surrogate does. If so, and if there
        are no shapes, `observed` gives frequencies only.
    by_shape : bool
        Whether modes are paired by MAC, not by number.
    solves_per_gradient, solves_per_shape_gradient : int
        Cost of `frequencies_and_gradient`, and of `observed` with derivatives, at one theta, in solves: 1 if
        derivatives are exact.
    full_solves : int
        Number of solves of the true model so far, if a reduced basis replaces it; otherwise 0.
    n_tests : int
        Number of tests for which the model is solved at one theta.
    """

    n_parameters: int
    n_modes: int
    n_tests = 1
    name = "model"
    structure: SeparableModel | None = None
    functions: tuple[BlackBoxModel, ...] = ()
    full_blocks: tuple[FullBlock, ...] = ()
    gives_shapes = False
    gives_shape_curvature = False
    has_exact_curvature = False
    is_soft = False
    is_uncertain = False
    by_shape = False
    solves_per_gradient = 1
    solves_per_shape_gradient = 1
    full_solves = 0
    certificate: Certificate | None = None
    """Errors that are known before a run, if the model is an approximation."""
    sizes: tuple[int, ...] = ()
    """Number of unknowns of each reduced block; empty if the model is not reduced."""

    @property
    def truth(self) -> ModalModel:
        """The true model if this model approximates one, otherwise the model itself."""
        return self

    @property
    def parts(self) -> tuple[ModalModel, ...]:
        """The models that are solved for the tests; only the model itself if it describes a single test."""
        return (self,)

    @property
    def reasons(self) -> Sequence[Failure]:
        """The first failures of a user's function, each with its theta and reason."""
        return ()

    def sees(self, sensor: Dof) -> bool:
        """Return True if the model can have a sensor at this (place, direction).

        A model without a list of sensors accepts any sensor.
        """
        return True

    @contextmanager
    def spread_over(self, engine: Engine | None) -> Iterator[None]:
        """Within a ``with`` block, let an engine's workers call user functions and solve large matrices.

        Without an engine, nothing changes.
        """
        with ExitStack() as stack:
            if engine is not None:
                for function in self.functions:
                    stack.enter_context(function.spread_over(engine))
                for part in self.parts:
                    for block in part.truth.full_blocks:
                        stack.enter_context(block.spread_over(engine))
            yield

    def seconds_at(self, theta: FloatArray) -> float | None:
        """Return the time in s that the user's function takes at theta (n_parameters,).

        Return None if there is no function. The function may be called at theta; see `BlackBoxModel.seconds_at`.
        """
        return self.functions[0].seconds_at(theta) if self.functions else None

    def reason_at(self, theta: FloatArray) -> str | None:
        """Return why a user's function failed at theta (n_parameters,), or None if the reason is unknown."""
        return None

    @property
    def test_of_modes(self) -> IntArray:
        """Index of each measured mode's test, shape (n_modes,)."""
        return np.zeros(self.n_modes, dtype=np.int64)

    def matrices_of(self, k: int) -> tuple[SeparableModel, int] | None:
        """Return the structure that parameter `k` changes and the parameter's index there.

        Return None if the model has no matrices, or if `k` is not one of its parameters.
        """
        return None if self.structure is None or k >= self.n_parameters else (self.structure, k)

    def failed_tests(self, theta: FloatArray) -> Iterator[tuple[str, ModalModel, FloatArray]]:
        """Yield the name, model and own parameters of each test without frequencies at theta (n_parameters,).

        A model for a single test yields nothing. Every test with a user's function is yielded, because only the
        function knows where it has failed.
        """
        yield from ()

    def coarser(self, share: float) -> Self:
        """Return a cheaper model that uses a share of the reduced basis, or itself if the model is not reduced."""
        return self

    def of_modes(self, theta: FloatArray, of: Callable[[Any, FloatArray], FloatArray]) -> FloatArray:
        """Call `of` with each structure and its own parameters, and return the values for each measured mode.

        Parameters
        ----------
        theta : ndarray, shape (n, ndim)
            Other parameters may follow the model's parameters.
        of : callable
            ``of(structure, parameters)`` returns an array (n, modes, …).

        Returns
        -------
        ndarray, shape (n, n_modes, …)
        """
        return of(self, theta[:, : self.n_parameters])

    def frequencies(self, theta: FloatArray) -> FloatArray:
        """Return frequencies in Hz, (n, n_modes), at theta (n, n_parameters), with NaN where a solve failed."""
        raise NotImplementedError

    def in_test(self, test: int) -> tuple[ModalModel, IntArray]:
        """Return the model of one test, and the indices of its parameters among the structural parameters."""
        return self, np.arange(self.n_parameters)

    def frequencies_of_test(self, test: int, values: FloatArray) -> FloatArray:
        """Return one test's frequencies in Hz, (n, m), for its m measured modes.

        `values`, shape (n, n_structural), are the structural parameters in this test.
        """
        return self.frequencies(values)

    def frequencies_and_gradient(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return frequencies in Hz, shape (n, n_modes), and their gradients, shape (n, n_modes, n_parameters)."""
        raise NotImplementedError

    def gives_curvature(self, shapes: bool) -> bool:
        """Return True if `sensitivities` gives second derivatives of frequencies and, if `shapes`, of shapes."""
        return not self.is_uncertain and (self.gives_shape_curvature or not shapes)

    def sensitivities(self, theta: FloatArray, steps: Steps, shapes: bool = False) -> Sensitivities:
        """Return frequencies, gradients, and second derivatives along directions that are given later.

        The result's `gradient` has shape (n, n_modes, n_parameters). Its method ``curvature(d)``, with d of the
        same shape, returns H_i d_i for each mode i, where H_i is the matrix of second derivatives of frequency i.
        For structures given by matrices, both come from one eigenproblem. By default, the second derivatives are
        differences of gradients, at a cost of 2 n_modes more gradients per theta.

        Parameters
        ----------
        theta : ndarray, shape (n, n_parameters)
        steps : Steps
            Sizes and bounds of the parameters, which limit the difference steps.
        shapes : bool
            Whether to compute shapes at the sensors too. Requires `gives_shape_curvature`.
        """
        return SensitivitiesByDifferences(self.frequencies_and_gradient, theta, steps)

    def observed(self, theta: FloatArray, gradient: bool = False) -> ModalPrediction:
        """Return the predicted frequencies and sensor shapes at theta (n, n_parameters).

        Derivatives are included if `gradient`.
        """
        raise NotImplementedError

    def configuration(self) -> Any:
        """Return data that identify the model, as plain Python types."""
        raise NotImplementedError


class PartialModel(ModalModel):
    """A model restricted to some of its modes and sensors.

    Parameters
    ----------
    whole : ModalModel
    modes, rows : sequence of int
        Indices of the modes and sensors that are kept.
    """

    def __init__(self, whole: ModalModel, modes: Sequence[int], rows: Sequence[int]) -> None:
        self.whole, self.name, self.structure = whole, whole.name, whole.structure
        self.functions, self.by_shape = whole.functions, whole.by_shape
        self.n_parameters, self.n_modes = whole.n_parameters, len(modes)
        self.gives_shapes = whole.gives_shapes
        self.solves_per_gradient = whole.solves_per_gradient
        self.solves_per_shape_gradient = whole.solves_per_shape_gradient
        self._modes, self._rows = list(modes), list(rows)

    @property
    def reasons(self) -> Sequence[Failure]:
        """Failures that the whole model has recorded."""
        return self.whole.reasons

    def reason_at(self, theta: FloatArray) -> str | None:
        """Return why the whole model failed at theta (n_parameters,), or None if the reason is unknown."""
        return self.whole.reason_at(theta)

    def frequencies(self, theta: FloatArray) -> FloatArray:
        """Return frequencies in Hz, shape (n, n_modes), with NaN where a solve failed."""
        return self.whole.frequencies(theta)[:, self._modes]

    def frequencies_and_gradient(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return frequencies in Hz, shape (n, n_modes), and their gradients, shape (n, n_modes, n_parameters)."""
        frequencies, gradient = self.whole.frequencies_and_gradient(theta)
        return frequencies[:, self._modes], gradient[:, self._modes]

    def observed(self, theta: FloatArray, gradient: bool = False) -> ModalPrediction:
        """Return the predicted frequencies and sensor shapes at theta (n, n_parameters), without variances.

        Derivatives are included if `gradient`.
        """
        seen = self.whole.observed(theta, gradient)
        f, df = seen.frequencies[:, self._modes], seen.frequency_slopes
        phi, dphi = seen.shapes[:, self._rows][:, :, self._modes], seen.shape_slopes
        if df is None or dphi is None:
            return ModalPrediction(f, phi)
        return ModalPrediction(f, phi, df[:, self._modes], dphi[:, self._rows][:, :, self._modes])

    def configuration(self) -> dict[str, object]:
        """Return data that identify the model, as plain Python types."""
        return {"whole": self.whole.configuration(), "modes": self._modes, "rows": self._rows}


class GivenModel(ModalModel):
    """Adapter that turns a user's own `FrequencyMap` into a `ModalModel`.

    Optional attributes that the user's model lacks have their default values.
    """

    def __init__(self, given: Any, n_sensors: int) -> None:
        self.given, self.n_sensors = given, n_sensors
        self.n_parameters, self.n_modes = given.n_parameters, given.n_modes
        self.name = type(given).__name__
        self.gives_shapes = hasattr(given, "observed") and getattr(given, "gives_shapes", True)
        self.solves_per_gradient = int(getattr(given, "solves_per_gradient", 1))
        self.solves_per_shape_gradient = self.solves_per_gradient

    def __repr__(self) -> str:
        return repr(self.given)

    @property
    def reasons(self) -> Sequence[Failure]:
        """Failures that the user's model has recorded."""
        return getattr(self.given, "reasons", ())

    def frequencies(self, theta: FloatArray) -> FloatArray:
        """Return the frequencies of the user's model in Hz, shape (n, n_modes).

        Raise ValueError if the user's method raises an exception or returns a wrong array.
        """
        return self._real("frequencies", self._call("frequencies", theta), (len(theta), self.n_modes))

    def frequencies_and_gradient(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the user's frequencies in Hz, (n, n_modes), and gradients, (n, n_modes, n_parameters).

        Raise ValueError if the user's method raises an exception or does not return a tuple of two arrays of these
        shapes.
        """
        method, shape = "frequencies_and_gradient", (len(theta), self.n_modes)
        given = self._call(method, theta)
        if not (isinstance(given, tuple) and len(given) == 2):
            raise ValueError(f"model: {self.name}.{method} must return two arrays (got {type(given).__name__})")
        return self._real(method, given[0], shape), self._real(method, given[1], (*shape, self.n_parameters))

    def _call(self, method: str, theta: FloatArray, *others: object) -> Any:
        try:
            return getattr(self.given, method)(theta, *others)
        except Exception as error:
            raise ValueError(
                f"model: {self.name}.{method} must return NaN where a solve fails, and not raise "
                f"(got {in_words(error)}, at {theta[:1].tolist()})"
            ) from error

    def _real(self, method: str, given: Any, shape: tuple[int, ...]) -> FloatArray:
        array = np.asarray(given)
        if array.shape != shape or array.dtype.kind not in "fiu":
            raise ValueError(
                f"model: {self.name}.{method} must return real numbers of shape {shape} "
                f"(got {array.dtype} of shape {array.shape})"
            )
        return array.astype(float, copy=False)

    def observed(self, theta: FloatArray, gradient: bool = False) -> ModalPrediction:
        """Return the user's prediction at the sensors.

        Raise ValueError if the user's method raises an exception, or does not return a `ModalPrediction` with
        arrays of the right shapes.
        """
        given = self._call("observed", theta, gradient)
        if not isinstance(given, ModalPrediction):
            raise ValueError(
                f"model: {self.name}.observed must return a ModalPrediction (got {type(given).__name__})"
            )
        of_frequencies, of_shapes = (len(theta), self.n_modes), (len(theta), self.n_sensors, self.n_modes)
        parts: dict[str, tuple[int, ...]] = {"frequencies": of_frequencies, "shapes": of_shapes}
        if gradient:
            parts["frequency_slopes"] = (*of_frequencies, self.n_parameters)
            parts["shape_slopes"] = (*of_shapes, self.n_parameters)
        return replace(
            given,
            **{name: self._real(f"observed(…).{name}", vars(given)[name], shape) for name, shape in parts.items()},
        )

    def configuration(self) -> Any:
        """Return the configuration of the user's model, or its class name if it has none."""
        describe = getattr(self.given, "configuration", None)
        return describe() if callable(describe) else f"{type(self.given).__module__}.{self.name}"


def as_modal_model(given: ModalModel | FrequencyMap, n_sensors: int = 0) -> ModalModel:
    """Return a `ModalModel` unchanged, or wrap a user's own model as one.

    If a user's model gives shapes, they must be at the `n_sensors` sensors at which shapes were measured.
    """
    return given if isinstance(given, ModalModel) else GivenModel(given, n_sensors)


Model = SeparableModel | BlackBoxModel | ModalModel | FrequencyMap
"""Models that a problem accepts. The modes of a `SeparableModel` or `BlackBoxModel` are not paired yet."""
