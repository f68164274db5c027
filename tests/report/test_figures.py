"""Figures that answer: their data are those drawn, the pointer and the keys read them, and they can be kept."""

import csv
import io
import xml.etree.ElementTree as ET

import numpy as np
import pytest

from fmu.report import plots
from fmu.report.document import picture
from fmu.report.figure_data import figure_data, linked_draws
from fmu.report.packed import pack
from tests.report.browser import needs_browser
from tests.report.parsed import IMAGE
from tests.report.test_structure_view import unpacked


def test_the_data_are_what_is_drawn(beam_traces):
    trace = beam_traces["hmc"]
    axes = plots.plot_running_means(trace)
    found = unpacked(picture(axes, "means", "1", "").packed)
    assert found["every"] == 1
    for panel, one in zip(found["panels"], axes, strict=True):
        lines = [line for line in one.lines if line.get_transform() == one.transData]
        assert [series["label"] for series in panel["series"]] == ["chain 1", "chain 2"]
        assert panel["x"]["log"]
        assert panel["y"]["label"].endswith("/ GPa")
        assert panel["x"]["range"] == pytest.approx(one.get_xlim())
        for series, line in zip(panel["series"], lines, strict=True):
            np.testing.assert_allclose(series["x"], line.get_xdata(), atol=1e-4 * np.ptp(line.get_xdata()))
            np.testing.assert_allclose(series["y"], line.get_ydata(), atol=1e-4 * np.ptp(line.get_ydata()))
        left, top, width, height = panel["box"]
        place = one.get_position()
        size = 72.0 * one.figure.get_size_inches()
        assert (left, width) == pytest.approx((place.x0 * size[0], place.width * size[0]))
        assert (top, height) == pytest.approx(((1 - place.y1) * size[1], place.height * size[1]))


def test_long_paths_are_thinned_and_it_is_said(beam_traces):
    axes = plots.plot_traces({"": beam_traces["hmc"]})
    found = figure_data(axes[0, 0].figure, most=200)
    assert found["every"] == 6  # 5 parameters, 2 chains, 120 steps
    series = found["panels"][0]["series"][0]
    np.testing.assert_array_equal(series["x"], np.arange(1, 121, 6))


def test_intervals_matrices_and_bars_have_their_values(beam_traces):
    trace = beam_traces["hmc"]
    (panel,) = figure_data(plots.plot_frequency_updates(trace).figure)["panels"]
    spans = [one for one in panel["series"] if one["kind"] == "spans"]
    assert any(np.all(one["high"] > one["y"]) for one in spans)
    assert next(iter(panel["x"]["named"].values())).startswith("1 ")
    error = next(one for one in panel["series"] if one["kind"] == "points")["y"]
    assert not any(np.array_equal(end, error) for one in spans for end in (one["y"], one["high"]))  # stems
    (panel,) = figure_data(plots.plot_mac(trace).figure)["panels"]  # without the colour bar
    (cells,) = panel["series"]
    np.testing.assert_allclose(
        np.reshape(cells["values"], (5, 5)),
        trace["modes"]["mac"].sel(state="posterior mean").to_numpy(),
        atol=1e-12,
    )


def test_cells_are_at_the_names_of_their_rows_and_columns(beam_traces):
    for plot in (plots.plot_mac, plots.plot_sensitivity):
        (panel,) = figure_data(plot(beam_traces["hmc"]).figure)["panels"]
        (cells,) = panel["series"]
        for axis in ("x", "y"):
            assert sorted(set(cells[axis])) == sorted(map(float, panel[axis]["named"]))


def test_draws_and_their_frequencies_belong_together(beam_traces):
    trace = beam_traces["hmc"]
    names = ("E1", "E4")
    found = linked_draws(plots.plot_corner(trace, names=names), trace, names)["pairs"]
    assert len(found["panels"]) == 4
    assert (found["names"], found["units"]) == (["E1", "E4"], ["GPa", "GPa"])
    np.testing.assert_array_equal(found["columns"][1], trace["posterior"]["E4"].to_numpy().ravel() / 1e9)
    hz = trace["posterior_predictive"]["model_frequency"].to_numpy().reshape(-1, 5)
    np.testing.assert_array_equal(np.transpose([mode["hz"] for mode in found["modes"]]), hz)
    assert [mode["measured"] for mode in found["modes"]] == trace["observed_data"]["frequency"].to_numpy().tolist()
    unpacked(pack(found))


# ---- in a browser

_KEPT = """
window.kept = [];
URL.createObjectURL = blob => { blob.text().then(text => kept.push(text)); return '#'; };
HTMLAnchorElement.prototype.click = function () { kept.push(this.download); };
"""

_UNTIL_READY = """const [stage, done] = arguments;
const wait = () => stage.querySelector('.tip') ? done() : setTimeout(wait, 20);
wait();"""


@pytest.fixture
def page(browser, beam_report):
    size = {"width": 1280, "height": 740, "deviceScaleFactor": 1, "mobile": False}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    browser.get((beam_report / "hmc.html").as_uri())
    return browser


def keep(browser, section, kind):
    """Return name and text of the file of the first figure of a section."""
    browser.execute_script(_KEPT)
    return browser.execute_async_script(
        """const [section, kind, done] = arguments;
           const tools = [...document.querySelectorAll(`#${section} figure.plot .tool`)];
           tools.find(e => e.textContent === kind).click();
           const is_name = text => /^[\\w-]+\\.\\w+$/.test(text), is_text = text => !is_name(text);
           const both = () => [kept.find(is_name), kept.find(is_text)];
           const wait = () => kept.length < 2 ? setTimeout(wait, 20) : done(both());
           wait();""",
        section,
        kind,
    )


@needs_browser
def test_every_figure_can_be_kept(page, beam_traces):
    figures, tools = page.execute_script(
        """const all = [...document.querySelectorAll('figure.plot')];
           return [all.length, all.filter(e => /SVG/.test(e.querySelector('.tools')?.textContent)).length];"""
    )
    assert figures == tools > 8
    name, text = keep(page, "frequencies", "CSV")
    assert name == "frequencies.csv"
    rows = list(csv.reader(io.StringIO(text)))
    assert rows[0] == [
        "panel",
        "series",
        "mode, measured frequency",
        "(computed − measured)/measured, %",
        "upper end",
    ]
    after = [row for row in rows if row[1].startswith("after: mean") and not row[4]]
    table = beam_traces["hmc"]["posterior_predictive"]["model_frequency"].mean(("chain", "draw")).to_numpy()
    measured = beam_traces["hmc"]["observed_data"]["frequency"].to_numpy()
    np.testing.assert_allclose([float(row[3]) for row in after], 100 * (table / measured - 1), atol=1e-3)
    assert after[0][2] == "1 31.9 Hz"
    name, text = keep(page, "frequencies", "SVG")
    assert name == "frequencies.svg"
    assert ET.fromstring(text).tag == "{http://www.w3.org/2000/svg}svg"
    name, text = keep(page, "pairs", "CSV")
    rows = list(csv.reader(io.StringIO(text)))
    assert rows[0] == [*(f"E{k} / GPa" for k in range(1, 6)), *(f"mode {k} / Hz" for k in range(1, 6))]
    draws = beam_traces["hmc"]["posterior"]["E2"].to_numpy().ravel() / 1e9
    np.testing.assert_allclose([float(row[1]) for row in rows[1:]], draws, atol=1e-4 * np.ptp(draws))
    assert page.get_log("browser") == []


@needs_browser
def test_pointer_and_keys_read_the_values(page):
    from selenium.webdriver.common.by import By
    from selenium.webdriver.common.keys import Keys

    stage = page.find_element(By.CSS_SELECTOR, "#settling figure.plot .drawing")
    page.execute_script("arguments[0].scrollIntoView({block: 'center', behavior: 'instant'})", stage)
    page.execute_async_script(_UNTIL_READY, stage)
    stage.send_keys(Keys.ARROW_RIGHT)
    tip = stage.find_element(By.CSS_SELECTOR, ".tip")
    assert tip.text.startswith("chain 1. lag / steps: 0; E1: 1")
    stage.send_keys(Keys.ARROW_RIGHT, Keys.ARROW_DOWN)
    assert tip.text.startswith("chain 2. lag / steps: 1; E1: ")
    stage.send_keys(Keys.ESCAPE)
    assert not tip.is_displayed()
    page.execute_script(  # the pointer on the first point of a path; the first one is the line at zero
        """const svg = arguments[0].querySelector('svg'), box = svg.getBoundingClientRect();
           const at = svg.querySelectorAll('path[clip-path]')[1].getPointAtLength(0);
           const scale = box.width / svg.viewBox.baseVal.width;
           const place = {clientX: box.x + scale * at.x, clientY: box.y + scale * at.y};
           arguments[0].dispatchEvent(new PointerEvent('pointermove', place));""",
        stage,
    )
    assert "lag / steps: 0; E1: 1" in tip.text


@needs_browser
def test_a_range_of_the_abscissa_is_drawn_larger(page):
    from selenium.webdriver import ActionChains
    from selenium.webdriver.common.by import By

    stage = page.find_element(By.CSS_SELECTOR, "#paths figure.plot .drawing")
    page.execute_script("arguments[0].scrollIntoView({block: 'start', behavior: 'instant'})", stage)
    page.execute_async_script(_UNTIL_READY, stage)
    before = stage.screenshot_as_png
    (
        ActionChains(page, 20)
        .move_to_element_with_offset(stage, 0, -200)
        .click_and_hold()
        .move_by_offset(60, 5)
        .release()
        .perform()
    )
    drawn = "return document.querySelectorAll('#paths figure.plot polyline').length"
    assert page.execute_script(drawn) == 10
    assert stage.screenshot_as_png != before
    find = "[...document.querySelectorAll('#paths .tool')].find(e => e.textContent === 'Show all')"
    page.execute_script(f"{find}.click()")
    assert page.execute_script(drawn) == 0


@needs_browser
def test_a_range_of_a_parameter_chooses_draws_and_frequencies(page, beam_traces):
    page.execute_script("document.querySelector('#pairs').scrollIntoView({block: 'start', behavior: 'instant'})")
    said = page.execute_async_script(
        """const done = arguments[0], wait = () => {
             const end = document.querySelector('#pairs input[type=range]');
             if (!end) { setTimeout(wait, 20); return; }
             end.value = 60; end.dispatchEvent(new Event('input'));
             done([document.querySelector('#pairs .bar [role=status]').textContent,
                   [...document.querySelectorAll('#pairs .strip svg')].map(e => e.getAttribute('aria-label'))]);
           }; wait();"""
    )
    draws = beam_traces["hmc"]["posterior"]["E1"].to_numpy().ravel()
    chosen = draws >= draws.min() + 0.6 * np.ptp(draws)
    assert said[0].startswith("E1 ")
    assert said[0].endswith(f"{int(chosen.sum())} of {len(draws)} draws")
    hz = beam_traces["hmc"]["posterior_predictive"]["model_frequency"].to_numpy().reshape(len(draws), -1)[chosen]
    for label, mean in zip(said[1], hz.mean(axis=0), strict=True):
        assert float(label.split(": ")[1].split(" Hz")[0]) == pytest.approx(mean, rel=6e-5)  # five digits


@needs_browser
def test_columns_are_sorted_by_number(page):
    from selenium.webdriver.common.by import By
    from selenium.webdriver.common.keys import Keys

    head = page.find_element(By.XPATH, "//section[@id='parameters']//th[@scope='col'][.='sd']")
    column = (
        "return [...document.querySelectorAll('#parameters tbody tr')].map(e => e.cells[arguments[0]].textContent)"
    )
    at = page.execute_script("return arguments[0].cellIndex", head)
    given = page.execute_script(column, at)
    button = head.find_element(By.CSS_SELECTOR, "button")
    button.send_keys(Keys.ENTER)
    assert page.execute_script(column, at) == sorted(given, key=float)
    assert head.get_attribute("aria-sort") == "ascending"
    button.send_keys(Keys.ENTER)
    assert page.execute_script(column, at) == sorted(given, key=float, reverse=True)
    button.send_keys(Keys.ENTER)
    assert page.execute_script(column, at) == given


@needs_browser
def test_names_stay_text_in_scripts_and_files(browser, hostile_report):
    browser.get((hostile_report / "hmc.html").as_uri())
    name, text = keep(browser, "parameters", "CSV")
    assert name == "updates.csv"
    assert any(IMAGE in cell for row in csv.reader(io.StringIO(text)) for cell in row)
    browser.execute_script(
        "document.querySelector('#pairs').scrollIntoView({block: 'start', behavior: 'instant'})"
    )
    options = browser.execute_async_script(
        """const done = arguments[0], options = () => [...document.querySelectorAll('#pairs option')];
           const wait = () => options().length ? done(options().map(e => e.textContent)) : setTimeout(wait, 20);
           wait();"""
    )
    assert options[0] == IMAGE
    assert browser.execute_script("return document.images.length") == 0
    assert browser.get_log("browser") == []
