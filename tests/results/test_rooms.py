"""Digests change with code, and with nothing else."""

import pytest

from tests.results.rooms import changed, code_of, digests, forget

STUDY = '"""A study."""\n\nimport fmu\nfrom fmu.fem import (\n    beam,\n)\n\nprint(fmu.sample(beam))\n'
FILES = {
    "fmu/__init__.py": "",
    "fmu/__init__.pyi": "from .sampling.run import sample as sample\nfrom .report.page import page as page\n",
    "fmu/sampling/run.py": "def sample(x):\n    from fmu.types import Array\n\n    return Array(x)\n",
    "fmu/types.py": "Array = list\n",
    "fmu/fem/beam.py": '"""Beams."""\n\nE = 1.0  # Pa\n',
    "fmu/fem/plate.py": "",
    "fmu/fem/steel.toml": "E = 2.0e11\n",
    "fmu/report/page.py": "",
    "tests/study.py": STUDY,
}


@pytest.fixture
def project(tmp_path):
    def write(number, **edits):
        root = tmp_path / str(number) / "fmu"  # as a clone is called
        for name, text in (FILES | edits).items():
            (root / name).parent.mkdir(parents=True, exist_ok=True)
            (root / name).write_text(text, encoding="utf-8")
        return digests(root, ["tests.study"])

    return write


def test_rooms_are_those_that_imports_lead_to_lazy_ones_too(project):
    assert set(project(1)) == {"__init__", "sampling", "types", "fem", "tests"}


@pytest.mark.parametrize(
    ("file", "text", "room"),
    [
        ("fmu/fem/beam.py", '"""Beams, slender."""\n\n# as in books\nE = 1.0  # Pa\n\n', None),
        ("fmu/fem/beam.py", '"""Beams."""\n\nE = 2.0  # Pa\n', "fem"),
        ("fmu/fem/plate.py", "t = 1.0\n", None),
        ("fmu/fem/steel.toml", "E = 2.1e11\n", "fem"),
        ("fmu/report/page.py", "title = 1\n", None),
        ("fmu/types.py", "Array = tuple\n", "types"),
        ("tests/study.py", STUDY + "print(1)\n", "tests"),
    ],
)
def test_a_digest_changes_with_the_code_of_its_room_alone(project, file, text, room):
    assert changed(project(1), project(2, **{file: text})) == ([] if room is None else [room])


def test_a_new_import_brings_its_room(project):
    after = project(2, **{"fmu/types.py": "import fmu.report.page\n\nArray = list\n"})
    assert changed(project(1), after) == ["report", "types"]


def test_a_module_brings_the_first_lines_of_its_packages_and_their_stubs(project):
    package = {
        "fmu/fem/__init__.py": "attach_stub(__name__)\n",
        "fmu/fem/__init__.pyi": "from .plate import t as t\n",
    }
    before = project(1, **package)
    assert changed(before, project(2, **package, **{"fmu/fem/plate.py": "t = 1.0\n"})) == ["fem"]
    assert changed(before, project(3, **(package | {"fmu/fem/__init__.py": "import fmu.report.page\n"}))) == [
        "fem",
        "report",
    ]


@pytest.mark.parametrize(
    ("call", "room"), [('name = "fmu.report.page"', "report"), ('import_module(f"fmu.fem.{name}")', "fem")]
)
def test_imports_at_run_time_are_followed(project, call, room):
    beam = {"fmu/fem/beam.py": f"E = 1.0\n{call}\n"}
    edit = {"fmu/report/page.py": "title = 1\n", "fmu/fem/plate.py": "t = 1.0\n"}
    assert changed(project(1, **beam), project(2, **beam, **edit)) == [room]


def test_a_package_leads_where_its_main_module_does(project, tmp_path):
    project(1, **{"tests/study/__init__.py": "", "tests/study/__main__.py": STUDY})
    (tmp_path / "1" / "fmu" / "tests" / "study.py").unlink()
    forget()
    assert set(digests(tmp_path / "1" / "fmu", ["tests.study"])) == {
        "__init__",
        "sampling",
        "types",
        "fem",
        "tests",
    }


def test_an_edit_is_seen_after_forgetting_what_was_read(project, tmp_path):
    before = project(1)
    (tmp_path / "1" / "fmu" / "fmu" / "types.py").write_text("Array = tuple\n", encoding="utf-8")
    forget()
    assert changed(before, digests(tmp_path / "1" / "fmu", ["tests.study"])) == ["types"]


def test_texts_in_the_code_are_code():
    function = 'def f():\n    r"""Return 1.\n\n    Always.\n    """\n    return 1\n'
    source = f'PAGE = """# A page\n\nwith a line\n"""\n\n\n{function}'
    assert code_of(source) == 'PAGE = """# A page\nwith a line\n"""\ndef f():\n    return 1'


def test_a_module_that_does_not_exist_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"no module tests\.none"):
        digests(tmp_path, ["tests.none"])
