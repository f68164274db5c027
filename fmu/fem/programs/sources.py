"""Source of a user's function: its file, the user's own modules that it imports, and the values that it holds.

All import statements in these files are parsed, and no code is run. The result is therefore the same in every
process, and does not depend on imports that happen during a call. The user's own modules are the modules of the
function's package, and all modules that do not belong to Python, to fmu or to an installed package. These may be
next to the function's file, on the path, or in a package that was installed in editable mode. Changes are not
detected in installed packages, in modules that no statement names (``importlib.import_module(name)``), or in data
files.
"""

from __future__ import annotations

import ast
import hashlib
import importlib
import importlib.util
import inspect
import sys
import sysconfig
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from importlib.machinery import ModuleSpec, PathFinder
from itertools import chain
from pathlib import Path, PurePath
from types import CellType, CodeType, FunctionType, MethodType, ModuleType

import numpy as np
from scipy.sparse import issparse

from fmu.durable_files import digest

_INSTALLED = {"site-packages", "dist-packages"}
_LIBRARIES = (sysconfig.get_path("stdlib"), sysconfig.get_path("platstdlib"), str(Path(__file__).parents[2]))
"""Folders that contain the modules of Python and of fmu."""
_UNKNOWN = "unknown: "
_PLAIN = {type(None), type(...), bool, int, float, complex, str, bytes, range, slice}


def source_digest(function: Callable[..., object]) -> str:
    """Return a hash of a function: of its source, its place there, and the values that it holds.

    The source is its file and the user's own modules that it imports. The values are its defaults, the variables
    of enclosing functions and the arguments of `functools.partial`. Of a value that `unknown_value` reports, only
    the type or name enters. The hash is an empty string if the function has no source file, as in a notebook.
    """
    source = _hash_source(function.func if isinstance(function, partial) else function)
    return digest("\n".join([source, *_content(function, ())]).encode()) if source else ""


def unknown_value(function: Callable[..., object]) -> str:
    """Return the type of a value, held by a function, whose changes `source_digest` does not notice; "" if none.

    `source_digest` notices changes of numbers, texts, paths, arrays, sparse matrices, lists, tuples, sets and
    dicts of these, modules, functions and classes. It does not notice changes of the object of a bound method.
    """
    parts = _content(function, ())
    return next((part.removeprefix(_UNKNOWN) for part in parts if part.startswith(_UNKNOWN)), "")


def _content(value: object, holders: tuple[int, ...]) -> Iterator[str]:
    """Yield texts that identify a value, the same in every process, or `_UNKNOWN` and the value's type.

    `holders` are the ids of the objects that contain it; the function itself has none.
    """
    kind, within = type(value), (*holders, id(value))
    name = f"{kind.__module__}.{kind.__qualname__}"
    if id(value) in holders:  # such as a function that calls itself
        yield "itself"
    elif kind in _PLAIN or isinstance(value, (np.generic, np.ufunc, PurePath, ModuleType)):
        yield value.__name__ if isinstance(value, ModuleType) else repr(value)
    elif isinstance(value, np.ndarray) and kind is np.ndarray and not value.dtype.hasobject:
        yield f"{value.dtype} {value.shape} {digest(np.ascontiguousarray(value).tobytes())}"
    elif isinstance(value, (list, tuple, set, frozenset, dict)) and kind.__module__ == "builtins":
        parts = [[*_content(item, within)] for item in (value.items() if isinstance(value, dict) else value)]
        yield f"{name} {len(parts)}"
        yield from chain.from_iterable(sorted(parts) if isinstance(value, (set, frozenset)) else parts)
    elif issparse(value):
        entries = value.tocoo()  # type: ignore[attr-defined]
        yield name
        yield from _content([entries.shape, entries.data, *entries.coords], within)
    elif isinstance(value, partial):
        yield from _content([value.func, value.args, value.keywords], within)
    elif isinstance(value, MethodType):
        yield from _content([value.__self__, value.__func__], within)
    elif imported := _installed_name(value):
        yield imported
    elif isinstance(value, FunctionType):
        yield f"{value.__qualname__} {_place(value.__code__)}"
        yield from _own_source(value, holders)
        cells = [None if cell == CellType() else cell.cell_contents for cell in value.__closure__ or ()]
        yield from _content([value.__defaults__, value.__kwdefaults__, cells], within)
    elif isinstance(value, type) and "<locals>" not in value.__qualname__:
        yield value.__qualname__
        yield from _own_source(value, holders)
    elif _installed_name(kind) and hasattr(value, "__wrapped__"):  # such as functools.lru_cache
        yield from _content(value.__wrapped__, holders)
    else:
        yield f"{_UNKNOWN}{name}"


def _own_source(value: Callable[..., object], holders: tuple[int, ...]) -> Iterator[str]:
    """Yield the hash of the source of a function or class that the user's function holds."""
    if holders:
        yield _hash_source(value) or f"{_UNKNOWN}{value.__qualname__}, which is in no file"


def _place(code: CodeType) -> str:
    """Return where a function is in its file: its first line, and the column of a lambda."""
    if code.co_name != "<lambda>":
        return str(code.co_firstlineno)
    places = [place for place in code.co_positions() if None not in place]
    return str(max(places)) if places else f"{_UNKNOWN}lambda, whose column is not known"


def _installed_name(value: object) -> str:
    """Return the full name of a function or class of Python, of fmu or of an installed package, otherwise "".

    The value must be the attribute of this name in its module.
    """
    name = getattr(value, "__qualname__", None)
    module = sys.modules.get(str(getattr(value, "__module__", "")))
    if module is None or not isinstance(name, str) or getattr(module, name, None) is not value:
        return ""
    file = getattr(module, "__file__", None)
    is_own = module.__name__ not in sys.builtin_module_names if file is None else _is_own(Path(file))
    return "" if is_own else f"{module.__name__}.{name}"


def _hash_source(function: Callable[..., object]) -> str:
    """Return a hash of the file of a function and of the user's own modules that it imports, or ""."""
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
