"""The structure to be turned: it has the numbers of the trace, turns, animates, and stays out of the way."""

import base64
import json
import re
import time
import zlib
from importlib.resources import files

import numpy as np
import psutil
import pytest
import scipy.sparse as sp
import scipy.sparse.linalg

import fmu
from fmu.report.model_view import model_view
from fmu.report.packed import Rounded, pack
from fmu.report.pages import write_pages
from fmu.report.run import runs_of
from tests.report.browser import needs_browser
from tests.report.parsed import SCRIPT

PAGES = (pytest.param("beam_report/hmc", marks=pytest.mark.validate), "garteur_report/mh")
LEAST_FPS = 20.0


def unpacked(text):
    """Return what data.js makes of packed content."""
    whole = zlib.decompress(base64.b64decode(text))
    length = int.from_bytes(whole[:4], "little")

    def array(value):
        if "at" not in value:
            return value
        found = np.frombuffer(whole, f"<{value['type']}", value["n"], 4 + length + value["at"])
        if "step" not in value:
            return found
        missing = 127 if value["type"] == "i1" else 32767
        return np.where(found == missing, np.nan, value["middle"] + value["step"] * found)

    return json.loads(whole[4 : 4 + length], object_hook=array)


@pytest.mark.parametrize(("bits", "error"), [(8, 1 / 252), (16, 1 / 65532)])
def test_packed_numbers_are_the_numbers(bits, error):
    rng = np.random.default_rng(1)
    for values in (rng.normal(size=500), 7.0 + rng.random(40), np.full(50, 3.5), np.zeros(33)):
        found = unpacked(pack({"x": Rounded(values, bits)}))["x"]
        span = max(np.ptp(values), np.ptp([0.0, *values]) if values.min() <= 0.0 <= values.max() else 0.0)
        np.testing.assert_allclose(found, values, rtol=1e-12, atol=error * span)
    holes = np.where(rng.random(99) < 0.2, np.nan, 1.0 + rng.random(99))
    np.testing.assert_array_equal(np.isnan(unpacked(pack([holes]))[0]), np.isnan(holes))
    assert unpacked(pack([np.full(99, np.nan), np.arange(70_000), np.array([np.inf, 1.5])]))[2] == [None, 1.5]


@pytest.mark.parametrize(
    "ends", [(0, 9), (-1, 9), (-1, 2**15), (0, 2**16), (-(2**31), 0), (0, 2**32), (-1, 2**31)]
)
def test_packed_whole_numbers_are_exact(ends):
    values = np.tile(np.array(ends, dtype=np.int64), 20)
    np.testing.assert_array_equal(unpacked(pack({"x": values}))["x"], values)


def test_packed_amplitudes_are_right_at_antiresonances():
    """Rounded to steps of the range, the least would be wrong by 60 %."""
    w = np.linspace(5.0, 200.0, 1000)
    values = np.abs(sum(1 / (f**2 - w**2 + 0.004j * f * w) for f in (20.0, 75.0, 150.0)))
    values[3:5] = np.nan, np.inf
    assert np.nanmax(values[5:]) > 1e5 * np.nanmin(values[5:])
    found = unpacked(pack({"y": values}))["y"]
    known = np.isfinite(values)
    np.testing.assert_allclose(found[known], values[known], rtol=1e-7)
    assert np.isnan(found[~known]).all()


def test_the_page_has_an_array_for_each_type_of_packed_numbers():
    """Of the same size and sign, such as ``i2: Int16Array``."""
    text = (files("fmu.report") / "templates" / "data.js").read_text(encoding="utf-8")
    arrays = dict(re.findall(r"(\w+): (\w+)Array\b", text.split("KINDS = ", 1)[1].split("}")[0]))
    named = {
        f"{sign}{size}": f"{word}{8 * size}" for sign, word in (("i", "Int"), ("u", "Uint")) for size in (1, 2, 4)
    }
    del named["u1"]
    assert arrays == named | {"f4": "Float32"}


def test_packed_names_have_no_characters_of_html():
    content = {"name": [SCRIPT, "</script>", "<!--", "\u2028", "\"&'"]}
    assert unpacked(pack(content)) == content
    assert not set(pack(content)) & set("<>&\"'\u2028")


def test_the_view_has_the_numbers_of_the_trace(beam_traces):
    (run,) = runs_of({"hmc": beam_traces["hmc"]}).values()
    modes = run.trace["modes"].to_dataset()
    found = unpacked(model_view(run).packed)
    np.testing.assert_allclose(found["nodes"].reshape(-1, 3), modes["coordinates"], atol=1e-4)
    np.testing.assert_array_equal(found["ends"].reshape(-1, 2), modes["ends"])
    for key, state in (("start", "start"), ("mean", "posterior mean")):
        expected = modes["displacement"].sel(state=state).transpose("mode", "node", "direction")
        np.testing.assert_allclose(found["shapes"][key].reshape(expected.shape), expected, atol=4e-5)
    change, sd = found["colourings"]
    for k in range(5):
        of_element = modes["changed"].to_numpy()[:, k] == 1
        expected = run.summary["mean"][f"E{k + 1}"] / 2.4e11 - 1.0
        np.testing.assert_allclose(change["values"][of_element], expected, atol=1e-4)
        np.testing.assert_allclose(sd["values"][of_element], run.summary["sd"][f"E{k + 1}"] / 2.4e11, atol=1e-4)
        tip = {found["tips"][int(group)] for group in found["groups"][of_element]}
        assert len(tip) == 1
        assert tip.pop().startswith(f"E{k + 1}: ")


def test_without_geometry_there_is_no_view(hostile_traces):
    (run,) = runs_of({"hmc": hostile_traces["hmc"]}).values()
    assert model_view(run) is None


def opened(browser, address, *, motion="no-preference", scripts=True):
    """Open a page with the structure in the middle of the screen."""
    size = {"width": 1280, "height": 740, "deviceScaleFactor": 1, "mobile": False}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    media = [{"name": "prefers-reduced-motion", "value": motion}]
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": media})
    browser.execute_cdp_cmd("Emulation.setScriptExecutionDisabled", {"value": not scripts})
    browser.get_log("browser")
    browser.get(address)
    if scripts:
        wait(browser, "return (document.querySelector('.view canvas') || {}).frames > 0")
        browser.execute_script(
            "document.querySelector('.view').scrollIntoView({block: 'center', behavior: 'instant'})"
        )


def wait(browser, script, seconds=20.0):
    end = time.monotonic() + seconds
    while not browser.execute_script(script):
        assert time.monotonic() < end, script
        time.sleep(0.05)


def address_of(name, request):
    report, _, page = name.partition("/")
    return (request.getfixturevalue(report) / f"{page}.html").as_uri()


def canvas(browser):
    from selenium.webdriver.common.by import By

    return browser.find_element(By.CSS_SELECTOR, ".view canvas")


@needs_browser
@pytest.mark.parametrize("name", PAGES)
def test_it_animates_and_turns_by_keyboard(browser, name, request):
    from selenium.webdriver.common.keys import Keys

    opened(browser, address_of(name, request))
    drawn = canvas(browser)
    first = drawn.screenshot_as_png
    frames = browser.execute_script("return arguments[0].frames", drawn)
    wait(browser, f"return document.querySelector('.view canvas').frames > {frames + 5}")
    assert drawn.screenshot_as_png != first
    drawn.send_keys(" ")  # pauses
    still = drawn.screenshot_as_png
    assert drawn.screenshot_as_png == still
    for key in (Keys.ARROW_LEFT, Keys.ARROW_UP, "+", Keys.PAGE_DOWN):
        drawn.send_keys(key)
        after = drawn.screenshot_as_png
        assert after != still, key
        still = after
    assert "Shown: mode" in drawn.accessible_name
    assert browser.get_log("browser") == []


@needs_browser
def test_it_stands_still_where_less_motion_is_wanted(browser, beam_report):
    opened(browser, (beam_report / "hmc.html").as_uri(), motion="reduce")
    still = canvas(browser).screenshot_as_png
    time.sleep(0.3)
    assert canvas(browser).screenshot_as_png == still
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})


@needs_browser
def test_the_element_under_the_pointer_says_what_changed(browser, beam_report):
    from selenium.webdriver import ActionChains

    opened(browser, (beam_report / "hmc.html").as_uri(), motion="reduce")
    drawn = canvas(browser)
    words = "const t = document.querySelector('.view .tip'), said = () => t.hidden ? '' : t.textContent;"
    found = browser.execute_script(
        f"""{words}
        const canvas = arguments[0], box = canvas.getBoundingClientRect(), found = [];
        const [x, y] = [Math.floor(box.left + box.width / 2), Math.floor(box.top + box.height / 2)];
        for (const dx of [-0.35, 0.0, 0.3].map(share => Math.round(share * box.width)))
          for (let dy = -120; dy <= 120; dy += 8) {{
            canvas.dispatchEvent(new PointerEvent('pointermove', {{clientX: x + dx, clientY: y + dy}}));
            if (said()) found.push([said(), dx, dy]);
          }}
        t.hidden = true;
        return found;""",
        drawn,
    )
    assert len({said for said, _, _ in found}) >= 3
    assert all("±" in said and "(sd)" in said for said, _, _ in found)
    said, dx, dy = found[len(found) // 2]
    ActionChains(browser, 0).move_to_element_with_offset(drawn, dx, dy).perform()  # nothing lies over the canvas
    assert browser.execute_script(f"{words} return said();") == said
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})


@needs_browser
def test_where_scripts_are_off_the_picture_stays(browser, beam_report):
    from selenium.webdriver.common.by import By

    opened(browser, (beam_report / "hmc.html").as_uri(), scripts=False)
    try:
        assert not browser.find_element(By.CSS_SELECTOR, ".view").is_displayed()
        assert browser.find_element(By.CSS_SELECTOR, "#shapes svg").is_displayed()
    finally:
        browser.execute_cdp_cmd("Emulation.setScriptExecutionDisabled", {"value": False})


def grid(folder, n=50):
    """Return traces of a vaulted grid of 2 n (n + 1) beams that is imported from a deck, in vertical motion."""
    x, y = np.meshgrid(np.linspace(0, 10, n + 1), np.linspace(-2, 2, n + 1), indexing="ij")
    ids = np.arange(1, x.size + 1).reshape(x.shape)
    nodes = np.stack([x, y, np.sqrt(9.0 - y**2)], axis=-1).reshape(-1, 3)
    ends = [
        *zip(ids[:-1].ravel(), ids[1:].ravel(), strict=True),
        *zip(ids[:, :-1].ravel(), ids[:, 1:].ravel(), strict=True),
    ]
    deck = ["*NODE", *(f"{k}, {a}, {b}, {c}" for k, (a, b, c) in enumerate(nodes, 1)), "*ELEMENT, TYPE=B31"]
    (folder / "grid.inp").write_text("\n".join([*deck, *(f"{k}, {a}, {b}" for k, (a, b) in enumerate(ends, 1))]))
    mesh = fmu.read_mesh(folder / "grid.inp")
    free = np.flatnonzero(((x > 0) & (x < 10)).ravel())
    zone = np.minimum(3, (nodes[np.array(ends) - 1, 0].mean(axis=1) / 2.5).astype(int))
    terms = []
    for k in range(4):
        nodes_of = np.array(ends)[zone == k] - 1
        rows = np.repeat(np.arange(len(nodes_of)), 2), nodes_of.ravel()
        B = sp.csr_array((np.tile([1.0, -1.0], len(nodes_of)), rows), shape=(len(nodes_of), x.size))
        terms.append((1e4 * (B.T @ B)[free][:, free], f"k{k + 1}"))
    M = 0.01 * sp.eye_array(len(free)).tocsr()
    names = [name for _, name in terms]
    dofs = [(int(i) + 1, "z") for i in free]
    model = fmu.SeparableModel.from_terms(names, terms, [M], dofs=dofs, geometry=fmu.Geometry.of_mesh(mesh))
    K = sum(factor * term for factor, (term, _) in zip((0.8, 1.1, 1.0, 0.6), terms, strict=True))
    squares, shapes = scipy.sparse.linalg.eigsh(K.tocsc(), 6, M.tocsc(), sigma=0, v0=np.ones(len(free)))
    hz, seen = np.sqrt(squares) / (2 * np.pi), np.linspace(20, len(free) - 21, 30).astype(int)
    data = fmu.ModalData(hz, shapes=shapes[seen], sensors=[dofs[i] for i in seen], sd_hz=0.005 * hz)
    parameters = [fmu.Parameter(name, 1.0, 0.3, 1.7, prior=fmu.Normal(0.3, mean=1.0)) for name in names]
    return {"mh": fmu.sample(fmu.UpdatingProblem.reduced(model, data, parameters, name="grid"), "mh", draws=300,
                             warmup=300, chains=4)}  # fmt: skip


def cpu_s(browser):
    """Return the CPU seconds of the browser's processes."""
    spent = 0.0
    for process in psutil.Process(browser.service.process.pid).children(recursive=True):
        times = process.cpu_times()
        spent += times.user + times.system
    return spent


@needs_browser
@pytest.mark.validate
def test_an_imported_mesh_of_5000_elements_moves_smoothly(browser, tmp_path, record_property):
    """Frames a second of CPU, drawn in software: what one idle core shows, however busy the machine is."""
    traces = grid(tmp_path)
    page = write_pages(traces, tmp_path / "report")
    assert page.stat().st_size < 700_000
    opened(browser, page.as_uri())
    content = unpacked(model_view(runs_of(traces)["mh"]).packed)
    assert len(content["ends"]) // 2 >= 5000
    first = canvas(browser).screenshot_as_png
    frames, spent, began = "return document.querySelector('.view canvas').frames", cpu_s(browser), time.monotonic()
    before = browser.execute_script(frames)
    wait(browser, f"{frames} > {before + 100}", seconds=60)
    drawn, seconds = browser.execute_script(frames) - before, time.monotonic() - began
    of_cpu = drawn / (cpu_s(browser) - spent)
    record_property("frames_per_s", drawn / seconds)
    record_property("frames_per_cpu_s", of_cpu)
    print(f"{drawn / seconds:.0f} frames a second, {of_cpu:.0f} a second of CPU, {page.stat().st_size} bytes")
    assert canvas(browser).screenshot_as_png != first
    assert of_cpu > LEAST_FPS
    assert browser.get_log("browser") == []
