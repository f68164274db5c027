"""Which pages of results/ are older than the code that they depend on; `mark` says so in their first lines."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from tests.results.rooms import digests
from tests.results.stamps import Stamp, is_marked, marked, stale_rooms
from tests.results.studies import STUDIES, Study

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "results"


@dataclass(frozen=True)
class Page:
    """A page that there is.

    Attributes
    ----------
    path : path
    text : str
    study : Study
    now : mapping of str to str
        Digests of the code that it depends on; see `tests.results.rooms.digests`.
    """

    path: Path
    text: str
    study: Study
    now: Mapping[str, str]

    @property
    def stale(self) -> list[str]:
        """The rooms whose code has changed since the page was made."""
        return stale_rooms(self.text, self.now)

    @property
    def is_true(self) -> bool:
        """Whether the first line says what is so."""
        return is_marked(self.text) == bool(self.stale)

    @property
    def line(self) -> str:
        """The page and what has changed, as `make results-status` prints it."""
        stamp = Stamp.of(self.text)
        what = ", ".join(self.stale)
        if stamp is None or not stamp.rooms:
            what = "it is not recorded which code it was made of"
        made = "" if stamp is None else f" ({stamp.date}, commit {stamp.commit})"
        return f"{self.path.relative_to(RESULTS)}{made}: {what}"


def pages(results: Path = RESULTS, root: Path = ROOT) -> Iterator[Page]:
    """Yield the pages of all studies that are there."""
    for study in STUDIES:
        now = digests(root, study.modules)
        for name in study.pages:
            path = results / name
            if path.is_file():
                text = path.read_text(encoding="utf-8")
                yield Page(path, text, study, now)


def mark(found: Iterable[Page]) -> list[Page]:
    """Correct the first lines of pages, and return those that are stale."""
    stale = []
    for page in found:
        if not page.is_true:
            page.path.write_text(marked(page.text, bool(page.stale)), encoding="utf-8")
        stale += [page] * bool(page.stale)
    return stale


def missing(results: Path = RESULTS) -> list[str]:
    """Return the pages of studies that there are not."""
    return [name for study in STUDIES for name in study.pages if not (results / name).is_file()]
