"""Extraction of frequencies from a program's text file with a regular expression."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fmu.arguments import ArgumentError, check_arguments
from fmu.formats.files import too_large, why_no_file
from fmu.formats.shown import quote
from fmu.numbers import significant
from fmu.types import FloatArray

LARGEST_RESULT = 2**29
_WORD = re.compile(r"\{(\w+)\}")


def wrong_words(key: str, text: str) -> list[ArgumentError]:
    """Return an error for each unknown placeholder in `text`, which was given as the argument `key`."""
    rule = "may have {job} and {deck} in braces"
    return [ArgumentError(key, rule, f"{{{w}}}") for w in _WORD.findall(text) if w not in ("job", "deck")]


@check_arguments
@dataclass(frozen=True)
class FoundFrequencies:
    """Frequencies in a text file, found as numbers by a regular expression.

    Attributes
    ----------
    file : str
        Name of a file in the run's folder. ``{deck}`` is replaced by the deck's name, and ``{job}`` by that name
        without its suffix. The file ``output.txt`` contains the program's printed output.
    pattern : str
        Regular expression with one group, the frequency in Hz; ``^`` and ``$`` match at every line.

    Raises
    ------
    ValueError
        If the pattern is not a regular expression with one group, or the file's name has an unknown placeholder.
    """

    file: str
    pattern: str

    def __post_init__(self) -> None:
        try:
            groups = re.compile(self.pattern, re.MULTILINE).groups
        except (re.error, OverflowError, RecursionError) as error:
            raise ArgumentError(
                "pattern", f"must be a regular expression ({error}; got {quote(self.pattern)})"
            ) from None
        if groups != 1:
            raise ArgumentError("pattern", "must have one group, as (…), for the frequency", f"{groups} groups")
        for mistake in wrong_words("file", self.file):
            raise mistake

    def read(self, path: Path, seconds: float = 60.0) -> FloatArray:
        """Return the frequencies in a file, in Hz, shape (n,).

        Raise ValueError if the file cannot be read or is too large, the pattern has no match, a match is not a
        number, or the search fails or takes longer than `seconds`.
        """
        wrong = why_no_file(path) or too_large(path, LARGEST_RESULT)
        if wrong:
            raise ValueError(wrong)
        words = self._find(path, seconds)
        if not words:
            raise ValueError(f"{path.name} has nothing that the pattern {quote(self.pattern)} matches")
        return np.array([_number(word, path.name) for word in words])

    def _find(self, path: Path, seconds: float) -> list[str | None]:
        """Return the text of the pattern's group for each match in a file, or None where it did not take part.

        The search runs in a separate process, which is killed after `seconds`, because the search for some
        patterns practically never ends. Raise ArgumentError if the process is killed or fails.
        """
        command = [sys.executable, "-I", "-S", "-c", _MATCHING, str(path), self.pattern]
        try:
            done = subprocess.run(command, capture_output=True, timeout=seconds, check=True)
        except subprocess.TimeoutExpired:
            rule = f"must be matched within {significant(seconds)} s"
            raise ArgumentError(
                "pattern", f"{rule} in {path.name}", f"{quote(self.pattern)}, which took longer"
            ) from None
        except subprocess.CalledProcessError as error:
            raise ArgumentError(
                "pattern", f"cannot be matched in {path.name} (exit code {error.returncode})"
            ) from None
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
        raise ArgumentError(name, "the pattern must match numbers", quote(word)) from None
