"""What a model paired with the measured modes can do."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from typing import Any, Protocol, Self

import numpy as np

from fmu.engines.base import Engine
from fmu.fem.black_box import BlackBoxModel
from fmu.fem.certificates import Certificate
from fmu.fem.modes.separable import SeparableModel
from fmu.fem.pairing.prediction import ModalPrediction
from fmu.fem.programs.solves import Failure
from fmu.formats.shown import in_words
from fmu.types import Dof, FloatArray, IntArray


class FrequencyMap(Protocol):
    """What a model of the user's own has to be: a map from parameters to the frequencies of the measured modes.

    ``observed``, ``gives_shapes``, ``configuration``, ``solves_per_gradient`` and ``reasons`` are used as
    `ModalModel` describes them, where it has them.

    With `observed`, which returns a `fmu.fem.pairing.prediction.ModalPrediction`, shapes can have errors too.

    Attributes
    ----------
    n_parameters, n_modes : int
    """

    n_parameters: int
    n_modes: int

    def frequencies(self, theta: FloatArray) -> FloatArray:
        """Return frequencies in Hz, shape (n, n_modes), at theta (n, n_parameters); NaN where a solve failed."""
        ...

    def frequencies_and_gradient(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return frequencies (n, n_modes) and their gradients (n, n_modes, n_parameters)."""
        ...


class ModalModel:
    """A model whose modes are paired with the measured ones.

    The defaults are those of a model that gives frequencies with exact gradients, and nothing else.

    Attributes
    ----------
    n_parameters, n_modes : int
    name : str
        Name used where a problem is described.
    structure : SeparableModel or None
        The matrices behind it, if it is made of such.
    functions : tuple of BlackBoxModel
        The users' functions that answer; none of a model of another kind.
    gives_shapes : bool
        Whether `observed` tells what the sensors see.
    is_soft : bool
        Whether all candidates answer to every measured mode, with weights (`fmu.fem.pairing.rules.SoftPairing`).
    is_uncertain : bool
        Whether `observed` gives the variances of the model's own errors, as of a surrogate; it then gives
        frequencies alone where there are no shapes.
    by_shape : bool
        Whether modes are paired by MAC, not by number.
    solves_per_gradient, solves_per_shape_gradient : int
        What `frequencies_and_gradient` and `observed` with derivatives cost at one theta, in solves: 1 where
        derivatives are exact.
    full_solves : int
        How often the true model had to answer where there is a cheap one.
    n_tests : int
        For how many tests it is solved at one theta.
    """

    n_parameters: int
    n_modes: int
    n_tests = 1
    name = "model"
    structure: SeparableModel | None = None
    functions: tuple[BlackBoxModel, ...] = ()
    gives_shapes = False
    is_soft = False
    is_uncertain = False
    by_shape = False
    solves_per_gradient = 1
    solves_per_shape_gradient = 1
    full_solves = 0
    certificate: Certificate | None = None
    """What is known of its errors before a run, if it is an approximation."""
    sizes: tuple[int, ...] = ()
    """Unknowns of each block of a reduced model; empty if there is none."""

    @property
    def truth(self) -> ModalModel:
        """The model whose errors are none: the model itself, unless it is an approximation of another."""
        return self

    @property
    def parts(self) -> tuple[ModalModel, ...]:
        """The models that it consists of: itself, unless it answers for several tests."""
        return (self,)

    @property
    def reasons(self) -> Sequence[Failure]:
        """The first points at which a user's function failed, and why."""
        return ()

    def sees(self, sensor: Dof) -> bool:
        """Say whether there may be a sensor (place, direction): anywhere, unless the model knows better."""
        return True

    @contextmanager
    def spread_over(self, engine: Engine | None) -> Iterator[None]:
        """Within a with block, call users' functions in the workers of an engine, if there are any."""
        with ExitStack() as stack:
            for function in () if engine is None else self.functions:
                stack.enter_context(function.spread_over(engine))  # type: ignore[arg-type]
            yield

    def seconds_at(self, theta: FloatArray) -> float | None:
        """Return the seconds that a user's function takes at a theta (n_parameters,), None without one."""
        return self.functions[0].seconds_at(theta) if self.functions else None

    def reason_at(self, theta: FloatArray) -> str | None:
        """Return why a user's function gave no frequencies at theta (n_parameters,); None if not known."""
        return None

    @property
    def test_of_modes(self) -> IntArray:
        """The test that each measured mode is of, shape (n_modes,)."""
        return np.zeros(self.n_modes, dtype=np.int64)

    def matrices_of(self, k: int) -> tuple[SeparableModel, int] | None:
        """Return the matrices that parameter `k` of the structure changes, and its number there, or None."""
        return None if self.structure is None or k >= self.n_parameters else (self.structure, k)

    def failed_tests(self, theta: FloatArray) -> Iterator[tuple[str, ModalModel, FloatArray]]:
        """Yield the tests without frequencies at a theta (n_parameters,): name, model, and its own parameters.

        None of a model of one test. Of a user's function all are given: it knows where it has failed.
        """
        yield from ()

    def coarser(self, share: float) -> Self:
        """Return a cheaper and less accurate model, by a share of the reduced basis; itself if there is none."""
        return self

    def of_modes(self, theta: FloatArray, of: Callable[[Any, FloatArray], FloatArray]) -> FloatArray:
        """Apply `of` to each structure and its own parameters; return its values for every measured mode.

        Parameters
        ----------
        theta : ndarray, shape (n, ndim)
            Other parameters may follow those of the model.
        of : callable
            ``of(structure, parameters)`` returns an array (n, modes, …).

        Returns
        -------
        ndarray, shape (n, n_modes, …)
        """
        return of(self, theta[:, : self.n_parameters])

    def frequencies(self, theta: FloatArray) -> FloatArray:
        """Return frequencies in Hz, shape (n, n_modes), at theta (n, n_parameters); NaN where a solve failed."""
        raise NotImplementedError

    def frequencies_of_test(self, test: int, values: FloatArray) -> FloatArray:
        """Return frequencies in Hz of the measured modes of a test, at the parameters in it, (n, P)."""
        return self.frequencies(values)

    def frequencies_and_gradient(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return frequencies (n, n_modes) and their gradients (n, n_modes, n_parameters)."""
        raise NotImplementedError

    def observed(self, theta: FloatArray, gradient: bool = False) -> ModalPrediction:
        """Return frequencies and shapes at the sensors, at theta (n, n_parameters), with derivatives if wanted."""
        raise NotImplementedError

    def configuration(self) -> Any:
        """Return the data that identify the model, in plain Python types."""
        raise NotImplementedError


class GivenModel(ModalModel):
    """A user's own `FrequencyMap` as a `ModalModel`; anything that it does not define takes its default."""

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
        """The failures that the user's model has recorded."""
        return getattr(self.given, "reasons", ())

    def frequencies(self, theta: FloatArray) -> FloatArray:
        """Return the user's frequencies; ValueError if the method raises or returns something else."""
        return self._real("frequencies", self._call("frequencies", theta), (len(theta), self.n_modes))

    def frequencies_and_gradient(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the user's frequencies and gradients; ValueError as `frequencies` raises."""
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
        """Return the user's prediction at the sensors; ValueError as `frequencies` raises."""
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
        """Return the user's description, else the name of the class."""
        describe = getattr(self.given, "configuration", None)
        return describe() if callable(describe) else f"{type(self.given).__module__}.{self.name}"


def as_modal_model(given: ModalModel | FrequencyMap, n_sensors: int = 0) -> ModalModel:
    """Return a model that is already paired as a `ModalModel`.

    A user's own model is wrapped: its shapes have to be those at `n_sensors`, where shapes were measured.
    """
    return given if isinstance(given, ModalModel) else GivenModel(given, n_sensors)


Model = SeparableModel | BlackBoxModel | ModalModel | FrequencyMap
"""What a problem takes; the modes of matrices and of functions are yet to be paired with those measured."""
