"""Convert Matplotlib figures to compact SVG for a page, with a text description, real text and unique ids."""

from __future__ import annotations

import base64
import io
import re
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from markupsafe import Markup, escape

if TYPE_CHECKING:
    from matplotlib.figure import Figure

RASTER_DPI = 96
"""Resolution of rasterised parts, such as paths and clouds of many points."""
_COLOURS = 32
_SVG_DPI = 72
_TAG = re.compile(r"<[^>]*>")
"""An SVG tag; Matplotlib escapes angle brackets in text, so text does not match."""
_NO_METADATA = {"Date": None, "Creator": None, "Format": None, "Type": None}


_STYLE = re.compile(r' style="[^"]*"')
_OF_SCHEME = {
    "#000000": "ink", "#ffffff": "paper", "#6e6e6e": "quiet", "#e8e8e8": "pale", "#0072b2": "blue",
    "#882255": "wine",
}  # fmt: skip
"""Colours that the light or dark scheme of the page replaces, with their variables in the style sheet."""
_SHORT_PATH = 12
"""Smallest number of line segments of a path that is written in relative coordinates."""
_STRAIGHT = re.compile(r"[\dMLz eE.+-]*")


def inline_svg(figure: Figure, key: str, alt: str) -> Markup:
    """Return a figure as an SVG element with selectable text and unique ids, but without a style sheet.

    The ids begin with `key`; `alt` describes the figure for readers who cannot see it. If the figure has a layout
    engine, the engine is run and removed, and the resolution of the figure becomes 72 dpi.

    Raises
    ------
    ValueError
        If `alt` is empty.
    """
    import matplotlib as mpl

    if not alt.strip():
        raise ValueError("alt: must describe the figure (got nothing)")
    file = io.StringIO()
    as_text = mpl.rc_context(
        {
            "svg.fonttype": "none",
            "svg.hashsalt": key,
            "figure.autolayout": False,
            "figure.constrained_layout.use": False,
        }
    )
    with as_text, warnings.catch_warnings():
        # text stays text, so the reader's font may have glyphs that Matplotlib's font lacks
        warnings.filterwarnings("ignore", r"Glyph \d+ .* missing from font", UserWarning)
        with _ticks_placed_once():
            _arrange(figure)
            figure.savefig(file, format="svg", dpi=RASTER_DPI, metadata=_NO_METADATA)
    text = file.getvalue()
    body = text[text.index(">", text.index("<svg")) + 1 : text.rindex("</svg>")]
    # A style inside an SVG would apply to the whole page.
    body = re.sub(r"<style.*?</style>|<metadata>.*?</metadata>|<!--.*?-->", "", body, flags=re.DOTALL)
    body = re.sub(r"\s*\n\s*", " ", body).replace("> <", "><")
    used = set(re.findall(r"(?:url\(#|href=\"#)([^\")]+)", "".join(_TAG.findall(body))))
    body = _TAG.sub(lambda tag: _clean(tag[0], key, used), body)  # change only tags, not text
    body = _without_repetition(body)
    width, height = (72.0 * size for size in figure.get_size_inches())
    return Markup(f'<svg role="img" aria-label="{escape(alt)}" viewBox="0 0 {width:g} {height:g}">{body}</svg>')


@contextmanager
def _ticks_placed_once() -> Iterator[None]:
    """Make Matplotlib update ticks only if the limits, position or size of their axes, or the dpi, have changed.

    This holds within the ``with`` block. Otherwise Matplotlib updates the ticks whenever it computes the extent of
    an artist, about ten times per figure. These updates take a fifth of the drawing time.
    """
    from matplotlib.axis import Axis

    place: Callable[[Axis], object] = getattr(Axis, "_update_ticks")  # noqa: B009  # not public: without it figures only take longer
    placed: dict[int, tuple[tuple[float, ...], object]] = {}

    def placed_once(axis: Axis) -> object:
        figure = axis.get_figure(root=True)
        key = (*axis.get_view_interval(), *axis.axes.bbox.bounds, 0.0 if figure is None else figure.dpi)
        if placed.get(id(axis), ((),))[0] != key:
            placed[id(axis)] = key, place(axis)
        return placed[id(axis)][1]

    setattr(Axis, "_update_ticks", placed_once)  # noqa: B010
    try:
        yield
    finally:
        setattr(Axis, "_update_ticks", place)  # noqa: B010


def _arrange(figure: Figure) -> None:
    """Apply the figure's layout and remove its layout engine.

    Unlike Matplotlib, do not draw the whole figure for this.
    """
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    engine = figure.get_layout_engine()
    if engine is not None:
        FigureCanvasSVG(figure)  # becomes the canvas of the figure, which determines the size of text
        figure.dpi = _SVG_DPI
        engine.execute(figure)
        figure.set_layout_engine(None)


def _clean(tag: str, key: str, used: set[str]) -> str:
    """Return a tag without font names, with rounded numbers, and with the colours of the page's scheme.

    Ids in `used` get the prefix `key`; other ids are removed. Images are reduced to few colours.
    """
    tag = re.sub(r" ?font-family: [^;\"]*;?", "", tag).replace("xlink:href", "href")
    tag = re.sub(r' d="([^"]*)"', _short_path, tag)
    tag = re.sub(r' (?:x|y|transform|points)="[^"]*"', _round_coordinates, tag)
    tag = re.sub(r' transform="rotate\(-0 [^"]*"', "", tag)
    tag = re.sub(r'(?<=style=")[^"]*', _of_scheme, tag)
    tag = re.sub(r"(?<=data:image/png;base64,)[^\"]*", _fewer_colours, tag)
    tag = re.sub(r' id="([^"]*)"', lambda match: f' id="{key}-{match[1]}"' if match[1] in used else "", tag)
    return re.sub(r"(url\(#|href=\"#)", rf"\g<1>{key}-", tag)


def _of_scheme(style: re.Match[str]) -> str:
    """Return a style without spaces after colons and semicolons, and with CSS variables for the colours.

    Each colour in `_OF_SCHEME` becomes a variable whose default is this colour.
    """
    text = style[0].replace(": ", ":").replace("; ", ";")
    for colour, name in _OF_SCHEME.items():
        text = text.replace(colour, f"var(--{name},{colour})")
    return text


def _without_repetition(body: str) -> str:
    """Return the SVG without superfluous tags and styles.

    Groups without attributes lose their tags but keep their content. A use of a symbol loses its style if the
    style is the same as the symbol's.
    """
    says_something: list[bool] = []
    styles: dict[str, str] = {}

    def shorter(match: re.Match[str]) -> str:
        tag = match[0]
        if tag == "<g/>":
            return ""
        if tag.startswith(("<g>", "<g ")):
            says_something.append(tag != "<g>")
            return tag if says_something[-1] else ""
        if tag == "</g>":
            return tag if says_something.pop() else ""
        if tag.startswith(("<path id=", "<use ")) and (style := _STYLE.search(tag)):
            name = tag.split('"')[1].removeprefix("#")
            if tag.startswith("<path"):
                styles[name] = style[0]
            elif styles.get(name) == style[0]:
                return tag.replace(style[0], "")
        return tag

    return _TAG.sub(shorter, body)


def _round_coordinates(attribute: re.Match[str]) -> str:
    """Return an attribute with its coordinates rounded to a hundredth of a point."""
    return re.sub(r"\d+\.\d{3,}", lambda number: f"{float(number[0]):.2f}".rstrip("0").rstrip("."), attribute[0])


def _short_path(attribute: re.Match[str]) -> str:
    """Return a path attribute with rounded coordinates.

    A path with `_SHORT_PATH` or more segments, all of them straight, is rewritten in relative coordinates that are
    rounded to a tenth of a point.
    """
    path = attribute[1]
    if path.count("L") < _SHORT_PATH or not _STRAIGHT.fullmatch(path):
        return _round_coordinates(attribute)
    pieces, last = [], np.zeros(2, dtype=np.int64)
    for piece in path.split("M")[1:]:
        points = np.rint(10.0 * np.array(piece.replace("L", " ").replace("z", " ").split(), dtype=float))
        points = points.astype(np.int64).reshape(-1, 2)
        steps = np.diff(points, axis=0)
        steps = steps[steps.any(axis=1)] if steps.any() else steps
        moves = [_tenths(value) for value in [*(points[0] - last).tolist(), *steps.ravel().tolist()]]
        closed = "z" if "z" in piece else ""
        line = f"m{' '.join(moves[:2])}l{' '.join(moves[2:])}" if len(moves) > 2 else f"m{' '.join(moves)}l0 0"
        pieces.append(line.replace(" -", "-") + closed)
        last = points[0] if closed else points[-1]
    return f' d="{"".join(pieces)}"'


@cache
def _tenths(value: int) -> str:
    """Return a number of tenths in the shortest SVG notation: ``".3"``, ``"-1.2"``, ``"4"``."""
    return f"{value / 10:g}".replace("0.", ".", 1) if abs(value) < 10 else f"{value / 10:g}"


def _fewer_colours(data: re.Match[str]) -> str:
    """Return base64-encoded PNG data with the colours reduced to a palette of 32.

    The result takes about a quarter of the space.
    """
    from PIL import Image

    file = io.BytesIO()
    with Image.open(io.BytesIO(base64.b64decode(data[0]))) as pixels:
        pixels.quantize(_COLOURS, method=Image.Quantize.FASTOCTREE).save(file, "PNG", optimize=True)
    return base64.b64encode(file.getvalue()).decode()
