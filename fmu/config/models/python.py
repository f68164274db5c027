"""``[model] type = "python"``: a user's function, as described in `fmu.fem.black_box`.

``function = "module:function"`` is searched for in ``module.py`` (or the package ``module/``) in the folder of the
TOML file, then among the installed modules. Loading this kind of problem file runs the code that it names.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from types import ModuleType
from typing import Annotated, Literal

from pydantic import Field, StringConstraints

from fmu.arguments import ArgumentError
from fmu.config.mistakes import FUNCTION, BrokenError
from fmu.config.parameters import ModelTable, ParameterTable
from fmu.config.tables import Built, FileName
from fmu.fem.black_box import BlackBoxModel
from fmu.fem.programs.sources import source_digest, unknown_value
from fmu.formats.files import too_large, why_no_file
from fmu.formats.shown import in_words, quote

WHERE = "model.function"
LARGEST_MODULE = 2**24
"""Largest size in bytes of a module's source file, which Python reads as a whole."""


class PythonTable(ModelTable):
    """A function of theta that returns frequencies in Hz, or frequencies, shapes and gradients.

    Set ``batched = true`` if the function accepts several parameter vectors theta in one call. ``step`` is the
    central-difference step relative to each parameter's range, used if the function returns no gradient. ``store``
    is a folder, relative to the folder of this file, for results that took 0.05 s or longer. They are reused while
    the function's file, your own modules that it imports, and the values that it holds are unchanged. There is no
    store if the function is a bound method, or holds another object whose changes are not noticed. In every run
    the function is called at the starting point, and must reproduce the result that is stored for this point.
    """

    type: Literal["python"]
    function: Annotated[str, StringConstraints(max_length=500, pattern=FUNCTION)]
    batched: bool = False
    step: Annotated[float, Field(gt=0, le=0.1)] = 1e-4
    store: FileName = "solves"

    def build(self, folder: Path, parameters: Sequence[ParameterTable]) -> Built:
        """Import the function, and return its model. Raise BrokenError if it cannot be imported."""
        function = import_function(self.function, folder)
        store = folder / self.store if source_digest(function) and not unknown_value(function) else None
        model = BlackBoxModel(
            function, len(parameters), batched=self.batched, step=self.step, name=self.function, store=store
        )
        return Built(model, {})


class Imported:
    """A function from a module next to a problem file; unpickling it imports the module from the same folder.

    Parameters
    ----------
    function : callable
    place : str
        Module and function name, as ``module:function``.
    folder : Path
        The module's folder.
    where : str
        Key in the file that names the function, for messages.
    """

    def __init__(self, function: Callable[..., object], place: str, folder: Path, where: str = WHERE) -> None:
        self.__wrapped__ = function
        self._place, self._folder, self._where = place, folder, where

    def __call__(self, *arguments: object) -> object:
        """Call the function with these arguments, and return its result."""
        return self.__wrapped__(*arguments)

    def __repr__(self) -> str:
        return f"Imported({self._place!r})"

    def __reduce__(self) -> tuple[Callable[..., object], tuple[str, Path, str]]:
        return import_function, (self._place, self._folder, self._where)


def import_function(place: str, folder: Path, where: str = WHERE) -> Callable[..., object]:
    """Import the function ``module:function`` from a module in a folder, or from an installed module.

    Parameters
    ----------
    place : str
        Module and function name, as ``module:function``.
    folder : Path
        The folder to search first. The module can import other modules from this folder, but only while it is
        being imported. Afterwards the folder's modules are removed from ``sys.modules``, so that problem files in
        other folders do not find them.
    where : str
        Key in the file that names the function, for messages.

    Returns
    -------
    callable
        The function; it can be pickled for other processes.

    Raises
    ------
    BrokenError
        If there is no such module or function, the object of this name cannot be called, the module's file is
        larger than `LARGEST_MODULE`, or importing the module fails.
    """
    name, _, attribute = place.partition(":")
    beside = _beside(name, folder.resolve())
    if beside is not None and too_large(beside, LARGEST_MODULE):
        raise BrokenError(ArgumentError(where, f"{beside.name} {too_large(beside, LARGEST_MODULE)}"))
    try:
        with _importing_from(folder.resolve(), name) if beside is not None else nullcontext():
            module = importlib.import_module(name)
        function: object = module
        for part in attribute.split("."):
            function = getattr(function, part, None)
    except ModuleNotFoundError as error:
        missing = str(error.name)
        if beside is None and (name == missing or name.startswith(f"{missing}.")):
            raise BrokenError(
                ArgumentError(where, "must be in a module beside the file or installed", quote(name))
            ) from error
        raise _not_importable(name, error, where) from error
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # such as GeneratorExit and the user's own exceptions
        raise _not_importable(name, error, where) from error
    if function is None:
        raise BrokenError(ArgumentError(where, f"must be in the module {name}", quote(attribute)))
    if not callable(function):
        raise BrokenError(
            ArgumentError(where, "must be a function", f"{place}, of type {type(function).__name__}")
        )
    return function if beside is None else Imported(function, place, folder.resolve(), where)


def _not_importable(name: str, error: BaseException, where: str) -> BrokenError:
    rule = f"must be in a module that can be imported ({name}: {in_words(error)})"
    return BrokenError(ArgumentError(where, rule))


def _beside(name: str, folder: Path) -> Path | None:
    """Return a module's source file in a folder, or None if the folder has no such module."""
    path = folder.joinpath(*name.split("."))
    files = (path / "__init__.py", path.with_name(f"{path.name}.py"))
    return next((file for file in files if not why_no_file(file)), None)


@contextmanager
def _importing_from(folder: Path, name: str) -> Iterator[None]:
    """Within a ``with`` block, search a folder first when importing. Remove its modules afterwards.

    Modules of the same name from elsewhere are set aside meanwhile. No bytecode is written.
    """

    def of_folder(module: object) -> bool:
        if not issubclass(type(module), ModuleType):  # sys.modules may contain objects of any type
            return False
        file = object.__getattribute__(module, "__dict__").get("__file__")
        return isinstance(file, str) and Path(file).resolve().is_relative_to(folder)

    top = name.partition(".")[0]
    namesakes = {}
    if not of_folder(sys.modules.get(top)):
        namesakes = {n: m for n, m in sys.modules.items() if n == top or n.startswith(f"{top}.")}
    for namesake in namesakes:
        del sys.modules[namesake]
    path, before, bytecode = list(sys.path), set(sys.modules), sys.dont_write_bytecode
    sys.path.insert(0, str(folder))
    sys.dont_write_bytecode = True
    importlib.invalidate_caches()
    try:
        yield
    finally:
        sys.path[:] = path
        sys.dont_write_bytecode = bytecode
        for imported_name in set(sys.modules) - before:
            if of_folder(sys.modules[imported_name]):
                del sys.modules[imported_name]
        sys.modules.update(namesakes)
