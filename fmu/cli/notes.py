"""Warnings of this package as lines to read, without the place in the code that they come from."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import click


@contextmanager
def warnings_as_notes() -> Iterator[None]:
    """Show warnings of checkpoints, reduced models and rounding as notes on standard error; others as ever."""
    from fmu.posterior.rounding import RoundingWarning
    from fmu.posterior.train_reduced import ReductionWarning
    from fmu.runs.store import CheckpointWarning, OtherArithmeticWarning

    show = warnings.showwarning

    def as_note(message: Warning | str, category: type[Warning], *where: Any, **more: Any) -> None:
        if issubclass(category, CheckpointWarning | OtherArithmeticWarning | ReductionWarning | RoundingWarning):
            click.echo(f"Note: {message}", err=True)
        else:
            show(message, category, *where, **more)

    warnings.showwarning = as_note
    try:
        yield
    finally:
        warnings.showwarning = show
