"""Models given by a user's function: a surrogate, or a finite-element program called from Python.

The contract
------------
``function(theta)`` takes theta, an ndarray of shape (ndim,) in SI units, in the order of the parameters. It gives

- the natural frequencies in Hz, shape (n,), of any number of the model's modes; or
- ``{"frequencies": (n,), "shapes": (n_sensors, n), "gradient": (n, ndim)}``: only the first is required; or
- a tuple of these in that order, None for what is missing.

``shapes`` are mode shapes at the sensors of the measurement, in any scale: with them, and with measured ones, each
measured mode is paired with a computed one by MAC; otherwise by its number (from 1) in the order returned.
``gradient`` is ∂f/∂θ in Hz per SI unit; without it central differences are taken, which cost 2 ndim more calls.

For a batched function theta has the shape (n_points, ndim), and all results have a leading axis of n_points.

If the function raises, or returns numbers that are not finite, that point has failed and the run continues;
`BlackBoxModel.reasons` says why.
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
from fmu.fem.programs.sources import source_digest
from fmu.fem.programs.store import Solve, SolveStore
from fmu.types import Dof, FloatArray


def solves_of_a_surrogate(n_parameters: int) -> int:
    """Return how many solves a surrogate takes at most by default, and so the search of a slow function."""
    return 100 + 50 * n_parameters


@check_arguments
class BlackBoxModel:
    """A structure as a function from theta to its frequencies; `fmu.fem.black_box` has the contract.

    ``fmu.UpdatingProblem(fmu.BlackBoxModel(function, 2), data, parameters)`` pairs its modes with those measured.

    Parameters
    ----------
    function : callable
        theta (n_parameters,) -> frequencies in Hz; or with shapes and gradients too.
    n_parameters : int
    batched : bool
        Whether it takes theta (n_points, n_parameters), and returns arrays with a leading axis.
    step : float
        Step of the central differences, relative to the scale of each parameter (its range, where it has one).
    name : str, optional
        Name used where a problem is described.
    store : path-like, optional
        Folder of what was solved. Answers that took `SLOW_S` or longer are kept there, and none of them is
        computed twice, in this run or another; of a batched function, those whose call took so long per point.
        They are kept under a hash of the function's source file and of the user's own modules that it imports
        (`fmu.fem.programs.sources`). What else it depends on, such as data files, is not known: when a problem
        is built, the function is called at the start, and must give what is stored there (`at`).

    Attributes
    ----------
    solved : Solves
        What was solved: no theta is called twice in a process.
    solves : SolveStore or None
        What was solved, in this run and others, if there is a store.
    reasons : list of Failure
        The first twenty points at which the function failed.

    Raises
    ------
    ValueError
        If the function cannot be called, or a number is out of range.
    """

    place = "model.function"
    """The key of problem files that is named where the function fails."""
    sensors: tuple[Dof, ...] = ()
    """Where its shapes are, if that can be chosen."""

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
        if self._folder is not None and not self.configuration().get("sha256"):
            raise ArgumentError(
                "store", "the function must be in a file, so that a change of it is noticed (it is not)"
            )
        self.solved = self._begin_solves()

    def __repr__(self) -> str:
        return f"BlackBoxModel({self.name}, {self.n_parameters} parameters)"

    def sees(self, sensor: Dof) -> bool:
        """Return True for every sensor (place, direction): only the function knows where its shapes are."""
        return True

    def at_sensors(self, sensors: Sequence[Dof]) -> BlackBoxModel:
        """Return the model with shapes at these sensors: itself, as its function gives shapes there."""
        return self

    @property
    def solves(self) -> SolveStore | None:
        """What was solved, in this run and others; None if there is no store."""
        return self.solved.store

    @property
    def reasons(self) -> list[Failure]:
        """The first points at which the function failed, and why."""
        return self.solved.reasons

    def seconds_at(self, theta: FloatArray) -> float:
        """Return the seconds that a call at theta (n_parameters,) takes, see `Solves.seconds_at`."""
        return self.solved.seconds_at(theta)

    def solve(self, theta: FloatArray) -> Solve:
        """Return the solve at theta (n_parameters,): remembered, from the store, or by calling the function."""
        return self.solved.of(np.asarray(theta, dtype=float)[None])[0]

    def answers(self, theta: FloatArray) -> list[Answer | None]:
        """Return the function's answers at theta (n, n_parameters), None where it fails; see `reasons`."""
        return [None if solve.reason else _answer_of(solve) for solve in self.solved.of(theta)]

    @contextmanager
    def spread_over(self, engine: Engine) -> Iterator[BlackBoxModel]:
        """Within a with block, call the function at several theta in parallel, in the workers of an engine.

        Answers and failures are the same as in the calling process, in the same order. A theta that crashes its
        process three times has failed for that reason. A batched function gets all theta in one call and is not
        spread.

        Parameters
        ----------
        engine : Engine
            See `fmu.engine`. The function is sent to the workers: one of a module by its name, others by value.

        Examples
        --------
        ``with fmu.engine(workers=8) as engine, model.spread_over(engine): fmu.find_map(problem)``
        """
        with self.solved.spread_over(engine):
            yield self

    def at(self, theta: FloatArray) -> Answer:
        """Return the function's answer at one theta, shape (n_parameters,), where a problem starts.

        See `Solves.at_start`, which also says what it raises and warns of.
        """
        return _answer_of(self.solved.at_start(np.asarray(theta, dtype=float)))

    def reason_at(self, theta: FloatArray) -> str | None:
        """Return why a theta (n_parameters,) failed; None if it did not, or it is no longer remembered."""
        solve = self.solved.recall(theta)
        return None if solve is None else solve.reason or None

    def configuration(self) -> dict[str, object]:
        """Return the data that identify the model: the function's name, and a hash of its source."""
        return {"function": self.name, "batched": self.batched, "step": self.step, "sha256": self.sha256}

    @cached_property
    def sha256(self) -> str:
        """Hash of the user's source, see `source_digest`; a copy in another process has the same hash."""
        return source_digest(self.function)

    def _copy_with(self, sensors: tuple[Dof, ...]) -> Self:
        """Return a copy with shapes at these sensors, of which no solve is made."""
        changed = copy(self)
        changed.sensors = sensors
        changed.function = changed._describe_run()
        changed.solved = changed._begin_solves()
        return changed

    def _describe_run(self) -> Callable[[FloatArray], object]:
        """Return the function with shapes at the model's sensors."""
        return self.function

    def _begin_solves(self) -> Solves:
        """Return the solves of the function, none of which is made."""
        return Solves(self.function, self.n_parameters, batched=self.batched, store=self._store())

    def _store(self) -> SolveStore | None:
        """Return the store of solves under everything that they depend on; None without a folder."""
        if self._folder is None:
            return None
        key = self.configuration() | {"step": None, "batched": None, "sensors": self.sensors}
        words = "".join(c if c.isalnum() else "-" for c in self.name)
        return SolveStore(self._folder / f"{words}-{digest(repr([*key.items()]).encode())[:12]}")


def _answer_of(solve: Solve) -> Answer:
    return Answer(solve.frequencies, solve.shapes, solve.gradient)


def _name_of(function: object) -> str:
    return str(getattr(function, "__qualname__", type(function).__qualname__))
