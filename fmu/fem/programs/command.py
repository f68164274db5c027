"""Finite-element programs run by a command: for each theta, fill in a deck, run the program and read its results.

Each run has its own folder, which contains the deck and the other inputs. The results are stored
(`fmu.fem.programs.store`) under a hash of the parameter names, the template, the command, the inputs, the sensors
and the settings of the reader. A stored theta is not solved again, with two exceptions: every process solves the
starting point once to check the store, and a run that exceeded its time limit is repeated if the limit is raised.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np

from fmu.arguments import ArgumentError, check_arguments
from fmu.durable_files import digest
from fmu.fem.black_box import BlackBoxModel
from fmu.fem.programs.answers import AnswerError
from fmu.fem.programs.deck_run import DeckRun
from fmu.fem.programs.found_frequencies import FoundFrequencies, wrong_words
from fmu.fem.programs.program_run import ProgramRun
from fmu.fem.programs.solves import Solves
from fmu.fem.programs.store import SolveStore
from fmu.formats.decks import braces_of, rounded_values
from fmu.formats.modes import READERS
from fmu.formats.modes.measured_modes import is_node
from fmu.formats.shown import quote
from fmu.types import Dof, FloatArray

STEP = 1e-3
"""Central-difference step: large, because decks and results often have only seven significant figures."""


class CommandError(ValueError):
    """Raised for invalid arguments to `CommandModel`. Its attribute `mistakes` lists all of them."""

    def __init__(self, mistakes: Sequence[ArgumentError]) -> None:
        self.mistakes = tuple(mistakes)
        super().__init__(self.mistakes)

    def __str__(self) -> str:
        return "; ".join(map(str, self.mistakes))


@check_arguments
class CommandModel(BlackBoxModel):
    """A structure solved by an external program: ``fmu.UpdatingProblem(fmu.CommandModel(…), data, parameters)``.

    Parameters
    ----------
    names : sequence of str
        Parameter names in the order of theta. Each has a placeholder in the template, such as ``{E1}``.
    template : path
        Template of the input deck, relative to `folder`. A placeholder may have one of the formats in
        `fmu.formats.decks`, such as ``{E1:.9e}``. Central differences allow for the rounding: each is divided by
        the distance between the rounded values in the two decks, and the step is at least four units of the last
        digit. The filled deck has the name of the template, without ``.in`` at the end.
    command : sequence of str
        The program and its arguments, with ``{job}`` and ``{deck}`` for the deck's name without and with its
        suffix. They are not passed through a shell.
    frequencies : FoundFrequencies, optional
        How to find the frequencies in a text file written by the program.
    reader : str, optional
        One of `fmu.formats.modes.READERS`, given instead of `frequencies`. It reads the frequencies, and the
        shapes at the sensors, from a result file of the program.
    result : str, optional
        The file for the reader, with ``{job}`` and ``{deck}``. Defaults to the usual file for this reader, such as
        ``{job}.f06``.
    inputs : sequence of str
        Other files that the program needs, relative to `folder`. They are copied to the folder of each run.
        Files that a Nastran template in `folder` includes are added.
    timeout : float
        Time limit for a run, in seconds.
    retries : int
        How often a failed run is repeated.
    keep : bool
        Whether to keep the folders of all runs. Otherwise only the folders of up to twenty failed runs are kept.
    store : path
        Folder in which solves are stored, relative to `folder`.
    step : float
        See `BlackBoxModel`.
    folder : path
        Folder that `template`, `inputs`, `store` and a program given as a path are relative to.

    Attributes
    ----------
    solves : SolveStore
        Stored solves from this run and earlier ones.

    Raises
    ------
    CommandError
        A ValueError that lists all invalid arguments: for example a template that lacks the placeholder of a
        parameter, or a program or file that does not exist.
    ValueError
        If an argument has the wrong type, or `step` is out of range.
    """

    place = "model.command"

    def __init__(
        self,
        names: Sequence[str],
        template: str | Path,
        command: Sequence[str],
        *,
        frequencies: FoundFrequencies | None = None,
        reader: str | None = None,
        result: str | None = None,
        inputs: Sequence[str] = (),
        timeout: float = 600.0,
        retries: int = 0,
        keep: bool = False,
        store: str | Path = "solves",
        step: float = STEP,
        folder: str | Path = ".",
    ) -> None:
        self.folder = Path(folder).resolve()
        self.names, self.command = tuple(names), tuple(command)
        self.found, self.reader, self.result = frequencies, reader, result
        self.retries, self.keep = retries, keep
        self.run, wrong = DeckRun.of(self.names, template, self.command, inputs, timeout, self.folder)
        wrong = self._of_options() + wrong
        if wrong:
            raise CommandError(wrong)
        self._braces = braces_of(self.run.template)
        self._key = {
            "parameters": list(self.names),
            "template": digest(self.run.template.encode("utf-8", "surrogateescape")),
            "command": list(self.command),
            "frequencies": None if frequencies is None else asdict(frequencies),
            "reader": reader,
            "inputs": self.run.contents(),
            **({} if result is None else {"result": result}),
        }
        self._stored_in = self.folder / store
        super().__init__(
            self._describe_run(), len(self.names), step=step, name=f"{self.command[0]} {self.run.deck}"
        )

    def sees(self, sensor: Dof) -> bool:
        """Return True if the reader gives shapes at a sensor (place, direction), or if there is no reader."""
        if self.reader is None:
            return True
        form = READERS[self.reader]
        has_place = is_node(sensor[0]) or not form.has_numbers
        return has_place and sensor[1].removeprefix("-") in form.directions

    def at_sensors(self, sensors: Sequence[Dof]) -> CommandModel:
        """Return a copy that gives shapes at these sensors.

        Return the model itself if it already gives them, or has no reader for shapes.
        """
        if self.reader is None or tuple(sensors) == self.sensors:
            return self
        return self._copy_with(tuple(sensors))

    def round_values(self, theta: FloatArray) -> FloatArray:
        """Return theta (n, n_parameters) as the filled deck contains it, rounded to the placeholders' digits."""
        rows = [dict(zip(self.names, row, strict=True)) for row in theta.tolist()]
        return np.array([[*rounded_values(self._braces, row).values()] for row in rows]).reshape(theta.shape)

    def configuration(self) -> dict[str, object]:
        """Return data that identify the model, such as hashes of its files, the command and the reader."""
        return {"function": self.name, "batched": False, "step": self.step, **self._key}

    def _store(self) -> SolveStore:
        key = repr([*self._key.items(), self.sensors])
        return SolveStore(self._stored_in / f"{self.run.deck.stem}-{digest(key.encode())[:12]}")

    def _describe_run(self) -> ProgramRun:
        given = (self.run, self.names, self.found, self.reader, self.result, self.keep, self.sensors)
        return ProgramRun(*given, self._store())

    def _begin_solves(self) -> Solves:
        run: ProgramRun = self.function  # type: ignore[assignment]
        return Solves(
            run,
            self.n_parameters,
            store=run.store,
            least_s=0.0,
            loading_s=0.0,
            retries=self.retries,
            lasting=AnswerError,
            is_outdated=run.is_outdated,
        )

    def _of_options(self) -> list[ArgumentError]:
        """Return the errors in those arguments that can be checked without reading a file."""
        wrong = []
        if (self.found is None) == (self.reader is None):
            wrong.append(ArgumentError("frequencies", "must be given, or a reader instead"))
        if self.reader is not None and self.reader not in READERS:
            wrong.append(ArgumentError("reader", f"must be one of {', '.join(READERS)}", quote(self.reader)))
        if self.result is not None and self.reader is None:
            wrong.append(ArgumentError("result", "must not be given without a reader"))
        wrong += wrong_words("result", self.result or "")
        if not 0 <= self.retries <= 100:
            wrong.append(ArgumentError("retries", "must be from 0 to 100", self.retries))
        return wrong
