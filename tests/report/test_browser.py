"""Pages in a real browser, on a phone and on a desk: nothing fails, nothing leaves the file, nothing sticks out.

Needs Debian's chromium and chromium-driver; skipped where they are not installed.
"""

import json
import shutil

import pytest

BROWSER, DRIVER = shutil.which("chromium"), shutil.which("chromedriver")
pytestmark = pytest.mark.skipif(
    not (BROWSER and DRIVER), reason="needs chromium and chromedriver (Debian: chromium, chromium-driver)"
)
WIDTHS = {"phone": 360, "desk": 1280}
SCREEN = 740
OPTIONS = (
    "headless=new", "no-sandbox", "disable-gpu", "disable-quic", "no-first-run", "disable-dev-shm-usage",
    "disable-background-networking", "disable-component-update", "disable-sync", "hide-scrollbars",
)  # fmt: skip


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    from selenium.webdriver import Chrome
    from selenium.webdriver.chrome.options import Options
    from selenium.webdriver.chrome.service import Service

    options = Options()
    options.binary_location = BROWSER
    for option in (*OPTIONS, f"user-data-dir={tmp_path_factory.mktemp('profile')}"):
        options.add_argument(f"--{option}")
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    driver = Chrome(options=options, service=Service(DRIVER))
    yield driver
    driver.quit()


@pytest.fixture(scope="module", params=WIDTHS)
def width(browser, request):
    size = {"width": WIDTHS[request.param], "height": SCREEN, "deviceScaleFactor": 1, "mobile": False}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    return WIDTHS[request.param]


@pytest.fixture(
    scope="module", params=["beam_report/hmc", "beam_report/index", "hostile_report/hmc", "plain_report/mh"]
)
def page(browser, width, request):
    """A page, open at a width: its address, what the console said, and every address that was asked for."""
    report, _, name = request.param.partition("/")
    address = (request.getfixturevalue(report) / f"{name}.html").as_uri()
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
        """return [...document.querySelectorAll('h1,h2,h3,p,li,figcaption,caption,summary,.verdict,svg[role]')]
           .filter(e => !e.closest('.wide') && e.getBoundingClientRect().right > innerWidth + 0.5)
           .map(e => e.outerHTML.slice(0, 120));"""
    )
    assert outside == []


@pytest.mark.usefixtures("page")
def test_every_image_has_a_name_and_a_size(browser):
    from selenium.webdriver.common.by import By

    images = browser.find_elements(By.CSS_SELECTOR, "svg, img")
    assert images
    for image in images:
        assert image.aria_role in ("img", "image")
        assert len(image.accessible_name) > 20
        assert image.size["width"] > 200
        assert image.size["height"] > 80


@pytest.mark.usefixtures("page")
def test_all_verdicts_are_on_the_first_screen(browser):
    bottoms = browser.execute_script(
        "return [...document.querySelectorAll('.verdict')].map(e => e.getBoundingClientRect().bottom);"
    )
    assert len(bottoms) == 3
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
        assert browser.execute_script("return document.scripts.length + document.images.length") == 0
        browser.get_log("browser")
