"""Pages: self-contained, described, escaped; verdicts first; what is missing is said; only our files replaced."""

import base64
import hashlib
import re
from functools import cache
from itertools import pairwise

import pytest
from click.testing import CliRunner

import fmu
from fmu.analysis.trace.conversion import save_trace
from fmu.cli import main
from fmu.report.document import Page
from fmu.report.pages import file_names, render, sampler_page, write_pages
from fmu.report.run import runs_of
from tests.report.parsed import IMAGE, SCRIPT, Parsed

LIMIT = 2_000_000
AIM = 600_000


@cache
def parse(text):
    """Parse a page once for all tests."""
    return Parsed(text)


@pytest.fixture(params=["beam_report", "hostile_report", "plain_report"])
def pages(request):
    found = {path.name: path.read_text() for path in request.getfixturevalue(request.param).glob("*.html")}
    assert "index.html" in found
    assert len(found) == 3
    return found


def test_pages_are_complete_html_with_unique_ids(pages):
    for text in pages.values():
        page = parse(text)
        assert page.open == []
        ids = page.values("id")
        assert len(ids) == len(set(ids))
        assert text.startswith("<!DOCTYPE html>")
        assert page.all("html") == [{"lang": "en"}]
        assert {"name": "viewport", "content": "width=device-width, initial-scale=1"} in page.all("meta")


def test_headings_descend_one_level_at_a_time(pages):
    for text in pages.values():
        levels = [level for level, _ in parse(text).headings]
        assert levels[0] == 1
        assert levels.count(1) == 1
        assert all(after <= before + 1 for before, after in pairwise(levels))


def test_contents_lead_to_every_section(pages):
    for name, text in pages.items():
        page = parse(text)
        targets = [a["href"][1:] for a in page.all("a") if a["href"].startswith("#")]
        sections = [section["id"] for section in page.all("section")]
        assert targets == sections, name  # the skip link leads to the verdict, the first
        others = {a["href"] for a in page.all("a") if not a["href"].startswith("#")}
        assert others == set(pages) - {name}


def test_nothing_is_fetched_from_anywhere(pages):
    for text in pages.values():
        page = parse(text)
        assert page.foreign_scripts == []
        for attribute in ("src", "href", "action", "data", "srcset", "xlink:href", "background", "poster"):
            for value in page.values(attribute):
                assert value.startswith(("#", "data:")) or re.fullmatch(r"[A-Za-z0-9_-]+\.html", value), value
        assert "@import" not in text
        assert not re.search(r"url\((?!#)", text)
        without_script, _, script = re.sub(r"base64,[^\"]*|octet-stream\">[^<]*", "", text).rpartition("<script>")
        assert "//" not in without_script
        script = script[: script.index("</script>")]
        assert not re.search(
            r"https?:(?!//www\.w3\.org/2000/svg)|\bfetch\(|XMLHttpRequest|WebSocket|innerHTML|eval\(", script
        )
        policy = next(m["content"] for m in page.all("meta") if m.get("http-equiv") == "Content-Security-Policy")
        digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
        assert policy == (
            f"default-src 'none'; script-src 'sha256-{digest}'; style-src 'unsafe-inline'; img-src data:"
        )


def test_every_image_is_described_in_numbers(pages):
    for name, text in pages.items():
        page = parse(text)
        drawings = page.all("svg")
        assert drawings, name
        assert not page.all("img")
        for drawing in drawings:
            assert drawing["role"] == "img"
            assert re.search(r"\d", drawing["aria-label"])
        assert len({drawing["aria-label"] for drawing in drawings}) == len(drawings)


def test_tables_have_captions_and_headers_and_scroll_by_keyboard(pages):
    for text in pages.values():
        page = parse(text)
        assert len(page.all("caption")) == len(page.all("table")) > 0
        assert all(th.get("scope") in ("col", "row") for th in page.all("th"))
        scrolling = [div for div in page.all("div") if div.get("class") == "scroll"]
        assert len(scrolling) == len(page.all("table"))
        assert all(div["tabindex"] == "0" and div["aria-label"] for div in scrolling)


def test_pages_are_small(pages):
    assert all(len(text.encode()) < AIM < LIMIT for text in pages.values())


def test_verdicts_come_first(beam_report):
    page = parse((beam_report / "hmc.html").read_text())
    titles = [title for _, title in page.headings]
    assert titles[:5] == [
        "cantilever-young, by shape", "Verdict", "Frequencies", "Assumptions and reasons", "Assumptions",
    ]  # fmt: skip
    assert page.text.index("✗ Not converged") < page.text.index("Contents") < page.text.index("Updated parameters")
    assert "all used data together: with the residuals r in standard deviations, Σ r² = " in page.text
    assert "provisional, because the draws have not converged" in page.text


def test_the_head_is_the_problem_its_structure_and_the_day(beam_report, beam_traces, plain_report):
    day = beam_traces["hmc"].attrs["created_at"][:10]
    for name, subtitle in (("hmc", "Hamiltonian Monte Carlo"), ("index", "Bayesian model updating by 2 samplers")):
        text = (beam_report / f"{name}.html").read_text()
        head = parse(text[text.index("<header>") : text.index("</header>")])
        assert subtitle in head.text
        assert f"Sampled on {day}." in head.text
        (drawing,) = head.all("svg")
        assert drawing["aria-label"] == "The structure: 51 nodes, 50 elements, 1 sensors"
        assert len(head.all("line")) == 50 + 1  # elements, and the arrow of the sensor
        assert [item for item in head.text.split() if item.startswith("E")] == ["E1", "E2", "E3", "E4", "E5"]
    plain = (plain_report / "hmc.html").read_text()
    assert "<svg" not in plain[plain.index("<header>") : plain.index("</header>")]


def test_a_converged_run_says_so_and_a_single_chain_does_not(plain_report):
    good, bad, index = (parse((plain_report / f"{name}.html").read_text()).text for name in ("hmc", "mh", "index"))
    assert "✓ Yes, converged" in good
    assert "Not converged" not in good
    assert "64 starts from the prior led to 1 maximum" in good[: good.index("Contents")]
    assert "✗ Not converged" in bad
    assert "1 chain; at least 2 are needed" in bad[: bad.index("Contents")]
    assert "✗ 1 of 2 converged" in index
    assert "Fewer than two samplers can be compared." in index


def test_names_are_shown_and_not_executed(hostile_report):
    files = sorted(path.name for path in hostile_report.iterdir())
    assert files == ["hmc.html", "index.html", "title-script-alert-1-script.html"]
    for name in files:
        page = parse((hostile_report / name).read_text())
        assert page.foreign_scripts == []
        assert not page.all("img")
        assert IMAGE in page.text
        assert SCRIPT in page.text
        assert "$x_1$ & &amp;" in page.text
    page = parse((hostile_report / "hmc.html").read_text())
    assert page.headings[0] == (1, SCRIPT)
    assert "</style>" in page.text


def test_what_a_trace_lacks_is_said(plain_report, hostile_report):
    plain = parse((plain_report / "hmc.html").read_text())
    missing = plain.text[plain.text.rindex("Not on this page") :]
    for words in (
        "Frequencies: the trace holds no frequencies",
        "Modal assurance criterion: the trace has no mode shapes",
        "Mode shapes before and after: the trace has no geometry",
        "Leave-one-mode-out check: the trace has no likelihood of single modes",
        "Certificate of the reduced model: no reduced model was used",
    ):
        assert words in missing
    black_box = parse((hostile_report / "hmc.html").read_text())
    titles = [title for _, title in black_box.headings]
    assert "Frequencies" in titles
    assert not any("MAC" in title or "Modal assurance" in title for title in titles)


@pytest.mark.parametrize(
    ("names", "files"),
    [
        (["hmc", "mh"], ["hmc", "mh"]),
        (["index", "../x", "a/b", "a b", "A-B"], ["index-2", "x", "a-b", "a-b-2", "A-B-3"]),
        (["", "é"], ["run", "run-2"]),
    ],
)
def test_file_names_are_plain_and_distinct(names, files):
    assert list(file_names(names).values()) == [f"{stem}.html" for stem in files]


def test_write_pages_refuses_what_is_no_comparison(beam_traces, plain_traces, tmp_path):
    with pytest.raises(ValueError, match="at least one"):
        write_pages({}, tmp_path)
    with pytest.raises(ValueError, match=r"traces\.x: must be a trace"):
        write_pages({"x": 3}, tmp_path)
    with pytest.raises(ValueError, match="of one problem"):
        write_pages({"hmc": beam_traces["hmc"], "mh": plain_traces["mh"]}, tmp_path)
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def run_directory(plain_traces, tmp_path):
    for name, trace in plain_traces.items():
        save_trace(trace, tmp_path / f"{name}.nc")
    return tmp_path


@pytest.fixture
def without_drawings(monkeypatch):
    """Pages of a title only: what is written where does not depend on what they say."""

    def empty(title):
        return Page(title, "", "", (), (), (), "")

    monkeypatch.setattr("fmu.report.pages.sampler_page", lambda run, files, runs: empty(run.name))
    monkeypatch.setattr("fmu.report.pages.index_page", lambda runs, files: empty(", ".join(runs)))


@pytest.mark.usefixtures("without_drawings")
def test_report_replaces_its_own_files_only(run_directory):
    index = fmu.write_report(run_directory)
    assert index == run_directory / "report" / "index.html"
    assert "<h1>mh, hmc</h1>" in index.read_text()
    (run_directory / "report" / "notes.txt").write_text("mine")
    (run_directory / "mh.nc").unlink()
    assert fmu.write_report(str(run_directory)) == index
    assert "<h1>hmc</h1>" in index.read_text()
    kept = sorted(path.name for path in (run_directory / "report").iterdir())
    assert kept == ["index.html", "manifest.json", "notes.txt"]


@pytest.mark.usefixtures("without_drawings")
def test_a_page_of_other_origin_is_not_replaced(run_directory):
    (run_directory / "report").mkdir()
    (run_directory / "report" / "index.html").write_text("mine")
    result = CliRunner().invoke(main, ["report", str(run_directory)])
    assert result.exit_code == 2
    assert "does not replace (index.html)" in result.stderr
    assert [path.name for path in (run_directory / "report").iterdir()] == ["index.html"]


@pytest.mark.usefixtures("without_drawings")
def test_a_failure_leaves_no_half_of_a_report(run_directory, monkeypatch):
    def fail(*args):
        raise OSError("no room left")

    monkeypatch.setattr("fmu.report.pages.index_page", fail)
    with pytest.raises(OSError, match="no room"):
        fmu.write_report(run_directory)
    assert not (run_directory / "report").exists()


@pytest.mark.usefixtures("without_drawings")
def test_command_writes_the_report(run_directory):
    result = CliRunner().invoke(main, ["report", str(run_directory)])
    assert result.exit_code == 0, result.output
    assert result.stdout == f"Written to {run_directory / 'report' / 'index.html'}\n"


@pytest.mark.parametrize(
    ("name", "words"), [("missing", "does not exist"), ("empty", "contains no traces"), ("file", "is a file")]
)
def test_wrong_directory_is_one_line(name, words, tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "file").write_text("")
    result = CliRunner().invoke(main, ["report", str(tmp_path / name)])
    assert result.exit_code == 2
    assert result.stdout == ""
    assert words in result.stderr
    assert result.stderr.count("\n") == 1


def test_same_traces_give_the_same_pages(plain_traces, plain_report):
    runs = runs_of(plain_traces)
    again = render(sampler_page(runs["mh"], file_names(runs), runs))
    assert again == (plain_report / "mh.html").read_text()
