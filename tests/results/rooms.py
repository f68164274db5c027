"""The rooms of the package that a study depends on, and a digest of the code in each.

A room is a folder or a module of ``fmu/``. A study depends on it if imports lead there from the study's modules,
wherever they are written. Comments, docstrings and empty lines are no code.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path

TESTS = "tests"
"""The name under which the modules of a study itself have their digest."""
PACKAGES = ("fmu", TESTS)
MACHINERY = ("tests/validation/kept.py", "tests/results/studies.py", "tests/results/stamps.py")
"""They decide when a study runs, and nothing about its results: they are in no digest."""
_TEXT = r'"""(?:(?!""")[\s\S])*"""'
_DOCSTRING = re.compile(rf"(^[ \t]*[rR]?{_TEXT}[ \t]*$)|{_TEXT}", re.MULTILINE)
_IMPORT = re.compile(r"^[ \t]*(?:from ([\w.]+) import (\([^)]*\)|[^\n]*)|import ([\w.]+))", re.MULTILINE)
_PUBLIC = re.compile(r"\bfmu\.(\w+)")
_STUB = re.compile(r"^from \.([\w.]*) import (\w+) as \w+$", re.MULTILINE)
_NO_CODE = (".pyc", ".png", ".nc")


def code_of(source: str) -> str:
    """Return the lines of a module of Python that are code."""
    lines = _DOCSTRING.sub(lambda found: "" if found[1] else found[0], source).splitlines()
    return "\n".join(line.rstrip() for line in lines if line.strip() and not line.lstrip().startswith("#"))


def digests(root: Path, modules: Iterable[str]) -> dict[str, str]:
    """Return the digest of each room that the modules lead to, and one of those among them that are tests.

    Parameters
    ----------
    root : path
        Of the project.
    modules : iterable of str
        Such as ``tests.validation.coverage`` or ``fmu.cli``.

    Raises
    ------
    ValueError
        If the project has no such module.
    """
    files = _reached(root, modules)
    inside = [path.relative_to(root).parts for path in files]
    rooms = sorted({parts[1].removesuffix(".py") for parts in inside if parts[0] == "fmu"})
    own = [
        path
        for path, parts in zip(files, inside, strict=True)
        if parts[0] == TESTS and path.relative_to(root).as_posix() not in MACHINERY
    ]
    return {room: _digest_of_room(root / "fmu" / room) for room in rooms} | ({TESTS: _digest(own)} if own else {})


def forget() -> None:
    """Forget what was read: files may have been edited since."""
    for reader in (_file_of, _imported, _public, _digest_of_room):
        reader.cache_clear()


def changed(then: Mapping[str, str], now: Mapping[str, str]) -> list[str]:
    """Return the rooms whose digests differ."""
    return sorted(room for room in {*then, *now} if then.get(room) != now.get(room))


def _reached(root: Path, modules: Iterable[str]) -> list[Path]:
    """Return the files that the modules lead to by imports, those of the modules among them.

    A package is run by its ``__main__.py``.
    """
    wanted, found = set(modules), set()
    for name in wanted:
        if _file_of(root, name) is None:
            raise ValueError(f"no module {name} in {root}")
    wanted |= {f"{name}.__main__" for name in wanted}
    while wanted:
        path = _file_of(root, wanted.pop())
        if path is not None and path not in found:
            found.add(path)
            wanted |= _imported(path)
    return sorted(found)


@cache
def _file_of(root: Path, module: str) -> Path | None:
    """Return the file of a module, or of the module that has this name in it; None if it is of another package."""
    parts = module.split(".")
    if parts[0] not in PACKAGES:
        return None
    for n in range(len(parts), 0, -1):
        base = root.joinpath(*parts[:n])
        for path in (base.with_suffix(".py"), base / "__init__.py", base / "__main__.py"):
            if path.is_file():
                return path
    return None


@cache
def _imported(path: Path) -> frozenset[str]:
    """Return what a file imports; public names of ``fmu`` come from the modules that its stub names."""
    text, names = path.read_text(encoding="utf-8"), set()
    for module, parts, whole in _IMPORT.findall(text):
        names.add(whole or module)
        names |= {f"{module}.{name}" for name in re.findall(r"\w+", re.sub(r" as \w+", "", parts))}
    root = next(parent for parent in path.parents if (parent / "fmu").is_dir() and parent.name != "fmu")
    if "fmu" in names:
        public = _public(root / "fmu" / "__init__.pyi")
        names |= {public[name] for name in _PUBLIC.findall(text) if name in public}
    return frozenset(names)


@cache
def _public(stub: Path) -> dict[str, str]:
    """Return the modules of the public names."""
    found = _STUB.findall(stub.read_text(encoding="utf-8"))
    return {name: f"fmu.{module}" if module else f"fmu.{name}" for module, name in found}


@cache
def _digest_of_room(room: Path) -> str:
    """Return the digest of a folder, or of the module that has this name."""
    files = (path for path in room.rglob("*") if path.is_file()) if room.is_dir() else [room.with_suffix(".py")]
    return _digest(path for path in files if path.suffix not in _NO_CODE)


def _digest(files: Iterable[Path]) -> str:
    """Return eight hexadecimal digits for names and code of files."""
    found = hashlib.sha256()
    for path in sorted(files):
        text = path.read_text(encoding="utf-8", errors="replace")
        found.update(f"{path.name}\n{code_of(text) if path.suffix == '.py' else text}\n".encode())
    return found.hexdigest()[:8]
