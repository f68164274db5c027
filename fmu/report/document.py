"""What a page of a report consists of; how it looks is the templates' business."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from markupsafe import Markup


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
    """A name that leads to another page of the report."""

    words: str
    target: str


@dataclass(frozen=True)
class PageTable:
    """A table.

    Attributes
    ----------
    caption : str
    header : tuple of str
    rows : tuple of tuple of (str or Link)
        As long as the header each; the first cell names the row.
    words : tuple of int
        Columns that hold words, aligned to the left, beside the first.
    """

    kind: ClassVar[str] = "table"
    caption: str
    header: tuple[str, ...]
    rows: tuple[tuple[str | Link, ...], ...]
    words: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row) != len(self.header):
                raise ValueError(f"rows: must have {len(self.header)} cells (got {row})")


@dataclass(frozen=True)
class Picture:
    """A drawing.

    Attributes
    ----------
    svg : Markup
        With its description for those who do not see it.
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
    """Drawings side by side where the page is wide enough."""

    kind: ClassVar[str] = "pictures"
    pictures: tuple[Picture, ...]


@dataclass(frozen=True)
class Code:
    """Text that is shown as it stands."""

    kind: ClassVar[str] = "code"
    words: str


@dataclass(frozen=True)
class Details:
    """What opens on request."""

    kind: ClassVar[str] = "details"
    summary: str
    parts: tuple[Part, ...]


Part = Text | Items | PageTable | Picture | Pictures | Code | Details


@dataclass(frozen=True)
class PageSection:
    """A heading and what is below it."""

    id: str
    title: str
    parts: tuple[Part, ...]


@dataclass(frozen=True)
class Omitted:
    """A section that a run has nothing for.

    Attributes
    ----------
    title : str
    reason : str
        Why not: half a sentence, without its full stop.
    """

    title: str
    reason: str


@dataclass(frozen=True)
class Verdict:
    """An answer to one question about a run.

    Attributes
    ----------
    question, answer : str
    is_good : bool or None
        None where the question does not apply.
    because : str
        Heading of the reasons.
    reasons : tuple of str
        What the answer rests on.
    """

    question: str
    answer: str
    is_good: bool | None
    because: str
    reasons: tuple[str, ...]


@dataclass(frozen=True)
class Page:
    """A page.

    Attributes
    ----------
    title : str
        Its heading.
    lead : str
        One line below it.
    verdicts : tuple of Verdict
        What comes first.
    sections : tuple of PageSection
    others : tuple of Link
        The other pages of the report.
    footer : str
    """

    title: str
    lead: str
    verdicts: tuple[Verdict, ...]
    sections: tuple[PageSection, ...]
    others: tuple[Link, ...]
    footer: str
