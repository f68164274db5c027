"""What leads a page: losses, then frequencies; what follows is folded where it is long."""

import re

import pandas as pd
import pytest

from fmu.report.pages import prose, write_pages
from fmu.report.plots import plot_losses
from fmu.report.run import runs_of
from fmu.report.sections import origin
from fmu.report.sections.tests import _lost_in
from fmu.report.sections.verdicts import verdicts
from tests.mast import NAMES, damaged
from tests.report.browser import needs_browser
from tests.report.conftest import without_layout
from tests.report.parsed import Parsed


@pytest.fixture(scope="module")
def damage_page(tmp_path_factory):
    """The page of the run on the damaged mast."""
    with without_layout():
        return write_pages({"hmc": damaged()}, tmp_path_factory.mktemp("mast"))


def judged(faster=1.0):
    """Return the verdicts on a run on the mast."""
    (run,) = runs_of({"hmc": damaged(faster)}).values()
    return run, verdicts(run)


def test_losses_lead_the_first_screen():
    _, (first, fit, reference, *_) = judged()
    assert first.question == "What was lost? After: after (test second)"
    assert re.fullmatch(r"columns 1 (2\d|3\d) %", first.answer)
    assert re.search(r"90 % interval \d+\.\d to \d+\.\d %, P\(loss > 5 %\) > 99 %", first.said)
    assert first.tone == "bad"
    assert fit.question == "Does the model fit the data?"
    assert reference.question == "How was the reference state corrected?"
    assert "loss" not in reference.answer


def test_a_contradicted_model_is_named_beside_the_loss():
    run, (first, *_) = judged(2.0)
    assert f"the model is {run.diagnosis.fit.answer}." in first.said
    assert "Do not rely on P" in first.said


def test_the_largest_of_losses_that_are_all_improbable_is_named():
    run, _ = judged()
    rows = {"gained": (-0.3, 0.01, -0.32, -0.28, 0.0), "kept": (0.01, 0.01, 0.0, 0.03, 0.0)}
    table = pd.DataFrame.from_dict(rows, orient="index", columns=["mean", "sd", "lower", "upper", "P(loss > 5 %)"])
    assert _lost_in(run, "after", table, "").said.startswith("Most probable: kept ")


def test_damage_and_frequencies_stand_before_the_reasons(damage_page):
    page = Parsed(damage_page.read_text(encoding="utf-8"))
    titles = [title for level, title in page.headings if level == 2]
    assert titles[:5] == ["Verdict", "Damage", "Frequencies", "Assumptions and reasons", "Updated parameters"]
    head = damage_page.read_text(encoding="utf-8").partition("</header>")[0]
    assert '<div class="states">' in head
    assert "#9C1414" in head  # the storey that lost, in the structure of the first screen


def test_the_page_of_one_sampler_is_the_index(damage_page):
    assert [path.name for path in damage_page.parent.iterdir()] == ["index.html"]
    page = Parsed(damage_page.read_text(encoding="utf-8"))
    assert "Hamiltonian Monte Carlo" in page.text
    assert "All samplers" not in page.text
    assert "Samplers side by side" not in page.text


def test_no_line_crosses_the_probabilities():
    figure = plot_losses(damaged())[0].figure
    figure.canvas.draw()
    for axis in figure.axes:
        (limit,) = [line for line in axis.lines if line.get_linestyle() == "--"]
        at = axis.transData.transform((0.0, limit.get_ydata()[0]))[1]
        boxes = [text.get_window_extent() for text in axis.texts]
        assert len(boxes) == len(NAMES)
        assert all(box.y0 > axis.get_window_extent().y1 - 1.0 > at for box in boxes)


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("put `use = false` at a <mode>", "put <code>use = false</code> at a &lt;mode&gt;"),
        ("one ` alone", "one ` alone"),
        ("`<b>`", "<code>&lt;b&gt;</code>"),
    ],
)
def test_backticks_become_code(text, found):
    assert prose(text) == found


def test_pages_have_no_backticks(damage_page, beam_report):
    for path in (damage_page, *beam_report.glob("*.html")):
        words = Parsed(path.read_text(encoding="utf-8")).text
        assert "`" not in words


def test_settings_are_words(damage_page):
    (run,) = runs_of({"hmc": damaged()}).values()
    given, _, folded = origin.settings(run).parts
    everything = getattr(folded, "parts", (folded,))[0]
    cells = [cell for table in (given, everything) for row in table.rows for cell in row]
    assert len(cells) > 100
    assert not [cell for cell in cells if re.search(r"[{\[]\"|\\", cell)]
    settings = {row[0]: row[1:] for row in given.rows}
    assert "step size" in settings


def test_colours_of_figures_follow_the_scheme(damage_page):
    text = damage_page.read_text(encoding="utf-8")
    drawings = re.findall(r'<div class="drawing[^>]*>(<svg.*?</svg>)', text, re.DOTALL)
    assert len(drawings) > 4
    for svg in drawings:
        styles = " ".join(re.findall(r'style="([^"]*)"', svg))
        assert not re.search(r"(?<!,)#(000000|ffffff|6e6e6e)\b", styles)
    assert "var(--ink,#000000)" in text


@needs_browser
def test_figures_are_dark_where_the_page_is(browser, damage_page):
    media = {"features": [{"name": "prefers-color-scheme", "value": "dark"}]}
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", media)
    browser.get(damage_page.as_uri())
    paper, backgrounds, words = browser.execute_script(
        """const figure = document.querySelector('#frequencies .drawing svg'), of = e => getComputedStyle(e).fill;
           return [getComputedStyle(document.body).backgroundColor, of(figure.querySelector('path')),
                   [...figure.querySelectorAll('text')].map(of)];"""
    )
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})
    assert paper == backgrounds == "rgb(20, 23, 27)"
    assert all(min(map(int, re.findall(r"\d+", colour))) > 150 for colour in words)


@needs_browser
def test_the_desk_is_used_and_nothing_collides(browser, beam_report):
    size = {"width": 1280, "height": 740, "deviceScaleFactor": 1, "mobile": False}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    browser.get((beam_report / "hmc.html").as_uri())
    right, overlaps = browser.execute_script(
        """const boxes = [...document.querySelectorAll('nav li a')].flatMap(e => [...e.getClientRects()]);
           const numbers = [...document.querySelectorAll('nav li')].map(e => e.getBoundingClientRect());
           const cross = (a, b, from, to) => a[from] < b[to] - 0.5 && b[from] < a[to] - 0.5;
           const meet = (a, b) => cross(a, b, 'left', 'right') && cross(a, b, 'top', 'bottom');
           return [document.querySelector('#frequencies figure.plot').getBoundingClientRect().right,
                   numbers.flatMap((a, i) => numbers.slice(i + 1).filter(b => meet(a, b))).length
                   + boxes.filter(a => numbers.filter(b => meet(a, b)).length > 1).length];"""
    )
    assert right > 0.9 * 1280
    assert overlaps == 0


@needs_browser
@pytest.mark.parametrize("width", [1280, 390])
def test_lone_figures_leave_less_than_half_of_the_screen_white(browser, damage_page, width):
    size = {"width": width, "height": 740, "deviceScaleFactor": 1, "mobile": False}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    browser.get(damage_page.as_uri())
    white = browser.execute_script(
        """const seen = what => [...document.querySelectorAll(what)].filter(e => e.checkVisibility());
           const all = seen('.drawing, figcaption, .scroll').map(e => e.getBoundingClientRect());
           return seen('.drawing').filter(e => {
             const own = e.getBoundingClientRect(), level = (own.top + own.bottom) / 2;
             const beside = all.filter(other => other.top < level && level < other.bottom);
             return Math.max(...beside.map(other => other.right)) < 0.5 * innerWidth;
           }).map(e => e.parentElement.dataset.name);"""
    )
    assert white == []
