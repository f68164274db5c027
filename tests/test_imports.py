"""The package is layered: imports go down only, there are no import circles, and no folder is crowded."""

import ast
import importlib
import sys
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


def imports(source, modules):
    """Return which of the modules a source imports, wherever in it, for type checkers alone too."""
    named = set()
    for node in ast.walk(ast.parse(source)):
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
    sources = {module_of(path): path.read_text(encoding="utf-8") for path in HOUSE.rglob("*.py")}
    sources = {name: text for name, text in sources.items() if ".templates." not in name}
    return {name: imports(text, sources) - {name} for name, text in sources.items()}


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
        assert ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))), path


def test_the_walk_finds_a_circle_and_an_import_that_goes_up():
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}}) == [["a", "b", "c"]]
    assert circles({"a": {"b", "c"}, "b": {"c"}, "c": set()}) == []
    modules = {"fmu", "fmu.cli", "fmu.fem", "fmu.fem.frame"}
    source = "if TYPE_CHECKING:\n    from fmu.cli import main\n\n\ndef f():\n    import fmu.fem.frame\n"
    assert imports(source, modules) == {"fmu.cli", "fmu.fem.frame"}
    assert floor("fmu.fem.frame") < floor("fmu.cli")


def test_studies_and_benchmarks_import_what_there_is():
    """They run seldom, and so would not say that a name has moved."""
    missing = []
    for path in Path(__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("fmu."):
                module = importlib.import_module(node.module)
                for alias in node.names:
                    if not hasattr(module, alias.name) and f"{node.module}.{alias.name}" not in sys.modules:
                        try:
                            importlib.import_module(f"{node.module}.{alias.name}")
                        except ImportError:
                            missing.append(f"{path.name}: {node.module}.{alias.name}")
    assert missing == []


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
        body = ast.parse(path.read_text(encoding="utf-8")).body
        targets = [target for line in body if isinstance(line, ast.Assign) for target in line.targets]
        every = (name for target in targets for name in ast.walk(target) if isinstance(name, ast.Name))
        names = [name.id for name in every if isinstance(name.ctx, ast.Store) and name.id != "__all__"]
        twice += [f"{path.relative_to(HOUSE)}: {name}" for name in sorted(set(names)) if names.count(name) > 1]
    assert twice == []
