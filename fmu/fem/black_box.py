"""Models given by a user's Python function, such as a surrogate or a call to a finite-element program.

The contract
------------
``function(theta)`` takes theta, an ndarray of shape (ndim,) in SI units, in the order of the parameters. The
function returns

- the natural frequencies in Hz, shape (n,), of any number of the model's modes; or
- a dict ``{"frequencies": (n,), "shapes": (n_sensors, n), "gradient": (n, ndim)}``, in which only the frequencies
  are required; or
- a tuple of these arrays in the same order, with None for a missing array.

``shapes`` are mode shapes at the sensors of the measurement, in any scale. If the function returns shapes and
shapes were measured, each measured mode is by default paired with a computed mode by MAC. Otherwise each measured
mode is paired by its number (from 1) in the order returned. ``gradient`` is ∂f/∂θ in Hz per SI unit; without a
gradient, central differences are used, which take 2 ndim more calls.

For a batched function theta has the shape (n_points, ndim), and all results have a leading axis of n_points.

If the function raises an exception or returns an invalid result, such as NaN for the frequency of a measured mode,
the point counts as failed and the run continues; `BlackBoxModel.reasons` gives the reasons. At the starting point,
a failure is an error.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from copy import copy
from functools import cached_property
from pathlib import Path
from typing import Annotated, Self

import numpy as np
from annotated_types import Interval

from fmu.arguments import ArgumentError, Count, check_arguments
from fmu.durable_files import digest
from fmu.engines.base import Engine
from fmu.fem.programs.answers import Answer
from fmu.fem.programs.solves import Failure, Solves
from fmu.fem.programs.sources import source_digest, unknown_value
from fmu.fem.programs.store import Solve, SolveStore
from fmu.types import Dof, FloatArray


def solves_of_a_surrogate(n_parameters: int) -> int:
    """Return the default limit on the number of solves for building a surrogate.

    If the function is slow, this number also limits the search for the posterior maxima.
    """
    return 100 + 50 * n_parameters


@check_arguments
class BlackBoxModel:
    """A structure given by a function from theta to its frequencies; see `fmu.fem.black_box` for the contract.

    ``fmu.UpdatingProblem(fmu.BlackBoxModel(function, 2), data, parameters)`` pairs the function's modes with the
    measured modes.

    Parameters
    ----------
    function : callable
        Maps theta (n_parameters,) to frequencies in Hz, optionally with shapes and gradients.
    n_parameters : int
    batched : bool
        Whether the function takes theta (n_points, n_parameters) and returns arrays with a leading axis of
        n_points.
    step : float
        Step of the central differences, relative to the scale of each parameter (its range, if it has one).
    name : str, optional
        Name used in descriptions of a problem.
    store : path-like, optional
        Folder for results. Results that took `fmu.fem.programs.solves.SLOW_S` seconds or longer (per point, if the
        function is batched) are stored there and reused, in this run and in others. They are stored under a hash
        of the function's source file, of the user's own modules that it imports, and of its place in the file and
        the values that it holds, such as variables of enclosing functions (`fmu.fem.programs.sources`). The hash
        does not detect changes in other dependencies, such as data files. Therefore, when a problem is
        built, the function is called at the starting point, and must reproduce the result that is stored for this
        point (`at`).

    Attributes
    ----------
    solved : Solves
        Solves made in this process. The function is normally not called twice at the same theta.
    solves : SolveStore or None
        Stored solves from this run and others; None if there is no store.
    reasons : list of Failure
        The first twenty failures of the function.

    Raises
    ------
    ValueError
        If the function is not callable, a number is out of range, or a store is given and the function is not in a
        file or holds a value whose changes are not noticed, such as the object of a bound method.
    """

    place = "model.function"
    """Problem file key that is named in messages when the function fails."""
    sensors: tuple[Dof, ...] = ()
    """Sensors (place, direction) at which the function gives shapes, if they can be chosen."""

    def __init__(
        self,
        function: Callable[[FloatArray], object],
        n_parameters: Count,
        *,
        batched: bool = False,
        step: Annotated[float, Interval(gt=0.0, le=0.1)] = 1e-4,
        name: str | None = None,
        store: str | os.PathLike[str] | None = None,
    ) -> None:
        self.function = function
        self.n_parameters = int(n_parameters)
        self.batched = batched
        self.step = step
        self.name = name or _name_of(function)
        self._folder = None if store is None else Path(store).resolve()
        if self._folder is not None:
            rule = "" if self.sha256 else "must be in a file, so that a change of it is noticed (it is not)"
            if not rule and (held := unknown_value(self._source)):
                rule = f"must hold only values whose changes are noticed, such as arrays (it holds: {held})"
            if rule:
                raise ArgumentError("store", f"the function {rule}")
        self.solved = self._begin_solves()

    def __repr__(self) -> str:
        return f"BlackBoxModel({self.name}, {self.n_parameters} parameters)"

    def sees(self, sensor: Dof) -> bool:
        """Return True for every sensor (place, direction), because only the function knows its sensors."""
        return True

    def at_sensors(self, sensors: Sequence[Dof]) -> BlackBoxModel:
        """Return the model itself, because its function already gives shapes at these sensors."""
        return self

    @property
    def solves(self) -> SolveStore | None:
        """Stored solves from this run and others, or None if there is no store."""
        return self.solved.store

    @property
    def reasons(self) -> list[Failure]:
        """The first failures of the function, each with its theta and reason."""
        return self.solved.reasons

    def seconds_at(self, theta: FloatArray) -> float:
        """Return the duration of a call at theta (n_parameters,), in seconds; see `Solves.seconds_at`."""
        return self.solved.seconds_at(np.asarray(theta, dtype=float))

    def solve(self, theta: FloatArray) -> Solve:
        """Return the solve at theta (n_parameters,).

        It comes from memory, from the store, or from calling the function.
        """
        return self.solved.of(np.asarray(theta, dtype=float)[None])[0]

    def answers(self, theta: FloatArray) -> list[Answer | None]:
        """Return the function's results at theta (n, n_parameters), with None where it fails; see `reasons`."""
        return [
            None if solve.reason else _answer_of(solve) for solve in self.solved.of(np.asarray(theta, dtype=float))
        ]

    def round_values(self, theta: FloatArray) -> FloatArray:
        """Return theta (n, n_parameters) as the function receives it.

        It is theta itself, unless an input deck has fewer digits.
        """
        return theta

    @contextmanager
    def spread_over(self, engine: Engine) -> Iterator[BlackBoxModel]:
        """Within a ``with`` block, let an engine's workers call the function at several theta in parallel.

        Results and failures are the same, and in the same order, as without workers. A theta that crashes its
        process three times counts as failed. A batched function receives all theta in one call, so it is not
        distributed. In workers the variables `fmu.engines.blas.THREADS` are 1 unless the user has set them; a
        function that starts programs with several threads should set them itself.

        Parameters
        ----------
        engine : Engine
            See `fmu.engine`. A function defined in a module is sent to the workers by name, any other function by
            value.

        Examples
        --------
        ``with fmu.engine(workers=8) as engine, model.spread_over(engine): fmu.find_map(problem)``
        """
        with self.solved.spread_over(engine):
            yield self

    def at(self, theta: FloatArray) -> Answer:
        """Return the function's result at theta (n_parameters,), which is the problem's starting point.

        See `Solves.at_start` for the errors that it raises and the warnings that it gives.
        """
        return _answer_of(self.solved.at_start(np.asarray(theta, dtype=float)))

    def reason_at(self, theta: FloatArray) -> str | None:
        """Return why the solve at theta (n_parameters,) failed.

        Return None if it succeeded or is not in memory.
        """
        solve = self.solved.recall(np.asarray(theta, dtype=float))
        return None if solve is None else solve.reason or None

    def configuration(self) -> dict[str, object]:
        """Return data that identify the model: its function's name, options and source hash."""
        return {"function": self.name, "batched": self.batched, "step": self.step, "sha256": self.sha256}

    @cached_property
    def sha256(self) -> str:
        """Hash of the user's function; see `source_digest`. It is empty if the function is not in a file."""
        return source_digest(self._source)

    @property
    def _source(self) -> Callable[..., object]:
        """The user's function, which determines the results."""
        return self.function

    def _copy_with(self, sensors: tuple[Dof, ...]) -> Self:
        """Return a copy of the model for shapes at other sensors. The copy has no solves in memory."""
        changed = copy(self)
        changed.sensors = sensors
        changed.function = changed._describe_run()
        changed.solved = changed._begin_solves()
        return changed

    def _describe_run(self) -> Callable[[FloatArray], object]:
        return self.function

    def _begin_solves(self) -> Solves:
        return Solves(self.function, self.n_parameters, batched=self.batched, store=self._store())

    def _store(self) -> SolveStore | None:
        """Return the store for solves, or None if no folder is given.

        The name of the store's folder contains a hash of the function's name and source code, and of the sensors.
        """
        if self._folder is None:
            return None
        key = self.configuration() | {"step": None, "batched": None, "sensors": self.sensors}
        words = "".join(c if c.isalnum() else "-" for c in self.name)
        return SolveStore(self._folder / f"{words}-{digest(repr([*key.items()]).encode())[:12]}")


def _answer_of(solve: Solve) -> Answer:
    return Answer(solve.frequencies, solve.shapes, solve.gradient)


def _name_of(function: object) -> str:
    return str(getattr(function, "__qualname__", type(function).__qualname__))
