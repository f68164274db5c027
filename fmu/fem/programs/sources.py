"""Source files of a user's function: its own file, and the user's own modules that it imports.

All import statements in these files are parsed, and no code is run. The result is therefore the same in every
process, and does not depend on imports that happen during a call. The user's own modules are the modules of the
function's package, and all modules that belong neither to Python nor to an installed package. These may be next to
the function's file, on the path, or in a package that was installed in editable mode. Changes are not detected in
installed packages, in modules that no statement names (``importlib.import_module(name)``), or in data files.
"""

from __future__ import annotations

import ast
import hashlib
import importlib
import importlib.util
import inspect
import sysconfig
from collections.abc import Callable, Iterator
from contextlib import suppress
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path

_INSTALLED = {"site-packages", "dist-packages"}
_LIBRARIES = (sysconfig.get_path("stdlib"), sysconfig.get_path("platstdlib"), str(Path(__file__).parents[2]))
"""Folders that contain the modules of Python and of fmu."""


def source_digest(function: Callable[..., object]) -> str:
    """Return a hash of a function's source file and of the user's own modules that it imports.

    The hash is an empty string if the function has no source file, as in a notebook.
    """
    try:
        function = inspect.unwrap(function)
        file = Path(inspect.getsourcefile(function) or "").absolute()
        spec = getattr(function, "__globals__", {}).get("__spec__")
        name = function.__module__ if spec is None else spec.name  # the __module__ of a script is __main__
        found = hashlib.sha256(file.read_bytes())
    except Exception:  # not a Python function: its attributes may be of any kind
        return ""
    for imported, other in sorted(own_modules(file, name).items()):
        found.update(f"{imported} {hashlib.sha256(other.read_bytes()).hexdigest()}\n".encode())
    return found.hexdigest()


def own_modules(file: Path, name: str) -> dict[str, Path]:
    """Return the files of the user's own modules that a module imports, directly or indirectly.

    Parameters
    ----------
    file : Path
        The module's source file.
    name : str
        Full name of the module. If it does not match the file, the module is assumed to be in no package.

    Returns
    -------
    dict of str to Path
        The modules' files, keyed by full module name. The given module is not included.
    """
    path, parts = file.parent if file.stem == "__init__" else file.with_suffix(""), name.split(".")
    if path.parts[-len(parts) :] != tuple(parts):
        name, parts = path.name, [path.name]
    root = path.parents[len(parts) - 1]
    importlib.invalidate_caches()
    found: dict[str, Path] = {}
    waiting, asked = [(name, file), *_locate_source(name.rpartition(".")[0], root)], {name}
    while waiting:
        module, source = waiting.pop()
        if module in found:
            continue
        found[module] = source
        imported = set(_imports(source, module)) - asked
        asked |= imported
        for other, place in (pair for one in imported for pair in _locate_source(one, root)):
            if place.is_relative_to(root / parts[0]) or _is_own(place):
                waiting.append((other, place))
    del found[name]
    return found


def _imports(file: Path, module: str) -> Iterator[str]:
    """Yield the full names of the modules that a module imports.

    For ``from a import b`` the name is ``a.b``, which may also be an attribute of the module ``a``. No names are
    yielded if the file is not Python source or cannot be parsed.
    """
    if file.suffix != ".py":
        return
    package = module if file.stem == "__init__" else module.rpartition(".")[0]
    try:
        tree = ast.parse(file.read_bytes())
    except (SyntaxError, ValueError, RecursionError, MemoryError):  # the file cannot be imported
        return
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            with suppress(ImportError):  # a relative import from beyond the package
                of = importlib.util.resolve_name("." * node.level + (node.module or ""), package)
                yield from (f"{of}.{alias.name}" for alias in node.names)


def _locate_source(name: str, root: Path) -> list[tuple[str, Path]]:
    """Return the full name and source file of a module and of each package that contains it.

    The search starts in the folder `root`, from which the function was imported, and continues on the path. Names
    without a source file are skipped.
    """
    found, within = [], [str(root)]
    parts = name.split(".") if name else []
    for i, part in enumerate(parts):  # a search for a full name would import the package
        specs = [PathFinder.find_spec(part, within), _on_the_path(part) if i == 0 else None]
        known = [spec for spec in specs if spec is not None]
        spec = next((spec for spec in known if spec.has_location), known[0] if known else None)
        if spec is None:
            break
        if spec.has_location and spec.origin and Path(spec.origin).is_file():
            found.append((".".join(parts[: i + 1]), Path(spec.origin).absolute()))
        if spec.submodule_search_locations is None:
            break
        within = list(spec.submodule_search_locations)
    return found


def _on_the_path(name: str) -> ModuleSpec | None:
    try:
        return importlib.util.find_spec(name)
    except (ImportError, ValueError, AttributeError):  # sys.modules contains an object that is not a module
        return None


def _is_own(file: Path) -> bool:
    return not _INSTALLED & set(file.parts) and not any(map(file.is_relative_to, _LIBRARIES))
