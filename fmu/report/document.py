"""Contents of a report page as data classes. The HTML templates determine the layout."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from markupsafe import Markup

from fmu.report.figure_data import figure_data
from fmu.report.packed import pack
from fmu.report.plots.style import AxesArray
from fmu.report.svg import inline_svg

if TYPE_CHECKING:
    from matplotlib.axes import Axes


class _Part:
    """Base class for the parts of a page. Its properties control how the part is laid out."""

    is_words: ClassVar[bool] = False
    fills_desk: ClassVar[bool] = False
    """Whether the part fills the space beside a narrow figure on a desktop screen."""

    @property
    def fits_beside(self) -> bool:
        """Whether the part fits beside a narrow figure on a desktop screen."""
        return self.is_words

    @property
    def is_narrow_figure(self) -> bool:
        """Whether the part is a single figure, narrow enough for other parts to fit beside it."""
        return False


@dataclass(frozen=True)
class Text(_Part):
    """A paragraph of text."""

    kind: ClassVar[str] = "text"
    is_words: ClassVar[bool] = True
    words: str


@dataclass(frozen=True)
class Items(_Part):
    """A list of sentences."""

    kind: ClassVar[str] = "items"
    is_words: ClassVar[bool] = True
    items: tuple[str, ...]


@dataclass(frozen=True)
class Link:
    """A link to another page of the report."""

    words: str
    target: str

    def __str__(self) -> str:
        return self.words


_LONG = 16
"""Largest number of rows of a table that is not folded."""
_NARROW, _BESIDE = 560, 808
"""Widths in CSS pixels of a narrow figure, and of the part beside it, on a desktop screen."""
_LETTER, _PADDING = 8.7, 13.0
"""Widths in CSS pixels of a digit in a table beside a figure, and of the padding of a table cell."""
_HIGH = 1200
"""Largest height in CSS pixels of a figure that is not folded."""


@dataclass(frozen=True)
class PageTable(_Part):
    """A table on a page.

    Attributes
    ----------
    caption : str
    header : tuple of str
    rows : tuple of tuple of (str or Link)
        Each row is as long as the header; its first cell names the row.
    words : tuple of int
        Indices of text columns, which are left-aligned like the first column.
    greyed : tuple of int
        Indices of the rows shown in grey, such as parameters that the data did not inform.

    Raises
    ------
    ValueError
        If a row is not as long as the header.
    """

    kind: ClassVar[str] = "table"
    fills_desk: ClassVar[bool] = True
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
        """Whether the table is long enough to be folded on a page."""
        return len(self.rows) > _LONG

    @property
    def heading(self) -> str:
        """First sentence of the caption, without its full stop."""
        return _first_sentence(self.caption)

    @property
    def fits_beside(self) -> bool:
        """Whether the table's estimated width fits beside a narrow figure on a desktop screen."""
        columns = zip(self.header, *self.rows, strict=True)
        letters = sum(max(_longest(head.split()), _longest(map(str, cells))) for head, *cells in columns)
        return _LETTER * letters + _PADDING * len(self.header) <= _BESIDE


@dataclass(frozen=True)
class Picture(_Part):
    """A figure or drawing on a page.

    Attributes
    ----------
    svg : Markup
        An SVG element with a text description for readers who cannot see it.
    caption : str
    width, height : int
        Natural size in CSS pixels; the height is zero if unknown.
    name : str
        File name, without extension, under which a reader saves the figure or its data.
    content : mapping
        The plotted numbers for the script ``figures.js`` (`fmu.report.figure_data`); empty if there are none.
    """

    kind: ClassVar[str] = "picture"
    svg: Markup
    caption: str
    width: int
    name: str = "figure"
    content: Mapping[str, object] = field(default_factory=dict, compare=False)
    height: int = 0

    @property
    def is_high(self) -> bool:
        """Whether the figure is so tall that the page collapses it under its heading."""
        return self.height > _HIGH

    @property
    def heading(self) -> str:
        """First sentence of the caption, without its full stop."""
        return _first_sentence(self.caption)

    @property
    def packed(self) -> str:
        """The content in the compressed format that the page script reads."""
        return pack(self.content)


@dataclass(frozen=True)
class Pictures(_Part):
    """Figures that are placed side by side if the page is wide enough."""

    kind: ClassVar[str] = "pictures"
    pictures: tuple[Picture, ...]

    @property
    def is_narrow_figure(self) -> bool:
        """Whether the part is a single figure, so narrow and low that other parts fit beside it."""
        first = self.pictures[0]
        return len(self.pictures) == 1 and first.width <= _NARROW and not first.is_high


@dataclass(frozen=True, eq=False)
class View(_Part):
    """A structure drawing that readers can rotate with the script ``structure.js``.

    It is hidden if scripts are disabled, and in print.

    Attributes
    ----------
    name : str
        A name that is unique on the page.
    content : mapping
        The drawn structure and its modes (`fmu.report.model_view`).
    caption : str
    """

    kind: ClassVar[str] = "view"
    name: str
    content: Mapping[str, object]
    caption: str

    @property
    def packed(self) -> str:
        """The content in the compressed format that the page script reads."""
        return pack(self.content)


@dataclass(frozen=True)
class Details(_Part):
    """Parts of a page that are hidden until the reader opens them."""

    kind: ClassVar[str] = "details"
    summary: str
    parts: tuple[Part, ...]


Part = Text | Items | PageTable | Picture | Pictures | View | Details


@dataclass(frozen=True)
class PageSection:
    """A section of a page: a heading and the parts below it."""

    id: str
    title: str
    parts: tuple[Part, ...]

    @property
    def shown(self) -> tuple[PageSection, ...]:
        """A tuple that contains only this section."""
        return (self,)

    @property
    def omissions(self) -> tuple[str, ...]:
        """An empty tuple, because nothing is omitted."""
        return ()

    @property
    def has_figure_beside(self) -> bool:
        """Whether the last part is a narrow figure, and the other parts fit beside it and fill the space."""
        *others, last = self.parts
        is_filled = any(part.fills_desk for part in others)
        return last.is_narrow_figure and is_filled and all(part.fits_beside for part in others)


@dataclass(frozen=True)
class Omitted:
    """A section that is not shown because a run has no content for it.

    Attributes
    ----------
    title : str
    reason : str
        Why the section is omitted: half a sentence, without a full stop.
    """

    title: str
    reason: str

    @property
    def shown(self) -> tuple[PageSection, ...]:
        """An empty tuple, because no section is shown."""
        return ()

    @property
    def omissions(self) -> tuple[str, ...]:
        """A one-element tuple with a sentence that says what is omitted and why."""
        return (f"{self.title}: {self.reason}.",)


NOTES = "Notes on the model and the data"


@dataclass(frozen=True)
class Verdict:
    """The verdict on one question about a run: one line on the first screen, and the reasons below it.

    Attributes
    ----------
    question, answer : str
    is_good : bool or None
        Whether the answer is favourable; None if it is neither good nor bad.
    because : str
        Heading for the list of reasons. If `is_good` is None, the answer is shown as unknown if there is a
        heading, and as a fact if the heading is empty.
    reasons : tuple of str
        Reasons for the answer.
    said : str
        Text shown next to the answer.
    notes : tuple of str
        Further remarks on the question that are not reasons for the answer.
    """

    question: str
    answer: str
    is_good: bool | None
    because: str = ""
    reasons: tuple[str, ...] = ()
    said: str = ""
    notes: tuple[str, ...] = ()

    @property
    def lists(self) -> tuple[tuple[str, tuple[str, ...]], ...]:
        """Headings and contents of the non-empty lists below the first screen: reasons and notes."""
        return tuple(one for one in ((self.because, self.reasons), (NOTES, self.notes)) if one[1])

    @property
    def tone(self) -> str:
        """CSS class for the answer: ``"fact"``, ``"unknown"``, ``"good"`` or ``"bad"``."""
        if self.is_good is None:
            return "unknown" if self.because else "fact"
        return "good" if self.is_good else "bad"


@dataclass(frozen=True)
class Page:
    """A page of a report.

    Attributes
    ----------
    title, subtitle, lead : str
        The problem's name as the heading, the subject of the page below it, and a line of further facts.
    verdicts : tuple of Verdict
        Verdicts at the top of the page.
    sections : tuple of PageSection
    others : tuple of Link
        The other pages of the report.
    footer : str
    assumptions : tuple of Part
        The assumptions behind the verdicts, in a box below them; no box if empty.
    drawing : Markup or str
        A drawing of the structure in the page header; empty if there is no structure to draw.
    leading : tuple of PageSection
        Sections directly below the verdicts, before the reasons for the verdicts.
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
    leading: tuple[PageSection, ...] = ()

    @property
    def has_basis(self) -> bool:
        """Whether there are assumptions, reasons or notes to show."""
        return bool(self.assumptions) or any(verdict.lists for verdict in self.verdicts)


_CSS_PER_INCH = 96


def _first_sentence(text: str) -> str:
    return text.partition(". ")[0].removesuffix(".")


def _longest(words: Iterable[str]) -> int:
    return max(map(len, words), default=0)


def breaking_at_commas(text: str) -> str:
    """Return the text with no-break spaces except after commas, so that a narrow column breaks only at commas."""
    return text.replace(" ", "\N{NO-BREAK SPACE}").replace(",\N{NO-BREAK SPACE}", ", ")


def picture(
    axes: Axes | AxesArray, key: str, alt: str, caption: str, data: Mapping[str, object] | None = None
) -> Picture:
    """Return the figure that contains `axes` as a `Picture` for a page.

    The figure's layout is applied, and its layout engine removed. Raise ValueError if `alt` is empty.

    Parameters
    ----------
    axes : Axes or ndarray of Axes
        The axes of one figure.
    key : str
        A prefix for the ids in the SVG element, unique on the page. It is also the picture's name.
    alt : str
        A description of the figure in words and numbers.
    caption : str
        The text below the figure.
    data : mapping, optional
        The picture's content. By default, `figure_data` extracts it from the figure.
    """
    figure = np.asarray(axes).ravel()[0].figure
    svg = inline_svg(figure, key, alt)
    content = figure_data(figure) if data is None else data
    width, height = (round(_CSS_PER_INCH * inches) for inches in figure.get_size_inches())
    return Picture(svg, caption, width, key, content, height)
