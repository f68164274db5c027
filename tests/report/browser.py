"""Chromium without a screen, with WebGL drawn in software; and short runs to show in it."""

import shutil

import pytest

import fmu
from fmu.report.pages import render, sampler_page
from fmu.report.run import runs_of

BROWSER, DRIVER = shutil.which("chromium"), shutil.which("chromedriver")
needs_browser = pytest.mark.skipif(
    not (BROWSER and DRIVER), reason="needs chromium and chromedriver (Debian: chromium, chromium-driver)"
)
OPTIONS = (
    "headless=new", "no-sandbox", "disable-quic", "no-first-run", "disable-dev-shm-usage",
    "disable-background-networking", "disable-component-update", "disable-sync", "hide-scrollbars",
    "use-gl=angle", "use-angle=swiftshader", "enable-unsafe-swiftshader", "force-prefers-reduced-motion",
)  # fmt: skip


def started(profile):
    """Return a browser that keeps its console and all requests."""
    from selenium.webdriver import Chrome
    from selenium.webdriver.chrome.options import Options
    from selenium.webdriver.chrome.service import Service

    options = Options()
    options.binary_location = BROWSER
    for option in (*OPTIONS, f"user-data-dir={profile}"):
        options.add_argument(f"--{option}")
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    return Chrome(options=options, service=Service(DRIVER))


def short_run(case, directory):
    """Write the page of a short run on a case, and return the directory."""
    problem = fmu.cases.load(case)
    maxima = fmu.find_map(problem, starts=2)
    runs = runs_of({"mh": fmu.sample(problem, "mh", draws=12, warmup=4, chains=2, init="prior", maxima=maxima)})
    page = sampler_page(runs["mh"], {"mh": "mh.html"}, runs)
    (directory / "mh.html").write_text(render(page), encoding="utf-8")
    return directory
