"""Print messages on standard error: errors on one line without a traceback, and warnings from fmu as notes."""

from __future__ import annotations

import errno
import os
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NoReturn, TextIO

import click

from fmu.config import ConfigurationError
from fmu.engines.base import RunFailedError

FAILED, BAD_INPUT, DEPARTED = 1, 2, 3
"""Exit codes: the run failed or did not converge; the input is wrong; a new test departs from the earlier ones."""
STOPPED = 130  # what a shell reports for a command that Ctrl-C ended


class _Unbroken:
    """Wrapper of standard output that discards text once the program that reads it, such as ``head``, ends."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> object:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write text, or discard it if the reading program has ended."""
        try:
            self._stream.write(text)
        except BrokenPipeError:
            self._drop()
        return len(text)

    def flush(self) -> None:
        """Write buffered text, or discard it if the reading program has ended."""
        try:
            self._stream.flush()
        except BrokenPipeError:
            self._drop()

    def _drop(self) -> None:
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, self._stream.fileno())
        os.close(nowhere)


class Commands(click.Group):
    """A group of commands that end with an exit code and print expected errors without a traceback."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the command names in the order in which a user needs them."""
        return list(self.commands)

    def main(self, *args: Any, **kwargs: Any) -> NoReturn:
        """Run a command and exit with its code, even if the program that reads its output has ended."""
        if sys.stdout is sys.__stdout__ and sys.stdout is not None:
            sys.stdout = _Unbroken(sys.stdout)
        try:
            sys.exit(super().main(*args, **{**kwargs, "standalone_mode": False}))
        except click.exceptions.NoArgsIsHelpError as error:
            error.show()
            sys.exit(BAD_INPUT)
        except click.ClickException as error:
            _fail(error.format_message())
        except click.Abort:
            click.echo("Stopped.", err=True)
            sys.exit(STOPPED)
        except ConfigurationError as error:
            _fail(error.headline, *error.mistakes)
        except OSError as error:
            _fail(_of_system(error))
        except ValueError as error:
            _fail(str(error))
        except MemoryError as error:
            _fail(f"the model needs more memory than is available ({error or 'no details'})")
        except RunFailedError as error:
            _fail(str(error), code=FAILED)


def _of_system(error: OSError) -> str:
    """Return a system error's message or, if the disk is full, a sentence with the file's name and advice."""
    where = error.filename or "standard output, or a file of the output directory"
    if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        return (
            f"{where} could not be written: {error.strerror}. Free space, or raise the limit, and repeat the "
            "command; a run goes on with fmu run --resume"
        )
    return str(error)


def _fail(message: str, *mistakes: object, code: int = BAD_INPUT) -> NoReturn:
    """Print an error message on one line, followed by the first `mistakes` on one line each; then exit."""
    from fmu.formats.shown import list_mistakes, one_line

    click.echo(f"Error: {one_line(message)}", err=True)
    for line in list_mistakes(mistakes):
        click.echo(f"  {line}", err=True)
    sys.exit(code)


@contextmanager
def warnings_as_notes() -> Iterator[None]:
    """Print fmu's warnings (about old names, stores, rounding and so on) as notes, without the line of code."""
    from fmu.arguments import OldNameWarning
    from fmu.fem.programs.store import StoreWarning
    from fmu.posterior.reduction.train_reduced import ReductionWarning
    from fmu.posterior.rounding import RoundingWarning
    from fmu.runs.store import CheckpointWarning, OtherArithmeticWarning
    from fmu.surrogates.learning import SurrogateWarning

    notes = (
        CheckpointWarning, OldNameWarning, OtherArithmeticWarning, ReductionWarning, RoundingWarning,
        StoreWarning, SurrogateWarning,
    )  # fmt: skip

    show = warnings.showwarning

    def as_note(
        message: Warning | str,
        category: type[Warning],
        filename: str,
        lineno: int,
        file: TextIO | None = None,
        line: str | None = None,
    ) -> None:
        if issubclass(category, notes):
            click.echo(f"Note: {message}", err=True)
        else:
            show(message, category, filename, lineno, file, line)

    warnings.showwarning = as_note
    try:
        yield
    finally:
        warnings.showwarning = show
