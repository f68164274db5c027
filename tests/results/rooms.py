"""The rooms of the package that a study depends on, and a digest of the code that it imports from each.

A room is a folder or a module of ``fmu/``. A study depends on a module if imports lead there from the study's
modules, wherever they are written, and on the data files of every room that it imports from. Comments, docstrings
and empty lines are no code.
"""

from __future__ import annotations

import hashlib
import re
from collections import defaultdict
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
_AT_RUN_TIME = "import_module("
_QUOTED = re.compile(r'"(fmu(?:\.\w+)+)"')
_PUBLIC = re.compile(r"\bfmu\.(\w+)")
_STUB = re.compile(r"^from \.([\w.]*) import (\w+) as \w+$", re.MULTILINE)
NOT_READ = (".pyc", ".png", ".nc")


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
    of_room = defaultdict[str, set[Path]](set)
    for path in _reached(root, modules):
        package, inside, *_ = path.relative_to(root).parts
        if package == "fmu":
            room = inside.removesuffix(".py")
            of_room[room] |= {path, *_data_of(root / "fmu" / room)}
        elif path.relative_to(root).as_posix() not in MACHINERY:
            of_room[TESTS].add(path)
    return {room: _digest(of_room[room]) for room in sorted(of_room)}


def forget() -> None:
    """Forget what was read: files may have been edited since."""
    for reader in (_file_of, _leads_to, _imported, _public, _data_of, _content_of):
        reader.cache_clear()


def changed(then: Mapping[str, str], now: Mapping[str, str]) -> list[str]:
    """Return the rooms whose digests differ."""
    return sorted(room for room in {*then, *now} if then.get(room) != now.get(room))


def _reached(root: Path, modules: Iterable[str]) -> list[Path]:
    """Return the files that the modules lead to by imports, those of the modules among them.

    A package is run by its ``__main__.py``.
    """
    names = [*modules]
    wanted = {path for name in (*names, *(f"{name}.__main__" for name in names)) if (path := _file_of(root, name))}
    for name in names:
        if _file_of(root, name) is None:
            raise ValueError(f"no module {name} in {root}")
    found: set[Path] = set()
    while wanted:
        path = wanted.pop()
        found.add(path)
        wanted |= _leads_to(root, path) - found
    return sorted(found)


@cache
def _leads_to(root: Path, path: Path) -> frozenset[Path]:
    """Return the files that a file imports from, and those with which its packages start.

    A file that imports what it finds out at run time leads to all modules beside and below it.
    """
    above = (parent / "__init__.py" for parent in path.parents if root in parent.parents)
    imported = (_file_of(root, name) for name in _imported(root, path))
    beside = path.parent.rglob("*.py") if _AT_RUN_TIME in path.read_text(encoding="utf-8") else ()
    return frozenset(one for one in (*above, *imported, *beside) if one and one.is_file())


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
def _imported(root: Path, path: Path) -> frozenset[str]:
    """Return what a file imports. Names of a package with a stub come from the modules that the stub names."""
    text = path.read_text(encoding="utf-8")
    names = {*_QUOTED.findall(text)}
    for module, parts, whole in _IMPORT.findall(text):
        names.add(whole or module)
        names |= {f"{module}.{name}" for name in re.findall(r"\w+", re.sub(r" as \w+", "", parts))}
    if "fmu" in names:
        public = _public(root, root / "fmu" / "__init__.pyi")
        names |= {public[name] for name in _PUBLIC.findall(text) if name in public}
    stub = path.with_suffix(".pyi")
    if stub.is_file() and path.parent != root / "fmu":
        names |= {*_public(root, stub).values()}
    return frozenset(names)


@cache
def _public(root: Path, stub: Path) -> dict[str, str]:
    """Return the modules of the public names, keyed by name."""
    package = ".".join(stub.parent.relative_to(root).parts)
    found = _STUB.findall(stub.read_text(encoding="utf-8"))
    return {name: f"{package}.{module or name}" for module, name in found}


@cache
def _data_of(room: Path) -> frozenset[Path]:
    """Return the files of a folder that are no modules: data and templates."""
    files = (path for path in room.rglob("*") if path.is_file())
    return frozenset(path for path in files if path.suffix not in (".py", *NOT_READ))


def _digest(files: Iterable[Path]) -> str:
    """Return eight hexadecimal digits for names and code of files."""
    found = hashlib.sha256()
    for path in sorted(files):
        found.update(_content_of(path))
    return found.hexdigest()[:8]


@cache
def _content_of(path: Path) -> bytes:
    """Return the name of a file and what a digest is made of: its code, or all of its text."""
    text = path.read_text(encoding="utf-8", errors="replace")
    return f"{path.name}\n{code_of(text) if path.suffix == '.py' else text}\n".encode()
