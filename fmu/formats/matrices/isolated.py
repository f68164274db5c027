"""Run third-party readers in a separate process, because some of them crash on broken files."""

from __future__ import annotations

import importlib.util
import os
import pkgutil
import subprocess
import sys
import tempfile
import warnings
from pathlib import Path

import numpy as np

from fmu.formats.matrices.limits import LARGEST_CONTENT, RefusedError
from fmu.formats.shown import one_line
from fmu.types import AnyArray

LONGEST = 300
"""Time limit for a reader, s."""
LARGEST_MEMORY = 2**33
"""Largest address space for a reader's process, bytes, on systems that can limit it."""
_TOLD = 3
"""Exit code of a reader process that reported an error."""


def read_isolated(reader: str, path: Path, library: str, extra: str) -> dict[str, AnyArray]:
    """Call ``reader(path)`` in a separate process, and return its dict of arrays.

    Parameters
    ----------
    reader : str
        The reader function, as ``"module:function"``.
    path : Path
    library : str
        The module that the reader imports.
    extra : str
        The fmu extra that installs the library; empty if no extra does.

    Returns
    -------
    dict of str to ndarray

    Raises
    ------
    RefusedError
        If the library is not installed, or the reader's process raises an error, crashes, takes too long or
        returns too much.
    """
    if not _is_installed(library):
        package = f"'fmu[{extra}]'" if extra else library
        raise RefusedError(f"needs a library that is not installed: pip install {package}")
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "arrays.npz"
        command = [
            sys.executable,
            "-P",
            "-c",
            f"import {__name__} as m; m.main()",
            reader,
            str(path.resolve()),
            str(out),
        ]
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
        try:
            done = subprocess.run(
                command, env=environment, stdin=subprocess.DEVNULL, capture_output=True, timeout=LONGEST
            )
        except subprocess.TimeoutExpired:
            raise RefusedError(f"{library} took more than {LONGEST} s to read it") from None
        if done.returncode == _TOLD:
            raise RefusedError(one_line(done.stderr.decode(errors="replace").splitlines()[-1], 300))
        if done.returncode or not out.exists():
            raise RefusedError(f"{library} crashed on it: it is broken, or of a kind that {library} does not know")
        if out.stat().st_size > LARGEST_CONTENT:
            raise RefusedError(f"must hold at most {LARGEST_CONTENT} bytes (got {out.stat().st_size})")
        with np.load(out, allow_pickle=False) as content:
            return {name: content[name] for name in content.files}


def main() -> None:
    """Call the reader function given on the command line, and save the arrays that it returns.

    If it raises an error, print its message to standard error and exit with the code `_TOLD`.
    """
    name, path, out = sys.argv[1:]
    warnings.simplefilter("ignore")
    try:
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (LARGEST_MEMORY, LARGEST_MEMORY))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    except (ImportError, ValueError, OSError):  # the system has no such limits
        pass
    try:
        np.savez(out, **pkgutil.resolve_name(name)(Path(path)))
    except Exception as error:
        print(f"\n{error or type(error).__name__}".replace("\n", " "), file=sys.stderr)
        sys.exit(_TOLD)


def _is_installed(library: str) -> bool:
    try:
        return importlib.util.find_spec(library) is not None
    except ModuleNotFoundError:  # the parent package is missing
        return False
