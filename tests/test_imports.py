"""The package is layered: imports go down only, there are no import circles, and no folder is crowded."""

import ast
import importlib
import re
import sys
from functools import cache
from pathlib import Path

import pytest

import fmu

HOUSE = Path(fmu.__file__).parent
FLOORS = (
    {"types", "plain_data", "numbers", "interruption", "durable_files"},
    {"box", "differences", "rules"},
    {"arguments"},
    {"tables", "formats", "progress"},
    {"engines"},
    {"fem"},
    {"posterior"},
    {"config", "samplers"},
    {"analysis"},
    {"runs", "surrogates"},
    {"sampling", "cases"},
    {"report"},
    {"paper"},
    {"cli"},
    {"__main__", "__init__"},
)
MOST_MODULES = 12


def module_of(path):
    """Return the dotted name of a module of the package."""
    parts = ("fmu", *path.relative_to(HOUSE).with_suffix("").parts)
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@cache
def tree(path):
    """Return what Python understands of a file; several tests look at it."""
    return ast.parse(path.read_text(encoding="utf-8"))


def statements(node):
    """Yield all statements in a statement or module, however deep."""
    for name in ("body", "orelse", "handlers", "finalbody", "cases"):
        for one in getattr(node, name, ()):
            yield one
            yield from statements(one)


def imports(source, modules):
    """Return which of the modules a source imports, wherever in it, for type checkers alone too."""
    named = set()
    for node in statements(source):
        if isinstance(node, ast.Import):
            named |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            named |= {f"{node.module}.{alias.name}" for alias in node.names}
    found = set()
    for name in named:
        while name and name not in modules:
            name = name.rpartition(".")[0]
        found |= {name} - {""}
    return found


def circles(edges):
    """Return the sets of modules that import each other, by Tarjan's algorithm."""
    index, low, stack, found = {}, {}, [], []

    def visit(v):
        index[v] = low[v] = len(index)
        stack.append(v)
        for w in edges.get(v, ()):
            if w not in index:
                visit(w)
            if w in stack:
                low[v] = min(low[v], low[w])
        if low[v] == index[v]:
            group = stack[stack.index(v) :]
            del stack[-len(group) :]
            if len(group) > 1:
                found.append(sorted(group))

    for v in edges:
        if v not in index:
            visit(v)
    return found


def room(module):
    return module.split(".")[1] if "." in module else "__init__"


def floor(module):
    return next(k for k, rooms in enumerate(FLOORS) if room(module) in rooms)


@pytest.fixture(scope="module")
def edges():
    sources = {module_of(path): path for path in HOUSE.rglob("*.py")}
    sources = {name: tree(path) for name, path in sources.items() if ".templates." not in name}
    return {name: imports(source, sources) - {name} for name, source in sources.items()}


def test_nothing_imports_in_a_circle(edges):
    assert circles(edges) == []


def test_imports_go_down(edges):
    upward = [
        f"{above} imports {below}"
        for above, wanted in edges.items()
        for below in wanted
        if floor(above) <= floor(below) and room(above) != room(below)
    ]
    assert upward == []


def test_no_room_is_crowded():
    crowded = {
        str(folder.relative_to(HOUSE)): n
        for folder in [HOUSE, *(path for path in HOUSE.rglob("*") if path.is_dir())]
        if (n := len(list(folder.glob("*.py")))) > MOST_MODULES + 1  # __init__ is the sign
    }
    assert crowded == {}


def test_every_room_has_a_sign():
    for path in HOUSE.rglob("__init__.py"):
        assert ast.get_docstring(tree(path)), path


def test_the_walk_finds_a_circle_and_an_import_that_goes_up():
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}}) == [["a", "b", "c"]]
    assert circles({"a": {"b", "c"}, "b": {"c"}, "c": set()}) == []
    modules = {"fmu", "fmu.cli", "fmu.fem", "fmu.fem.frame"}
    source = "if TYPE_CHECKING:\n    from fmu.cli import main\n\n\ndef f():\n    import fmu.fem.frame\n"
    assert imports(ast.parse(source), modules) == {"fmu.cli", "fmu.fem.frame"}
    assert floor("fmu.fem.frame") < floor("fmu.cli")


STATEMENT = re.compile(r"^[ \t]*from (fmu\.[\w.]+) import (\([^)]*\)|[^\n(;]+)", re.MULTILINE)
"""An import of names from a module of the package, in one line or in parentheses."""


def imported_names(text):
    """Return the imports of a source, (module, name), also those in programs that are text in it."""
    for module, names in STATEMENT.findall(text):
        plain = re.sub(r"#.*", "", names).strip("()")
        yield from ((module, name.split()[0]) for name in plain.split(",") if name.strip())


def test_studies_and_benchmarks_import_what_there_is():
    """They run seldom, and so would not say that a name has moved."""
    paths = Path(__file__).parent.rglob("*.py")
    named = {one: path.name for path in paths for one in imported_names(path.read_text(encoding="utf-8"))}
    assert len(named) > 500
    missing = []
    for (module, name), where in named.items():
        if not hasattr(importlib.import_module(module), name) and f"{module}.{name}" not in sys.modules:
            try:
                importlib.import_module(f"{module}.{name}")
            except ImportError:
                missing.append(f"{where}: {module}.{name}")
    assert missing == []


def test_all_names_of_a_statement_are_found():
    text = "from fmu.a import b, c as d  # e, f\nif x:\n    from fmu.a.g import (\n  h,  # i\n  j as k,\n  )"
    assert list(imported_names(text)) == [("fmu.a", "b"), ("fmu.a", "c"), ("fmu.a.g", "h"), ("fmu.a.g", "j")]


def test_tests_lie_where_the_package_has_what_they_test():
    """Rooms included; beside them are studies, benchmarks, models, files to read, and tests of other programs."""
    here, own = Path(__file__).parent, {"benchmarks", "models", "programs", "results", "validation"}
    folders = {path.parent.relative_to(here) for path in here.rglob("test_*.py")}
    strays = [str(f) for f in folders if own.isdisjoint(f.parts[:1]) and not (HOUSE / f).is_dir()]
    assert strays == []
    assert Path("fem", "frame") in folders


def test_no_module_assigns_a_name_twice():
    """The second value would hold for what is written above it, too."""
    twice = []
    for path in HOUSE.rglob("*.py"):
        body = tree(path).body
        targets = [target for line in body if isinstance(line, ast.Assign) for target in line.targets]
        every = (name for target in targets for name in ast.walk(target) if isinstance(name, ast.Name))
        names = [name.id for name in every if isinstance(name.ctx, ast.Store) and name.id != "__all__"]
        twice += [f"{path.relative_to(HOUSE)}: {name}" for name in sorted(set(names)) if names.count(name) > 1]
    assert twice == []
