"""Every public name says what it is, what it takes, what it gives and when it refuses."""

import ast
import dataclasses
import importlib
import inspect
import pkgutil
import re
import textwrap
import traceback
from functools import cached_property
from pathlib import Path
from types import FunctionType, ModuleType

import pytest

import fmu
import fmu.cases
import fmu.report.plots
import fmu.samplers

MODULES = [importlib.import_module(module.name) for module in pkgutil.walk_packages(fmu.__path__, prefix="fmu.")]
FACES = {"fmu": fmu, "fmu.cases": fmu.cases, "fmu.report.plots": fmu.report.plots}
"""The modules that users import from."""


def public_names(module: ModuleType) -> list[str]:
    """What a module offers: its ``__all__``, or what has no leading underscore and is no module."""
    listed = getattr(module, "__all__", None)
    if listed is not None:
        return list(listed)
    return [name for name, value in vars(module).items() if name[0] != "_" and not inspect.ismodule(value)]


FUNCTIONS = {
    f"{face}.{name}": getattr(module, name)
    for face, module in FACES.items()
    for name in public_names(module)
    if isinstance(getattr(module, name), FunctionType)
}
CLASSES = {
    f"{face}.{name}": getattr(module, name)
    for face, module in FACES.items()
    for name in public_names(module)
    if inspect.isclass(getattr(module, name))
}


def documentation(thing: object) -> str:
    """The docstring that somebody wrote: a dataclass without one makes up its signature."""
    text = inspect.cleandoc(vars(thing).get("__doc__") or "" if inspect.isclass(thing) else thing.__doc__ or "")
    made_up = inspect.isclass(thing) and text.startswith(f"{thing.__name__}(")
    return "" if made_up else text


def section(text: str, title: str) -> str:
    """The body of a numpydoc section, empty if there is none."""
    found = re.search(rf"^{title}\n-+\n(.*?)(?=^\S[^\n]*\n-+\n|\Z)", text, re.DOTALL | re.MULTILINE)
    return found.group(1) if found else ""


def entries(text: str) -> set[str]:
    """The names that a section describes: ``a``, ``b`` and ``c`` of the lines ``a, b : int`` and ``c``."""
    heads = re.findall(r"^(\w[\w, ]*?)(?: : .*)?$", text, re.MULTILINE)
    return {name for head in heads for name in re.split(r", *", head)}


def members(cls: type) -> dict[str, FunctionType]:
    """The public methods and properties that a class defines itself."""
    found = {}
    for name, value in vars(cls).items():
        inner = getattr(value, "fget", None) or getattr(value, "func", None) or getattr(value, "__func__", value)
        if name[0] != "_" and (isinstance(inner, FunctionType) or isinstance(value, property | cached_property)):
            found[name] = inner
    return found


def raised(function: FunctionType) -> set[str]:
    """The exceptions that a function raises in its own body, by name: an ArgumentError is a ValueError."""
    tree = ast.parse(textwrap.dedent(inspect.getsource(function)))
    calls = [node.exc for node in ast.walk(tree) if isinstance(node, ast.Raise) and node.exc is not None]
    names = {call.func.id for call in calls if isinstance(call, ast.Call) and isinstance(call.func, ast.Name)}
    return {"ValueError" if name == "ArgumentError" else name for name in names}


def faults(function: FunctionType) -> list[str]:
    """What the docstring of a public function leaves out, or says of parameters that are not there."""
    text = documentation(function)
    if not text:
        return ["no docstring"]
    signature = inspect.signature(function)
    described = entries(section(text, "Parameters"))
    found = [f"parameter {name} is not described" for name in signature.parameters if name not in described]
    found += [f"there is no parameter {name}" for name in described - set(signature.parameters)]
    if signature.return_annotation not in (None, "None") and not section(text, "Returns"):
        found.append("no Returns")
    found += [f"{name} is not under Raises" for name in raised(function) if name not in section(text, "Raises")]
    return found


def class_faults(cls: type) -> list[str]:
    """What the docstrings of a public class and its members leave out."""
    text = documentation(cls)
    if not text:
        return ["no docstring"]
    described = entries(section(text, "Parameters")) | entries(section(text, "Attributes"))
    found = [f"{name} is not described" for name in inspect.signature(cls).parameters if name not in described]
    found += [f"{name}: no docstring" for name, member in members(cls).items() if not documentation(member)]
    makers = [vars(cls).get("__post_init__" if dataclasses.is_dataclass(cls) else "__init__")]
    promised = {name for maker in makers if maker is not None for name in raised(maker)}
    return found + [f"{name} is not under Raises" for name in promised if name not in section(text, "Raises")]


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_public_function_is_documented(name):
    assert faults(FUNCTIONS[name]) == []


@pytest.mark.parametrize("name", CLASSES)
def test_a_public_class_is_documented(name):
    assert class_faults(CLASSES[name]) == []


@pytest.mark.parametrize("module", MODULES, ids=lambda module: module.__name__)
def test_whatever_has_no_underscore_has_a_docstring(module):
    own = {
        name: value
        for name, value in vars(module).items()
        if name[0] != "_" and getattr(value, "__module__", None) == module.__name__
        if inspect.isclass(value) or inspect.isfunction(value)
    }
    missing = [name for name, value in own.items() if not documentation(value)]
    classes = {name: value for name, value in own.items() if inspect.isclass(value)}
    missing += [
        f"{name}.{k}" for name, cls in classes.items() for k, m in members(cls).items() if not documentation(m)
    ]
    assert module.__doc__
    assert missing == []


def test_all_that_is_promised_is_there():
    assert set(fmu.__all__) <= set(dir(fmu))
    assert sorted(fmu.__all__) == fmu.__all__
    for name in fmu.__all__:
        assert getattr(fmu, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'sampel'") as misspelt:
        fmu.sampel  # noqa: B018
    assert "Did you mean: 'sample'?" in "".join(traceback.format_exception(misspelt.value))


def test_the_protocols_of_a_sampler_of_ones_own():
    offered = fmu.samplers.__all__
    assert {"Info", "Kernel", "LogDensity", "Sampler", "State", "Tuner"} <= set(offered)
    assert all(getattr(fmu.samplers, name) is not None for name in offered)


def test_type_checkers_see_the_package():
    folder = Path(fmu.__file__).parent
    assert (folder / "py.typed").is_file()
    stub = ast.parse((folder / "__init__.pyi").read_text(encoding="utf-8"))
    named = {alias.name for node in stub.body if isinstance(node, ast.ImportFrom) for alias in node.names}
    assert sorted({*named, "__version__"}) == fmu.__all__


def undescribed(x: float, y: float) -> float:
    """Add.

    Parameters
    ----------
    x, z : float
    """
    if x > y:
        raise ValueError("x")
    return x + y


class Bare:
    """Something.

    Attributes
    ----------
    x : float
    """

    def __init__(self, x: float, y: float) -> None:
        if y < x:
            raise ValueError("y")

    def bare(self):
        return 1

    @property
    def naked(self):
        return 1


def test_the_checks_bite():
    assert faults(undescribed) == [
        "parameter y is not described",
        "there is no parameter z",
        "no Returns",
        "ValueError is not under Raises",
    ]
    assert class_faults(Bare) == [
        "y is not described",
        "bare: no docstring",
        "naked: no docstring",
        "ValueError is not under Raises",
    ]
    assert faults(Bare.bare) == ["no docstring"]


def test_dir_shows_what_is_public():
    assert dir(fmu) == sorted(fmu.__all__)
