"""The hash of a user's function: it changes with the user's own modules, and with nothing else."""

import importlib.util
import sys

import pytest

from fmu.config.models.python import import_function
from fmu.fem.programs.sources import own_modules, source_digest

PACKAGE = {
    "slow.py": "import json, numpy.linalg, fmu\nfrom masses import M\n\ndef modes(theta):\n    import later\n",
    "masses.py": "from parts.deck import M\nimport parts.broken\n",
    "later.py": "import nowhere_at_all\n",
    "beside.py": "",
    "parts/__init__.py": "",
    "parts/broken.py": "def (",
    "parts/deck.py": "from . import slab\nfrom .walls.left import A\nfrom ... import beyond\nM = [1.0]\n",
    "parts/slab.py": "import slow\n",  # a circle
    "parts/walls/left.py": "A = 1.0\n",  # in a package without __init__.py
    "parts/unused.py": "",
}
OWN = {name for name in PACKAGE if name not in ("slow.py", "beside.py", "parts/unused.py")}


@pytest.fixture
def folder(tmp_path):
    for name, text in PACKAGE.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    return tmp_path


def test_own_modules_are_found_without_being_imported(folder):
    found = own_modules(folder / "slow.py", "slow")
    assert {path.relative_to(folder).as_posix() for path in found.values()} == OWN
    assert found["parts.walls.left"] == folder / "parts" / "walls" / "left.py"
    assert not {"masses", "later", "parts"} & set(sys.modules)


@pytest.mark.parametrize("name", sorted(PACKAGE))
def test_the_hash_changes_with_what_is_imported(folder, name):
    (folder / "parts" / "broken.py").write_text("")
    spec = importlib.util.spec_from_file_location("slow", folder / "slow.py")
    (folder / "slow.py").write_text("def modes(theta):\n    from masses import M\n    import later\n")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    before = source_digest(module.modes)
    with (folder / name).open("a") as file:
        file.write("# changed\n")
    assert (source_digest(module.modes) != before) == (name in OWN or name == "slow.py")


def test_the_hash_is_the_same_before_and_after_a_call(folder, monkeypatch):
    monkeypatch.syspath_prepend(str(folder))
    (folder / "later.py").write_text("import beside\n")
    (folder / "slow.py").write_text("def modes(theta):\n    import later\n    return later.beside.__name__\n")
    function = import_function("slow:modes", folder)
    before = source_digest(function)
    assert function(None) == "beside"
    assert source_digest(function) == before
    for name in ("later", "beside"):
        del sys.modules[name]


def test_modules_elsewhere_on_the_path_are_the_users_unless_they_are_installed(
    folder, tmp_path_factory, monkeypatch
):
    elsewhere = tmp_path_factory.mktemp("elsewhere")
    for place in (elsewhere, elsewhere / "site-packages"):
        place.mkdir(exist_ok=True)
        monkeypatch.syspath_prepend(str(place))
    (elsewhere / "mine.py").write_text("")
    (elsewhere / "site-packages" / "theirs.py").write_text("")
    (folder / "slow.py").write_text("import mine, theirs\n\ndef modes(theta):\n    pass\n")
    assert own_modules(folder / "slow.py", "slow") == {"mine": elsewhere / "mine.py"}


def test_an_installed_function_depends_on_its_package(tmp_path):
    package = tmp_path / "site-packages" / "plates"
    package.mkdir(parents=True)
    for name, text in {"__init__": "", "solver": "from plates import mesh\nimport other", "mesh": ""}.items():
        (package / f"{name}.py").write_text(text)
    (package.parent / "other.py").write_text("")
    found = own_modules(package / "solver.py", "plates.solver")
    assert found == {"plates": package / "__init__.py", "plates.mesh": package / "mesh.py"}


def test_what_has_no_source_has_no_hash():
    assert source_digest(len) == source_digest(eval("lambda theta: theta")) == source_digest(3) == ""
