"""What Markdown pages and notebooks refer to is there: files, images, anchors. Nothing is asked of the network."""

import json
import re
from functools import cache
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest
from markdown_it import MarkdownIt

ROOT = Path(__file__).parent.parent
PAGES = sorted(
    path.relative_to(ROOT)
    for pattern in ("*.md", "results/**/*.md", "notebooks/guide/*.md", "notebooks/*.ipynb")
    for path in ROOT.glob(pattern)
)
OF_THE_PAST = ("CHANGELOG.md",)
"""Pages that may name files that are no more."""


def markdown(path):
    text = path.read_text(encoding="utf-8")
    if path.suffix != ".ipynb":
        return text
    return "\n\n".join("".join(c["source"]) for c in json.loads(text)["cells"] if c["cell_type"] == "markdown")


@cache
def blocks(text):
    """Return the blocks of a page, to which several links may lead."""
    return tuple(MarkdownIt().enable("table").parse(text))


def tokens(path):
    for block in blocks(markdown(path)):
        yield from (block, *(block.children or ()))


def targets(path):
    """Destinations of links and images."""
    return [str(t.attrs[name]) for t in tokens(path) for name in ("href", "src") if name in t.attrs]


def anchors(path):
    """What a link to a part of the page may name: the headings, as GitHub does; ids in HTML."""
    if path.suffix == ".html":
        return set(re.findall(r'\bid="([^"]+)"', path.read_text(encoding="utf-8")))
    found, before = [], None
    for token in tokens(path):
        if before == "heading_open":
            slug = re.sub(r"[^\w\- ]", "", token.content.lower()).replace(" ", "-")
            found.append(f"{slug}-{found.count(slug)}" if slug in found else slug)
        before = token.type
    return set(found)


def broken(path):
    """The destinations that do not exist."""
    missing = []
    for target in targets(path):
        parts = urlsplit(target)
        if parts.scheme or parts.netloc:
            continue
        file = path.parent / unquote(parts.path) if parts.path else path
        if not file.exists() or (parts.fragment and unquote(parts.fragment) not in anchors(file)):
            missing.append(target)
    return missing


def missing_files(text, root):
    """The files of the package and its tests that a text names, and that do not exist."""
    return sorted({n for n in re.findall(r"`((?:fmu|tests)/[\w/]+\.\w+)", text) if not (root / n).exists()})


@cache
def modules(house):
    """Return the names of the modules of a folder, "/NAME", with the words in each."""
    texts = {path: path.read_text(encoding="utf-8") for path in house.rglob("*.py")}
    return {
        f"/{path.relative_to(house).as_posix()}": frozenset(re.findall(r"\w+", text))
        for path, text in texts.items()
    }


def wrong_names(text, *houses):
    """The modules that a text names and that are not in `houses`, or have no such name as stands behind them."""
    found = []
    for file, names in re.findall(r"`((?:\w+/)*\w+\.py)`(?:[ \n]+`(\w+(?:\.\w+)*)`)?", text):
        if file.startswith(("tests/", "fmu/")) or file.endswith("NAME.py"):
            continue
        sources = [
            words for house in houses for path, words in modules(house).items() if path.endswith(f"/{file}")
        ]
        if not any(set(names.split(".")) - {""} <= words for words in sources):
            found.append(f"{file} {names}".strip())
    return found


def test_what_the_map_names_is_there():
    assert wrong_names(markdown(ROOT / "CONTRIBUTING.md"), ROOT / "fmu", ROOT / "notebooks" / "guide") == []


@pytest.mark.parametrize("page", PAGES, ids=str)
def test_links_lead_somewhere(page):
    assert broken(ROOT / page) == []


@pytest.mark.parametrize("page", [page for page in PAGES if page.name not in OF_THE_PAST], ids=str)
def test_files_that_are_named_exist(page):
    assert missing_files(markdown(ROOT / page), ROOT) == []


def missing_functions(text, source):
    """The private functions, and classes and methods as `Class.method`, that only the text knows."""
    named = re.findall(r"`(_[a-z]\w+)`|`([A-Z][a-z]\w*)\.(_{0,2}[a-z]\w+)`", text)
    names = {name for found in named for name in found if name}
    known = {*re.findall(r"(?:def|class) (\w+)", source), *re.findall(r"^    (\w+):", source, re.M)}
    return sorted(names - known)


def test_functions_in_the_map_exist():
    source = "\n".join(path.read_text(encoding="utf-8") for path in (ROOT / "fmu").rglob("*.py"))
    assert missing_functions(markdown(ROOT / "CONTRIBUTING.md"), source) == []
    text = "`_points`, `Solves.of`, `_gone`, `Solves.gone`, `Gone.of`, `log_prob`"
    assert missing_functions(text, "class Solves:\n    def of(self)\n    def _points(") == [
        "Gone",
        "_gone",
        "gone",
    ]


def test_every_kind_of_page_is_read():
    names = {str(page) for page in PAGES}
    assert {"README.md", "CHANGELOG.md", "results/README.md", "results/young-shape/tables.md"} < names
    assert sum(len(targets(ROOT / page)) for page in PAGES) > 30
    assert any(page.suffix == ".ipynb" and targets(ROOT / page) for page in PAGES)


def test_broken_links_are_found(tmp_path):
    (tmp_path / "a picture.png").touch()
    (tmp_path / "report.html").write_text('<h2 id="fit">Fit</h2>', encoding="utf-8")
    (tmp_path / "other.md").write_text("# Some `code`, and more\n\n## Twice\n\n## Twice\n", encoding="utf-8")
    page = tmp_path / "page.md"
    good = (
        "# Here\n[a](other.md) [b](other.md#some-code-and-more) [c](other.md#twice-1) [d](#here)\n"
        "[e](report.html#fit)\n"
        "![f](a%20picture.png) [![g](a%20picture.png)](https://example.org/none) [h]\n\n[h]: other.md\n\n"
        "| table |\n| :-- |\n| [i](other.md) `[j](in-code.md)` |\n\n```\n[k](in-code.md)\n```\n"
    )
    page.write_text(good, encoding="utf-8")
    assert broken(page) == []
    wrong = ["none.md", "tmp/peers.png", "other.md#none", "#nowhere", "report.html#none", "gone.md", "cell.md"]
    page.write_text(
        good + "[a](none.md) ![b](tmp/peers.png) [c](other.md#none) [d](#nowhere) [e](report.html#none) [f]\n\n"
        "[f]: gone.md\n\n| table |\n| :-- |\n| [g](cell.md) |\n",
        encoding="utf-8",
    )
    assert broken(page) == wrong


def test_broken_links_of_a_notebook_are_found(tmp_path):
    cells = [
        {"cell_type": "markdown", "source": ["# A\n", "[b](none.md)"]},
        {"cell_type": "code", "source": ["[c](d)"]},
    ]
    page = tmp_path / "page.ipynb"
    page.write_text(json.dumps({"cells": cells}), encoding="utf-8")
    assert broken(page) == ["none.md"]


def test_names_of_missing_files_are_found(tmp_path):
    (tmp_path / "fmu").mkdir()
    (tmp_path / "fmu" / "here.py").touch()
    text = "`fmu/here.py`, `fmu/samplers/gone.py`, `tests/gone.py::test_it`, `sampling.py`, fmu/in_prose.py"
    assert missing_files(text, tmp_path) == ["fmu/samplers/gone.py", "tests/gone.py"]


def test_names_that_a_module_does_not_have_are_found(tmp_path):
    (tmp_path / "fem").mkdir()
    (tmp_path / "fem" / "beam.py").write_text("class Beam:\n    def stiffness(self): ...\n", encoding="utf-8")
    right = "`fem/beam.py` `Beam.stiffness`, `beam.py`\n`Beam`, `tests/fem/test_beam.py`"
    wrong = "`beam.py` `Plate`, `fem/plate.py`, `fem/beam.py` `Beam.mass`"
    assert wrong_names(f"{right}, {wrong}", tmp_path) == ["beam.py Plate", "fem/plate.py", "fem/beam.py Beam.mass"]
