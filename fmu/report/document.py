"""The parts of a page of a report; templates give them their look."""

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
    """What every part of a page says of its layout."""

    is_words: ClassVar[bool] = False
    fills_desk: ClassVar[bool] = False
    """Whether it leaves no half of a desk white beside a narrow figure."""

    @property
    def fits_beside(self) -> bool:
        """Whether it has room beside a narrow figure on a desk."""
        return self.is_words

    @property
    def is_narrow_figure(self) -> bool:
        """Whether it is a single figure that others have room beside."""
        return False


@dataclass(frozen=True)
class Text(_Part):
    """A paragraph."""

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
"""Rows of a table that a page shows at once."""
_NARROW, _BESIDE = 560, 808
"""Widths in CSS pixels of a figure, and of what is beside it, on a desk."""
_LETTER, _PADDING = 8.7, 13.0
"""Widths in CSS pixels of a digit of a table beside a figure, and of the padding of a cell."""
_HIGH = 1200
"""Height in CSS pixels of figures that a page shows at once."""


@dataclass(frozen=True)
class PageTable(_Part):
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
        """Whether it is folded on a page."""
        return len(self.rows) > _LONG

    @property
    def heading(self) -> str:
        """The first sentence of the caption, without a full stop."""
        return _first_sentence(self.caption)

    @property
    def fits_beside(self) -> bool:
        """Whether the words of its header and its longest cells have room beside a narrow figure, about."""
        columns = zip(self.header, *self.rows, strict=True)
        letters = sum(max(_longest(head.split()), _longest(map(str, cells))) for head, *cells in columns)
        return _LETTER * letters + _PADDING * len(self.header) <= _BESIDE


@dataclass(frozen=True)
class Picture(_Part):
    """A drawing.

    Attributes
    ----------
    svg : Markup
        With a description for those who cannot see it.
    caption : str
    width, height : int
        Its natural size in CSS pixels; zero if the height is not known.
    name : str
        Of the files in which a reader keeps it.
    content : mapping
        Its numbers for the script ``figures.js``, see `fmu.report.figure_data`; empty if there are none.
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
        """Whether it is folded on a page."""
        return self.height > _HIGH

    @property
    def heading(self) -> str:
        """The first sentence of the caption, without a full stop."""
        return _first_sentence(self.caption)

    @property
    def packed(self) -> str:
        """The content as the script reads it."""
        return pack(self.content)


@dataclass(frozen=True)
class Pictures(_Part):
    """Drawings side by side if the page is wide enough."""

    kind: ClassVar[str] = "pictures"
    pictures: tuple[Picture, ...]

    @property
    def is_narrow_figure(self) -> bool:
        """Whether it is a single figure that others have room beside."""
        first = self.pictures[0]
        return len(self.pictures) == 1 and first.width <= _NARROW and not first.is_high


@dataclass(frozen=True, eq=False)
class View(_Part):
    """A drawing that readers turn, by the script ``structure.js``; hidden where scripts are off, and in print.

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
    content: Mapping[str, object]
    caption: str

    @property
    def packed(self) -> str:
        """The content as the script reads it."""
        return pack(self.content)


@dataclass(frozen=True)
class Details(_Part):
    """Parts that are hidden until they are opened."""

    kind: ClassVar[str] = "details"
    summary: str
    parts: tuple[Part, ...]


Part = Text | Items | PageTable | Picture | Pictures | View | Details


@dataclass(frozen=True)
class PageSection:
    """A heading and the parts below it."""

    id: str
    title: str
    parts: tuple[Part, ...]

    @property
    def shown(self) -> tuple[PageSection, ...]:
        """The section itself."""
        return (self,)

    @property
    def omissions(self) -> tuple[str, ...]:
        """Nothing is omitted."""
        return ()

    @property
    def has_figure_beside(self) -> bool:
        """Whether its only narrow figure, the last part, has room beside the other parts on a desk."""
        *others, last = self.parts
        is_filled = any(part.fills_desk for part in others)
        return last.is_narrow_figure and is_filled and all(part.fits_beside for part in others)


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

    @property
    def shown(self) -> tuple[PageSection, ...]:
        """No section."""
        return ()

    @property
    def omissions(self) -> tuple[str, ...]:
        """What is omitted and why, in a sentence."""
        return (f"{self.title}: {self.reason}.",)


NOTES = "Notes on the model and the data"


@dataclass(frozen=True)
class Verdict:
    """The answer to one question about a run: a line of the first screen, and reasons below it.

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
    notes : tuple of str
        What else to know about the question; no reason for the answer.
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
        """The lists below the first screen, each with its heading: reasons, notes."""
        return tuple(one for one in ((self.because, self.reasons), (NOTES, self.notes)) if one[1])

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
    leading : tuple of PageSection
        Sections directly below the verdicts, before the reasons for them.
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
        """Whether there are assumptions or reasons to show."""
        return bool(self.assumptions) or any(verdict.lists for verdict in self.verdicts)


_CSS_PER_INCH = 96


def _first_sentence(text: str) -> str:
    return text.partition(". ")[0].removesuffix(".")


def _longest(words: Iterable[str]) -> int:
    return max(map(len, words), default=0)


def breaking_at_commas(text: str) -> str:
    """Return a text for a narrow column, which breaks its lines after commas only."""
    return text.replace(" ", "\N{NO-BREAK SPACE}").replace(",\N{NO-BREAK SPACE}", ", ")


def picture(
    axes: Axes | AxesArray, key: str, alt: str, caption: str, data: Mapping[str, object] | None = None
) -> Picture:
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
    data : mapping, optional
        Its content, if not what `figure_data` reads from it.
    """
    figure = np.asarray(axes).ravel()[0].figure
    svg = inline_svg(figure, key, alt)
    content = figure_data(figure) if data is None else data
    width, height = (round(_CSS_PER_INCH * inches) for inches in figure.get_size_inches())
    return Picture(svg, caption, width, key, content, height)
