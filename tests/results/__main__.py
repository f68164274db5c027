"""Write the pages of results/, and say which are older than the code.

python -m tests.results run [NAME …] [--again] [--times F]
python -m tests.results status
python -m tests.results list
"""

from __future__ import annotations

import argparse
import shutil
import signal
import sys

from tests.results.schedule import KEPT, Schedule
from tests.results.status import mark, missing, pages
from tests.results.studies import STUDIES, chosen, wall_minutes


def run(names: tuple[str, ...], again: bool, times: float) -> int:
    """Run the studies whose pages are missing or stale, or those that are named `again`; see `chosen`."""
    stale, absent = {page.study.name for page in pages() if page.stale}, set(missing())
    wanted = chosen(names, times)
    if again:
        for study in wanted:
            shutil.rmtree(KEPT / study.name, ignore_errors=True)
    studies = [study for study in wanted if again or study.name in stale or not absent.isdisjoint(study.pages)]
    wrong = Schedule(studies).run()
    mark(pages())
    print(*wrong, sep="\n")
    return 1 if wrong else 0


def status() -> int:
    """Print the stale pages, and correct the first lines of all."""
    stale = mark(pages())
    print(*(page.line for page in stale), *(f"{name}: missing" for name in missing()), sep="\n")
    return 0


def table() -> int:
    """Print the studies."""
    for study in STUDIES:
        alone = "  alone" if study.exclusive else ""
        print(f"{study.name:18} {study.group:9} {study.minutes:3g} min{alone:7}  {', '.join(study.pages)}")
    print(f"In all {wall_minutes() / 60.0:.1f} hours by the clock on two cores, at most.")
    return 0


def _positive(text: str) -> float:
    """Return a positive number; argparse prints the error."""
    number = float(text)
    if not 0.0 < number < float("inf"):
        raise argparse.ArgumentTypeError(f"must be positive and finite (got {text})")
    return number


def main() -> int:
    """Return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m tests.results", description=__doc__.splitlines()[0])
    commands = parser.add_subparsers(dest="command", required=True)
    of_run = commands.add_parser("run", help="write the pages that are missing or stale")
    of_run.add_argument("names", nargs="*", help="studies or groups of studies; all by default")
    of_run.add_argument("--again", action="store_true", help="from the beginning, stale or not")
    text = "multiply all budgets, on a slow machine"
    of_run.add_argument("--times", type=_positive, metavar="F", default=1.0, help=text)
    commands.add_parser("status", help="list stale pages, and say so in their first lines")
    commands.add_parser("list", help="list the studies")
    asked = parser.parse_args()
    if asked.command == "run":
        return run(tuple(asked.names), asked.again, asked.times)
    return status() if asked.command == "status" else table()


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    sys.exit(main())
