"""What a page of a report consists of, and figures as SVG inside it; the templates say how it looks."""

from __future__ import annotations

import base64
import io
import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from markupsafe import Markup, escape

from fmu.report.packed import packed

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Text:
    """A paragraph."""

    kind: ClassVar[str] = "text"
    words: str


@dataclass(frozen=True)
class Items:
    """A list of sentences."""

    kind: ClassVar[str] = "items"
    items: tuple[str, ...]


@dataclass(frozen=True)
class Link:
    """A link to another page of the report."""

    words: str
    target: str


_LONG = 40
"""Rows of a table that a page shows at once."""


@dataclass(frozen=True)
class PageTable:
    """A table.

    Attributes
    ----------
    caption : str
    header : tuple of str
    rows : tuple of tuple of (str or Link)
        Each as long as the header; the first cell names the row.
    words : tuple of int
        Columns that hold words, aligned to the left, beside the first.
    greyed : tuple of int
        Rows in grey: parameters that the data did not inform.
    """

    kind: ClassVar[str] = "table"
    caption: str
    header: tuple[str, ...]
    rows: tuple[tuple[str | Link, ...], ...]
    words: tuple[int, ...] = ()
    greyed: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row) != len(self.header):
                raise ValueError(f"rows: must have {len(self.header)} cells (got {row})")

    @property
    def is_long(self) -> bool:
        """Whether it is folded on a page."""
        return len(self.rows) > _LONG


@dataclass(frozen=True)
class Picture:
    """A drawing.

    Attributes
    ----------
    svg : Markup
        With a description for those who cannot see it.
    caption : str
    width : int
        Its natural width in CSS pixels.
    """

    kind: ClassVar[str] = "picture"
    svg: Markup
    caption: str
    width: int


@dataclass(frozen=True)
class Pictures:
    """Drawings side by side if the page is wide enough."""

    kind: ClassVar[str] = "pictures"
    pictures: tuple[Picture, ...]


@dataclass(frozen=True, eq=False)
class View:
    """A drawing to be turned, for the script ``structure.js``; hidden where scripts are off, and in print.

    Attributes
    ----------
    name : str
        Unique on the page.
    content : mapping
        What is drawn, see `fmu.report.model_view`.
    caption : str
    """

    kind: ClassVar[str] = "view"
    name: str
    content: Mapping[str, Any]
    caption: str

    @property
    def packed(self) -> str:
        """The content as the script reads it."""
        return packed(self.content)


@dataclass(frozen=True)
class Code:
    """Preformatted text."""

    kind: ClassVar[str] = "code"
    words: str


@dataclass(frozen=True)
class Details:
    """Parts that are hidden until they are opened."""

    kind: ClassVar[str] = "details"
    summary: str
    parts: tuple[Part, ...]


Part = Text | Items | PageTable | Picture | Pictures | View | Code | Details


@dataclass(frozen=True)
class PageSection:
    """A heading and the parts below it."""

    id: str
    title: str
    parts: tuple[Part, ...]


@dataclass(frozen=True)
class Omitted:
    """A section for which a run has no content.

    Attributes
    ----------
    title : str
    reason : str
        Why it is omitted: half a sentence, without a full stop.
    """

    title: str
    reason: str


@dataclass(frozen=True)
class Verdict:
    """An answer to one question about a run: a line of the first screen, and reasons below it.

    Attributes
    ----------
    question, answer : str
    is_good : bool or None
        None if the answer is neither good nor bad.
    because : str
        Heading of the reasons; empty for a fact, which needs none.
    reasons : tuple of str
        Reasons for the answer.
    said : str
        A sentence beside the answer.
    """

    question: str
    answer: str
    is_good: bool | None
    because: str = ""
    reasons: tuple[str, ...] = ()
    said: str = ""

    @property
    def tone(self) -> str:
        """How it looks: ``"fact"``, ``"unknown"``, ``"good"`` or ``"bad"``."""
        if self.is_good is None:
            return "unknown" if self.because else "fact"
        return "good" if self.is_good else "bad"


@dataclass(frozen=True)
class Page:
    """A page.

    Attributes
    ----------
    title : str
        Its heading: the name of the problem.
    subtitle : str
        What the page is about, below it.
    lead : str
        One more line.
    verdicts : tuple of Verdict
        Verdicts at the top of the page.
    sections : tuple of PageSection
    others : tuple of Link
        The other pages of the report.
    footer : str
    assumptions : tuple of Part
        What the verdicts rest on, in a box below them; none if empty.
    drawing : Markup or str
        The structure, in the head of the page; empty if there is none to draw.
    """

    title: str
    subtitle: str
    lead: str
    verdicts: tuple[Verdict, ...]
    sections: tuple[PageSection, ...]
    others: tuple[Link, ...]
    footer: str
    assumptions: tuple[Part, ...] = ()
    drawing: str = ""


RASTER_DPI = 110
"""Resolution of the parts drawn as pixels: paths and clouds of many points."""
_COLOURS = 32
_CSS_PER_INCH = 96
_SVG_DPI = 72
_ARRANGED = {"figure.autolayout": False, "figure.constrained_layout.use": False}
_TAG = re.compile(r"<[^>]*>")
"""Matplotlib writes the angle brackets of names as entities."""
_NO_METADATA = {"Date": None, "Creator": None, "Format": None, "Type": None}


def breaking_at_commas(text: str) -> str:
    """Return a text for a narrow column, which breaks its lines after commas only."""
    return text.replace(" ", "\N{NO-BREAK SPACE}").replace(",\N{NO-BREAK SPACE}", ", ")


def picture(axes: Any, key: str, alt: str, caption: str) -> Picture:
    """Return the figure of some axes as a picture on a page.

    Parameters
    ----------
    axes : Axes or ndarray of Axes
        The axes of one figure.
    key : str
        A prefix of its ids, unique on the page.
    alt : str
        What the figure shows, in words and numbers.
    caption : str
        The text below it.
    """
    figure = np.ravel(axes)[0].figure
    return Picture(inline_svg(figure, key, alt), caption, round(_CSS_PER_INCH * figure.get_figwidth()))


def inline_svg(figure: Figure, key: str, alt: str) -> Markup:
    """Return a figure as an SVG element with selectable text, unique ids and no style sheet.

    Raises
    ------
    ValueError
        If `alt` is empty: readers who cannot see the figure would learn nothing.
    """
    import matplotlib as mpl

    if not alt.strip():
        raise ValueError("alt: must describe the figure (got nothing)")
    file = io.StringIO()
    settings: Any = {"svg.fonttype": "none", "svg.hashsalt": key} | _ARRANGED
    with mpl.rc_context(settings), warnings.catch_warnings():
        # text is kept as text: the reader's font may have glyphs that Matplotlib's lacks
        warnings.filterwarnings("ignore", r"Glyph \d+ .* missing from font", UserWarning)
        _arrange(figure)
        figure.savefig(file, format="svg", dpi=RASTER_DPI, metadata=_NO_METADATA)
    text = file.getvalue()
    body = text[text.index(">", text.index("<svg")) + 1 : text.rindex("</svg>")]
    # A style inside an SVG would apply to the whole page.
    body = re.sub(r"<style.*?</style>|<metadata>.*?</metadata>|<!--.*?-->", "", body, flags=re.DOTALL)
    body = re.sub(r"\s*\n\s*", " ", body)
    used = set(re.findall(r"(?:url\(#|href=\"#)([^\")]+)", "".join(_TAG.findall(body))))
    body = _TAG.sub(lambda tag: _clean(tag[0], key, used), body)  # change tags only, not text
    width, height = (72.0 * size for size in figure.get_size_inches())
    return Markup(f'<svg role="img" aria-label="{escape(alt)}" viewBox="0 0 {width:g} {height:g}">{body}</svg>')


def _arrange(figure: Figure) -> None:
    """Place the axes for good. Matplotlib places them the same, but draws the whole figure once more to do so."""
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    engine = figure.get_layout_engine()
    if engine is not None:
        FigureCanvasSVG(figure)  # from now on the canvas of the figure: it says how large text is
        figure.dpi = _SVG_DPI
        engine.execute(figure)
        figure.set_layout_engine(None)


def _clean(tag: str, key: str, used: set[str]) -> str:
    """Return a tag without font names, with short numbers, and with the prefix before ids that are referenced."""
    tag = re.sub(r" ?font-family: [^;\"]*;?", "", tag).replace("xlink:href", "href")
    tag = re.sub(r' (?:d|x|y|transform|points)="[^"]*"', _rounded, tag)
    tag = re.sub(r"(?<=data:image/png;base64,)[^\"]*", _fewer_colours, tag)
    tag = re.sub(r' id="([^"]*)"', lambda match: f' id="{key}-{match[1]}"' if match[1] in used else "", tag)
    return re.sub(r"(url\(#|href=\"#)", rf"\g<1>{key}-", tag)


def _rounded(attribute: re.Match[str]) -> str:
    """Write coordinates to a hundredth of a point."""
    return re.sub(r"\d+\.\d{3,}", lambda number: f"{float(number[0]):.2f}".rstrip("0").rstrip("."), attribute[0])


def _fewer_colours(data: re.Match[str]) -> str:
    """Store the pixels with a palette, which takes a quarter of the space."""
    from PIL import Image

    file = io.BytesIO()
    with Image.open(io.BytesIO(base64.b64decode(data[0]))) as pixels:
        pixels.quantize(_COLOURS, method=Image.Quantize.FASTOCTREE).save(file, "PNG", optimize=True)
    return base64.b64encode(file.getvalue()).decode()
