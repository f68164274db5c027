"""A figure inside a page: described, with text as text, ids of its own, and nothing that reaches out of it."""

import base64
import io
import pickle
import re
from contextlib import nullcontext

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from PIL import Image

from fmu.report import svg
from fmu.report.document import picture
from fmu.report.plots.style import new_figure
from fmu.report.svg import inline_svg


def images(svg):
    return [Image.open(io.BytesIO(base64.b64decode(data))) for data in re.findall(r"base64,([^\"]*)", svg)]


@pytest.fixture
def figure():
    figure = new_figure(4.0, 2.0)
    axes = figure.subplots()
    axes.plot(np.arange(200.0), np.sin(np.arange(200.0)), rasterized=True)
    axes.plot([0.0, 200.0], [0.123456789, 0.2], marker="o")
    axes.set_ylabel("<b> & 0.123456 GPa")
    return figure


def test_it_is_described_and_scales(figure):
    svg = inline_svg(figure, "a", 'rises "steeply" to 3 <GPa>')
    assert svg.startswith(
        '<svg role="img" aria-label="rises &#34;steeply&#34; to 3 &lt;GPa&gt;" viewBox="0 0 288 144">'
    )
    assert svg.endswith("</svg>")
    with pytest.raises(ValueError, match="alt: must describe the figure"):
        inline_svg(figure, "a", " ")


def test_a_letter_that_the_font_has_not_stays_that_letter(figure):
    figure.axes[0].set_xlabel("日本")
    assert "日本" in inline_svg(figure, "a", "b")


def test_axes_are_placed_as_matplotlib_places_them(figure, monkeypatch):
    figure.legend(["path", "line"], loc="outside lower center")
    figure.supylabel("all")
    other = pickle.loads(pickle.dumps(figure))
    draw, draws = Figure.draw, []
    monkeypatch.setattr(Figure, "draw", lambda self, renderer: draws.append(draw(self, renderer)))
    svg = inline_svg(figure, "a", "x")
    assert len(draws) == 1
    monkeypatch.setattr("fmu.report.svg._arrange", lambda figure: None)
    assert inline_svg(other, "a", "x") == svg
    assert len(draws) == 3


def test_text_stays_text_and_is_escaped(figure):
    assert "&lt;b&gt; &amp; 0.123456 GPa" in inline_svg(figure, "a", "x")


def test_it_disturbs_nothing_and_asks_for_nothing(figure):
    before = dict(mpl.rcParams)
    svg = inline_svg(figure, "a", "x")
    assert dict(mpl.rcParams) == before
    for word in ("<style", "http", "metadata", "font-family", "<?xml", "DOCTYPE", "xlink"):
        assert word not in svg


def test_ids_are_those_that_are_used_and_its_own(figure):
    one, other = (inline_svg(figure, key, "x") for key in ("a", "b"))
    ids = re.findall(r' id="([^"]+)"', one)
    used = re.findall(r'(?:url\(#|href="#)([^")]+)', one)
    assert ids
    assert set(ids) == set(used)
    assert all(name.startswith("a-") for name in ids)
    assert not set(ids) & set(re.findall(r' id="([^"]+)"', other))


def test_the_same_figure_is_the_same_text(figure):
    assert inline_svg(figure, "a", "x") == inline_svg(figure, "a", "x")


def test_coordinates_are_short(figure):
    svg = inline_svg(figure, "a", "x")
    paths = re.findall(r' d="([^"]*)"', svg)
    assert paths
    assert not any(re.search(r"\.\d{3}", path) for path in paths)


def test_pixels_have_a_palette_and_look_the_same(figure, monkeypatch):
    (pixels,) = images(inline_svg(figure, "a", "x"))
    assert pixels.mode == "P"
    monkeypatch.setattr("fmu.report.svg._fewer_colours", lambda data: data[0])
    (original,) = images(inline_svg(figure, "a", "x"))
    few, all_ = (np.asarray(image.convert("RGBA"), dtype=float) for image in (pixels, original))
    assert np.abs(few - all_).mean() < 4.0
    assert few[..., 3].min() == 0  # transparent where nothing is drawn
    assert few[..., 3].max() > 250


def test_a_picture_is_as_wide_as_its_figure(figure):
    one = picture(figure.axes[0], "a", "x", "below")
    assert (one.width, one.caption) == (384, "below")
    assert picture(np.array(figure.axes), "a", "x", "below").svg == one.svg


def test_ticks_are_placed_once_and_drawn_the_same(monkeypatch):
    placed = []
    place = Axis._update_ticks
    monkeypatch.setattr(Axis, "_update_ticks", lambda axis: placed.append(axis) or place(axis))

    def drawn():
        figure = new_figure(4.0, 4.0)
        axes = figure.subplots(3, 1, sharex=True)
        for k, one in enumerate(axes):
            one.plot([0.0, 10.0**k])
            one.set_ylabel("much\nor little" if k else "E / GPa")
        figure.align_ylabels(axes)
        placed.clear()
        return inline_svg(figure, "a", "alt"), len(placed)

    once, few = drawn()
    assert few <= 6 * 4  # axes: at first, after each of two passes of the layout, and at the end
    monkeypatch.setattr(svg, "_ticks_placed_once", nullcontext)
    again, many = drawn()
    assert once == again
    assert many > 2 * few
