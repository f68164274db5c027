"""Publish the results in an output directory together, without changing any other file in it.

The files are written to a hidden directory and moved into place when all of them are complete. A manifest in the
output directory lists the files written; only files listed in it are ever replaced or removed.
"""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath

MANIFEST = "manifest.json"
# This text identifies a manifest written by fmu, so it must not be reworded.
_ABOUT = (
    "Written by fmu. The next run replaces these files, takes away those it no longer writes, and nothing else."
)


class OutputDirectory:
    """A directory of results and its manifest.

    Parameters
    ----------
    root : path-like
        The directory, created by `stage_files` if it does not exist.

    Raises
    ------
    ValueError
        If `root` exists but is not a directory, or if its manifest is invalid.
    """

    def __init__(self, root: str | os.PathLike[str]) -> None:
        self.root = Path(root)
        if os.path.lexists(self.root) and not self.root.is_dir():
            raise ValueError(f"out: must be a directory (got {self.root})")
        self.written = self._read()

    def check(self, names: Iterable[str]) -> None:
        """Raise ValueError if writing the files `names` would overwrite files that fmu did not write.

        The names are paths relative to the directory. Raise ValueError also if a name is not such a path, or is
        the name of the manifest.
        """
        foreign = [name for name in _relative(names) if name not in self.written and self._stands(name)]
        if foreign:
            listed = ", ".join(foreign[:3]) + (", …" if len(foreign) > 3 else "")
            raise ValueError(
                f"out: {self.root} holds {len(foreign)} files that this command did not write and does not "
                f"replace ({listed}); move them away or choose another directory"
            )

    @contextmanager
    def stage_files(self) -> Iterator[Path]:
        """Yield an empty directory for new files; at the end, publish the files unless an error occurred.

        The output directory is created, and removed again if it stays empty. Raise ValueError if publishing would
        overwrite files that fmu did not write.
        """
        made = [path for path in (self.root, *self.root.parents) if not path.exists()]
        self.root.mkdir(parents=True, exist_ok=True)
        stage = Path(tempfile.mkdtemp(prefix=".unfinished-", dir=self.root))
        try:
            yield stage
            self._publish(stage)
        finally:
            shutil.rmtree(stage, ignore_errors=True)
            for path in made:
                if not any(path.iterdir()):
                    path.rmdir()

    def _publish(self, stage: Path) -> None:
        """Move every file in `stage` into place, and remove an earlier run's files that `stage` does not contain.

        The manifest lists each file before it is moved into place. After an interruption, all moved files are
        therefore known to be written by fmu.
        """
        names = sorted(path.relative_to(stage).as_posix() for path in stage.rglob("*") if path.is_file())
        self.check(names)
        earlier = self.written
        self._write({*earlier, *names})
        for name in names:
            target = self.root / name
            target.parent.mkdir(parents=True, exist_ok=True)
            (stage / name).replace(target)
        for name in sorted(earlier - set(names)):
            (self.root / name).unlink(missing_ok=True)
        self._write(set(names))

    def _stands(self, name: str) -> bool:
        """Return True if a file with this name exists, or if a file exists where a parent directory is needed."""
        path = self.root / name
        above = [parent for parent in path.parents if self.root in parent.parents]
        return os.path.lexists(path) or any(os.path.lexists(p) and not p.is_dir() for p in above)

    def _write(self, names: set[str]) -> None:
        text = json.dumps({"about": _ABOUT, "files": sorted(names)}, indent=1) + "\n"
        unfinished = self.root / f".{MANIFEST}.{os.getpid()}.part"
        try:
            unfinished.write_text(text, encoding="utf-8")
            unfinished.replace(self.root / MANIFEST)
        finally:
            unfinished.unlink(missing_ok=True)
        self.written = frozenset(names)

    def _read(self) -> frozenset[str]:
        path = self.root / MANIFEST
        if not os.path.lexists(path):
            return frozenset()
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
            if content["about"] != _ABOUT:
                raise ValueError("it was not written by fmu")
            return frozenset(_relative(content["files"]))
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(f"out: {path} is not a manifest written by fmu ({error}); move it away") from error


def _relative(names: Iterable[str]) -> list[str]:
    """Return the names as POSIX paths.

    Raise ValueError if a name is not a path below the directory, or is the name of the manifest.
    """
    checked = []
    for name in names:
        path = PurePosixPath(name)
        if path.is_absolute() or ".." in path.parts or not path.parts or name == MANIFEST:
            raise ValueError(f"a file's name must be a path below the directory (got {name!r})")
        checked.append(path.as_posix())
    return checked
