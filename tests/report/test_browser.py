"""Pages in a browser, on a phone, a desk and paper: nothing fails, leaves the file, sticks out or overlaps.

Needs Debian's chromium and chromium-driver; skipped where they are not installed.
"""

import base64
import json
import re
import zlib

import pytest

from tests.report.browser import needs_browser, short_run

pytestmark = needs_browser
WIDTHS = {"phone": 390, "tablet": 768, "desk": 1280}
SEEN = ("phone", pytest.param("tablet", marks=pytest.mark.validate), "desk")
PAGES = (
    "beam_report/hmc", "beam_report/index", "garteur_report/mh", "hostile_report/hmc",
    *(pytest.param(name, marks=pytest.mark.validate) for name in ("plain_report/mh", "storeys_report/mh")),
)  # fmt: skip
PRINTED = (
    "beam_report/index", "garteur_report/mh",
    *(pytest.param(name, marks=pytest.mark.validate)
      for name in ("beam_report/hmc", "hostile_report/hmc", "plain_report/mh", "storeys_report/mh")),
)  # fmt: skip
PAPER = {"width": 703, "height": 1017}  # A4 without margins, in CSS pixels
SCREEN = 740


@pytest.fixture(scope="module", params=SEEN)
def width(browser, request):
    size = {"width": WIDTHS[request.param], "height": SCREEN, "deviceScaleFactor": 1, "mobile": False}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    return WIDTHS[request.param]


@pytest.fixture(scope="module")
def storeys_report(tmp_path_factory):
    """Directory of a page on twelve parameters, with measured shapes and no geometry."""
    return short_run("shear-10dof", tmp_path_factory.mktemp("storeys"))


def address_of(name, request):
    """Return the address of a page, ``"REPORT/PAGE"``."""
    report, _, name = name.partition("/")
    return (request.getfixturevalue(report) / f"{name}.html").as_uri()


@pytest.fixture(scope="module", params=PAGES)
def page(browser, width, request):
    """A page, open at a width: its address, what the console said, and every address that was asked for."""
    address = address_of(request.param, request)
    for log in ("browser", "performance"):
        browser.get_log(log)  # what earlier pages left there
    browser.get(address)
    messages = [json.loads(entry["message"])["message"] for entry in browser.get_log("performance")]
    requests = [message["params"] for message in messages if message["method"] == "Network.requestWillBeSent"]
    return address, browser.get_log("browser"), [params["request"]["url"] for params in requests]


def test_console_is_silent_and_no_request_leaves_the_file(page):
    address, console, asked = page
    assert console == []
    assert address in asked
    assert [url for url in asked if url != address and not url.startswith("data:")] == []


@pytest.mark.usefixtures("page")
def test_nothing_sticks_out_of_the_screen(browser, width):
    assert browser.execute_script("return innerWidth") == width
    assert browser.execute_script("return document.documentElement.scrollWidth") <= width
    outside = browser.execute_script(
        """return [...document.querySelectorAll('body *')].filter(e => e.checkVisibility() && !e.closest('.skip'))
           .filter(e => !e.parentElement.closest('.wide, .scroll, pre, svg'))
           .filter(e => e.getBoundingClientRect().right > innerWidth + 0.5)
           .map(e => e.outerHTML.slice(0, 120));"""
    )
    assert outside == []


@pytest.mark.usefixtures("page")
def test_wide_figures_are_whole_on_a_desk(browser, width):
    hidden = browser.execute_script(
        """return [...document.querySelectorAll('.drawing')].filter(e => e.scrollWidth > e.clientWidth)
           .map(e => e.parentElement.innerText);"""
    )
    assert hidden == [] or width == WIDTHS["phone"]


@pytest.mark.usefixtures("page")
def test_text_in_figures_is_whole_and_does_not_overlap(browser):
    cut, overlapping = browser.execute_script(_TEXT_IN_FIGURES)
    assert cut == []
    assert overlapping == []


@pytest.mark.usefixtures("page")
def test_nothing_drawn_leaves_the_box_of_its_figure(browser):
    assert browser.execute_script(_EXTENTS) == []


@pytest.mark.usefixtures("page")
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_words_stand_out_from_what_is_behind_them(browser, scheme):
    """Contrast of WCAG 2.2, 1.4.3 (AA): 4.5, or 3 for large letters."""
    media = {"features": [{"name": "prefers-color-scheme", "value": scheme}]}
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", media)
    found = browser.execute_script(_CONTRAST)
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})
    assert found["n"] > 100
    assert found["background"] == ("rgb(20, 23, 27)" if scheme == "dark" else "rgb(255, 255, 255)")
    assert found["low"] == []


@pytest.mark.usefixtures("page")
def test_every_control_is_reached_by_the_keyboard_and_has_a_name(browser):
    unreachable, nameless = browser.execute_script(
        """const all = document.querySelectorAll('button, select, input, a[href], summary, canvas, .scroll');
           const controls = [...all].filter(e => e.checkVisibility());
           const name = e => e.ariaLabel || e.textContent.trim() || e.labels?.[0]?.textContent;
           return [controls.filter(e => e.tabIndex < 0 || e.disabled), controls.filter(e => !name(e))]
             .map(list => list.map(e => e.outerHTML.slice(0, 100)));"""
    )
    assert unreachable == []
    assert nameless == []


@pytest.mark.usefixtures("page")
def test_every_image_has_a_name_and_a_size(browser, width):
    from selenium.webdriver.common.by import By

    browser.execute_script("document.querySelectorAll('details').forEach(e => e.open = true)")
    images = browser.find_elements(By.CSS_SELECTOR, "svg, img")
    assert images
    sizes = browser.execute_script(
        """return arguments[0].map(e => e.getBoundingClientRect()).map((box, i) =>
             [box.width, box.height, arguments[0][i].closest('header') ? 20 : 80]);""",
        images,
    )
    assert [size for size in sizes if size[0] <= 200 or size[1] <= size[2]] == []
    if width == WIDTHS["desk"]:  # names do not depend on the width
        for image in images:
            assert image.aria_role in ("img", "image")
            assert len(image.accessible_name) > 20


@pytest.mark.usefixtures("page")
def test_all_verdicts_are_on_the_first_screen(browser):
    bottoms = browser.execute_script(
        "return [...document.querySelectorAll('.verdict')].map(e => e.getBoundingClientRect().bottom);"
    )
    assert len(bottoms) == (6 if "samplers" in browser.title else 5)
    assert max(bottoms) < SCREEN


@pytest.mark.usefixtures("page")
def test_text_in_figures_can_be_read(browser):
    smallest = browser.execute_script(
        """return Math.min(...[...document.querySelectorAll('svg text')].map(e =>
             parseFloat(getComputedStyle(e).fontSize) * e.ownerSVGElement.getScreenCTM().a));"""
    )
    assert smallest > 7.0


def test_keyboard_reaches_the_verdict_first(browser, width, beam_report):
    from selenium.webdriver.common.by import By
    from selenium.webdriver.common.keys import Keys

    browser.get((beam_report / "hmc.html").as_uri())
    browser.find_element(By.TAG_NAME, "body").send_keys(Keys.TAB)
    focused = browser.switch_to.active_element
    assert focused.text == "Skip to the verdict"
    focused.send_keys(Keys.ENTER)
    assert browser.current_url.endswith("#verdict")


def test_names_do_not_run(browser, hostile_report):
    for path in hostile_report.glob("*.html"):
        browser.get(path.as_uri())
        assert browser.execute_script(
            """return document.images.length === 0 && [...document.scripts].every(
                 e => e.type === 'application/octet-stream' || e === document.body.lastElementChild);"""
        )
        assert browser.title.startswith("</title><script>")
        browser.get_log("browser")


_EXTENTS = """
const found = [];
for (const svg of document.querySelectorAll('figure.plot > .drawing > svg')) {
  const box = svg.getBoundingClientRect();
  for (const e of svg.querySelectorAll('path, use, line, polyline, polygon, rect, circle, image')) {
    if (e.closest('defs, clipPath, [clip-path]') || e.getAttribute('visibility') === 'hidden') continue;
    const {left, right, top, bottom, width, height} = e.getBoundingClientRect();
    if (!(width || height)) continue;
    if (left < box.left - 1 || right > box.right + 1 || top < box.top - 1 || bottom > box.bottom + 1)
      found.push(`${svg.ariaLabel.slice(0, 40)}: ${e.outerHTML.slice(0, 80)}`);
  }
}
return found;
"""
_CONTRAST = """
const channels = text => (text.match(/[\\d.]+/g) || []).map(Number);
const linear = x => x <= 0.04045 ? x / 12.92 : ((x + 0.055) / 1.055) ** 2.4;
const luminance = c => [0.2126, 0.7152, 0.0722].reduce((sum, weight, i) => sum + weight * linear(c[i] / 255), 0);
const behind = e => {
  for (; e; e = e.parentElement) {
    const c = channels(getComputedStyle(e).backgroundColor);
    if (c.length === 3 || c[3] > 0.99) return c;
  }
  return [255, 255, 255];
};
const low = [];
let n = 0;
for (const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT); walker.nextNode();) {
  const e = walker.currentNode.parentElement, words = walker.currentNode.textContent.trim();
  if (!words || !e.checkVisibility() || e.closest('svg text, script, style, .unseen, .skip, option')) continue;
  const style = getComputedStyle(e), [a, b] = [luminance(channels(style.color)), luminance(behind(e))];
  const contrast = (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05), size = parseFloat(style.fontSize);
  n++;
  const is_large = size >= 24 || size >= 18.66 && style.fontWeight >= 700;
  if (contrast < (is_large ? 3 : 4.5)) low.push([words.slice(0, 40), contrast]);
}
return {n, low, background: getComputedStyle(document.body).backgroundColor};
"""
_TEXT_IN_FIGURES = """
const corners = text => {
  const box = text.getBBox(), m = text.getCTM(), [dx, dy] = [0.03 * box.width, 0.2 * box.height];
  const [right, low] = [box.width - dx, box.height - dy];
  return [[dx, dy], [right, dy], [right, low], [dx, low]].map(([x, y]) => {
    const p = new DOMPoint(box.x + x, box.y + y).matrixTransform(m);
    return [p.x, p.y];
  });
};
// rectangles are apart if the normal of an edge of one of them separates them
const apart = (a, b) => [a, b].some(box => [0, 1].some(i => {
  const [nx, ny] = [box[i][1] - box[i + 1][1], box[i + 1][0] - box[i][0]];
  const [p, q] = [a, b].map(c => c.map(([x, y]) => nx * x + ny * y));
  return Math.max(...p) <= Math.min(...q) || Math.max(...q) <= Math.min(...p);
}));
const cut = [], overlapping = [];
for (const svg of document.querySelectorAll('svg[role]')) {
  const texts = [...svg.querySelectorAll('text')].filter(text => text.textContent.trim());
  const found = texts.map(text => [text.textContent, corners(text)]);
  const [w, h] = [svg.clientWidth, svg.clientHeight];
  for (const [words, box] of found)
    if (box.some(([x, y]) => x < -1 || y < -1 || x > w + 1 || y > h + 1)) cut.push(words);
  found.forEach(([words, box], i) => found.slice(0, i).forEach(([other, beside]) => {
    if (!apart(box, beside)) overlapping.push([other, words]);
  }));
}
return [cut, overlapping];
"""


@pytest.mark.parametrize("name", PRINTED)
def test_print_has_no_empty_page_and_no_figure_longer_than_one(browser, name, request):
    browser.get(address_of(name, request))
    size = PAPER | {"deviceScaleFactor": 1, "mobile": False}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print"})
    tallest, widest = browser.execute_script(
        """const boxes = [...document.querySelectorAll('figure')].map(e => e.getBoundingClientRect());
           return [Math.max(...boxes.map(b => b.height)), Math.max(...boxes.map(b => b.right))];"""
    )
    assert tallest < PAPER["height"]
    assert widest <= PAPER["width"] + 1
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": ""})
    printed = base64.b64decode(browser.execute_cdp_cmd("Page.printToPDF", {"preferCSSPageSize": True})["data"])
    contents = contents_of_pages(printed)
    assert len(contents) > 1
    assert all(b"BT" in content for content in contents)


def contents_of_pages(pdf):
    """Return the drawing commands of each page; BT begins a text."""
    objects = dict(re.findall(rb"(?:^|\n)(\d+) 0 obj\n(.*?)\nendobj", pdf, re.DOTALL))
    pages = [body for body in objects.values() if re.search(rb"/Type /Page\b(?!s)", body)]
    found = []
    for body in pages:
        (number,) = re.findall(rb"/Contents (\d+) 0 R", body)
        stream = objects[number].partition(b"stream\n")[2].rpartition(b"\nendstream")[0]
        found.append(zlib.decompress(stream))
    return found
