"""A mistake of the user is a line on standard error and exit code 2."""

from __future__ import annotations

import sys
from typing import Any

import click

BAD_INPUT, BROKEN_OFF = 2, 1
STOPPED = 130  # as the shell has it of a command that Ctrl-C ended


class Commands(click.Group):
    """Commands whose errors are one line."""

    def main(self, *args: Any, **kwargs: Any) -> Any:
        """Run, and turn an error in what the user gave into a line, or one a mistake of a file, and code 2."""
        try:
            code = super().main(*args, **{**kwargs, "standalone_mode": False})
        except click.exceptions.NoArgsIsHelpError as error:
            error.show()
            sys.exit(BAD_INPUT)
        except click.ClickException as error:
            _stop(error.format_message())
        except click.Abort:
            click.echo("Stopped.", err=True)
            sys.exit(STOPPED)
        except (ValueError, OSError) as error:
            _stop(
                str(error.args[0]) if hasattr(error, "mistakes") else str(error), *getattr(error, "mistakes", ())
            )
        except MemoryError as error:
            _stop(f"the model needs more memory than is available ({error or 'no details'})")
        except RuntimeError as error:
            from fmu.engines.base import LostTaskError
            from fmu.samplers.loop.run import TooManyFailuresError

            if not isinstance(error, LostTaskError | TooManyFailuresError):
                raise
            _stop(str(error), code=BROKEN_OFF)
        sys.exit(code if isinstance(code, int) else 0)


def _stop(message: str, *mistakes: object, code: int = BAD_INPUT) -> None:
    """Print one line, and one more for each of the first mistakes in a file."""
    from fmu.formats.shown import one_line, told

    click.echo(f"Error: {one_line(message)}", err=True)
    for line in told(mistakes):
        click.echo(f"  {line}", err=True)
    sys.exit(code)
