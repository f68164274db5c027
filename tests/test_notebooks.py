"""The notebooks as they are committed: run, clean, made of public names, and readable without ``print``."""

import ast
import json
import re
from pathlib import Path

import pytest

PATHS = sorted(Path(__file__).parent.parent.glob("notebooks/*.ipynb"))
FACES = {"fmu", "fmu.paper.published", "fmu.formats.modes.pyoma", "fmu.report.plots"}
SHOWN_AS_HTML = (
    r"by_number",
    r"trace",
    r"fmu\.summary\(\w+\)",
    r"table.*\.T\b.*",  # what fmu.compare gave
    r"fmu\.check\(.*\)",
    r"fmu\.diagnose\(.*\)",
    r"fmu\.find_map\(.*\)",
    r"fmu\.identifiability\(.*\)",
)
LARGEST = 1_500_000


@pytest.fixture(scope="module", params=PATHS, ids=lambda path: path.stem)
def notebook(request):
    return json.loads(request.param.read_text(encoding="utf-8"))


def source(cell):
    return "".join(cell["source"])


def code_cells(notebook):
    return [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]


def shown(cell):
    """The outputs that are values: not progress bars, which a cell displays beside its value."""
    return [output["data"] for output in cell["outputs"] if output["output_type"] == "execute_result"]


def test_there_are_eight():
    assert [path.stem[:2] for path in PATHS] == ["01", "02", "03", "04", "05", "06", "07", "08"]


@pytest.mark.parametrize("path", PATHS, ids=lambda path: path.stem)
def test_it_can_be_loaded_quickly(path):
    assert path.stat().st_size < LARGEST


def test_it_was_run_from_top_to_bottom(notebook):
    cells = code_cells(notebook)
    assert [cell["execution_count"] for cell in cells] == list(range(1, len(cells) + 1))


def test_nothing_was_warned_of_or_printed(notebook):
    kinds = {output["output_type"] for cell in code_cells(notebook) for output in cell["outputs"]}
    assert kinds <= {"execute_result", "display_data"}
    assert not any("print(" in source(cell) for cell in code_cells(notebook))


def test_nothing_of_the_machine_is_left_in_it(notebook):
    assert notebook["metadata"]["kernelspec"]["name"] == "python3"
    assert set(notebook["metadata"]) == {"kernelspec", "language_info"}
    assert all(not cell["metadata"] for cell in notebook["cells"])
    text = [source(cell) for cell in notebook["cells"]] + [
        "".join(value)
        for cell in code_cells(notebook)
        for output in cell["outputs"]
        for kind, value in output["data"].items()
        if kind.startswith("text/")
    ]
    paths = re.compile(r"(?<![\w.:/<])/(?:home|Users|root|tmp|var|opt|work)/")
    assert [line for part in text for line in part.splitlines() if paths.search(line)] == []


def test_it_uses_public_names_only(notebook):
    for cell in code_cells(notebook):
        for node in ast.walk(ast.parse(source(cell))):
            if isinstance(node, ast.Attribute):
                assert not node.attr.startswith("_") or getattr(node.value, "id", "") == "self", ast.unparse(node)
            elif isinstance(node, ast.ImportFrom) and node.module.startswith("fmu"):
                assert node.module in FACES
                assert not any(alias.name.startswith("_") for alias in node.names)
            elif isinstance(node, ast.Import):
                assert {alias.name for alias in node.names if alias.name.startswith("fmu")} <= FACES


def test_values_show_themselves_in_html():
    seen = set()
    for path in PATHS:
        for cell in code_cells(json.loads(path.read_text(encoding="utf-8"))):
            last = source(cell).rstrip().splitlines()[-1]
            kind = next((pattern for pattern in SHOWN_AS_HTML if re.fullmatch(pattern, last)), None)
            if kind is not None:
                assert "text/html" in shown(cell)[0], last
                seen.add(kind)
    assert seen == set(SHOWN_AS_HTML)
