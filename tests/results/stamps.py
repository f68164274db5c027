"""What a page of results/ was made of, at its end; and its first line if the code has changed since."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass

from tests.results.rooms import changed

NOT_KNOWN = "Machine and versions were not recorded."
_FOOT = re.compile(r"\n\*Made on .*?\*\n\n<!-- made of (\{.*\}) -->\n\Z", re.DOTALL)
_STALE = re.compile(r"\A> \*\*Stale\*\*: .*\n\n")


@dataclass(frozen=True)
class Stamp:
    """What a page was made of.

    Attributes
    ----------
    commit, date : str
        The date as year-month-day.
    command : str
    made_by : str
        Sentence on machine and versions, or that they were not recorded.
    units : str
        How many units of work of how many, such as ``17 of 300 sets``; empty if unknown.
    rooms : mapping of str to str
        Digests of the code; see `tests.results.rooms.digests`.
    """

    commit: str
    date: str
    command: str
    made_by: str
    units: str
    rooms: Mapping[str, str]

    @classmethod
    def of(cls, page: str) -> Stamp | None:
        """Return the stamp of a page, None if it has none."""
        found = _FOOT.search(page)
        return None if found is None else cls(**json.loads(found[1]))

    def put_on(self, page: str) -> str:
        """Return a page with this stamp, in the place of the one that it had."""
        units = f" {self.units[0].upper()}{self.units[1:]}." if self.units else ""
        words = f"*Made on {self.date} of commit {self.commit} by `{self.command}`.{units} {self.made_by}*"
        return f"{without_stamp(page)}\n{words}\n\n<!-- made of {json.dumps(asdict(self))} -->\n"


def without_stamp(page: str) -> str:
    """Return a page as its study wrote it, with one line feed at its end."""
    return _STALE.sub("", _FOOT.sub("", page)).rstrip("\n") + "\n"


def stale_rooms(page: str, now: Mapping[str, str]) -> list[str]:
    """Return the rooms whose code has changed since a page was made; all of them if it does not know."""
    stamp = Stamp.of(page)
    return sorted(now) if stamp is None else changed(stamp.rooms, now)


def is_marked(page: str) -> bool:
    """Say whether the first line of a page says that it is stale."""
    return _STALE.match(page) is not None


def marked(page: str, is_stale: bool) -> str:
    """Return a page whose first line says that it is stale, or does not."""
    stamp, rest = Stamp.of(page), _STALE.sub("", page)
    if not is_stale:
        return rest
    if stamp is None or not stamp.rooms:
        words = "it is not recorded which code this page was made of."
    else:
        words = (
            f"this page was made on {stamp.date} of commit {stamp.commit}, and code that it depends on has "
            "changed since. `make results-status` lists what."
        )
    return f"> **Stale**: {words}\n\n{rest}"
