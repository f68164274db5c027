"""Two thousand problem files changed at random, and some five hundred broken files that problems name.

    python -m tests.validation.hostile OUT [--kept DIRECTORY] [--minutes M] [--workers N]

Each is checked as ``fmu check`` does. Exit code 1 if any ends in a traceback, a crash, a message that does not say
what is wrong, or takes too much time or memory.
"""

from __future__ import annotations

import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from fmu.tables import markdown_table
from tests.validation.hostile_beside import count
from tests.validation.hostile_files import SEED
from tests.validation.hostile_run import BAD_INPUT, MOST_MIB, SOON_S, Verdict, verdicts
from tests.validation.kept import Units, study_parser

PROBLEMS, AT_ONCE = 2000, 100
FAULTS = {
    "traceback": "traceback", "died": "crash", "late": "too late", "memory": "too much memory",
    "message": "poor message", "exit": "other exit code", "start": "no finite start",
}  # fmt: skip
"""What a fault begins with -> what the page calls it."""


def how(verdict: Verdict) -> str:
    """Return how a problem file was changed."""
    return verdict.name.partition(": ")[2]


def what(verdict: Verdict) -> str:
    """Return what a file that a problem names is."""
    return "huge matrix" if verdict.name.startswith("huge") else verdict.name.partition(": ")[0]


def page(problems: Sequence[Verdict], beside: Sequence[Verdict]) -> str:
    """Return what was found as Markdown."""
    everything = [*problems, *beside]
    wrong = [verdict for verdict in everything if verdict.fault]
    refused = [verdict for verdict in everything if verdict.code == BAD_INPUT]
    slowest, largest = max(refused, key=_time), max(everything, key=lambda verdict: verdict.peak_mib)
    faults = "".join(f"- {verdict.name}: {verdict.fault}\n" for verdict in wrong)
    return f"""# Hostile files

Written by `python -m tests.validation.hostile results` (seed {SEED}). {len(problems)} problem files, made from all
templates, their options and the built-in cases by changing structure, types, values, bytes, references
and size; and {len(beside)} broken files of matrices, measured modes and Python that a problem file names.
Each is given to `fmu check`; the huge ones to a process of their own.

**{len(wrong)} of {len(everything)} did what they should not.** A file must be refused with exit code {BAD_INPUT}
and a message in plain words, within {SOON_S:g} s of processor time; or it is checked, and then the
log-probability at the start must be finite. No process may take more than {MOST_MIB / 1024:g} GiB.

{faults}- slowest refusal: {slowest.processor_s:.1f} s of processor time ({slowest.name})
- largest memory: {largest.peak_mib:.0f} MiB ({largest.name})

## Problem files

{_table(problems, "change", how)}
## Files that a problem names

{_table(beside, "file", what)}
The processor time of a refusal is that of the command without the start of Python, some 0.4 s, but for huge files.
"""


def _time(verdict: Verdict) -> float:
    return verdict.processor_s


def _table(found: Sequence[Verdict], title: str, kind: Callable[[Verdict], str]) -> str:
    rows = []
    for name in sorted({kind(verdict) for verdict in found}):
        mine = [verdict for verdict in found if kind(verdict) == name]
        faults = Counter(verdict.fault.partition(" ")[0].rstrip(":") for verdict in mine if verdict.fault)
        refused = [verdict for verdict in mine if verdict.code == BAD_INPUT]
        rows.append([
            name, f"{len(mine)}", f"{len(refused)}", f"{sum(verdict.code == 0 for verdict in mine)}",
            f"{max(map(_time, refused), default=0.0):.1f}", f"{max(verdict.peak_mib for verdict in mine):.0f}",
            ", ".join(f"{n} {FAULTS.get(fault, fault)}" for fault, n in faults.items()) or "none",
        ])  # fmt: skip
    head = [title, "files", "refused", "checked", "slowest refusal, s", "peak, MiB", "faults"]
    return markdown_table(head, rows, words=(0, 6))


def main() -> int:
    """Check all and write the page; 1 if anything is wrong."""
    parser = study_parser(__doc__)
    parser.add_argument("--workers", type=int, default=1, help="processes that share the files")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as made:
        n = count(Path(made))

    def check(names: list[str]) -> list[Any]:
        return [asdict(verdict) for verdict in verdicts(names, SEED, asked.workers)]

    def of(kind: str, files: int) -> list[Verdict]:
        firsts = range(0, files, AT_ONCE)
        jobs = [(k, [f"{kind} {i}" for i in range(k, min(k + AT_ONCE, files))]) for k in firsts]
        found = units.completed(f"batches of {kind} files", jobs, check)
        return [Verdict(**fields) for batch in found for fields in batch]

    units = Units(asked.kept, asked.minutes)
    problems, beside = of("problem", PROBLEMS), of("beside", n)
    (asked.out / "hostile.md").write_text(page(problems, beside), encoding="utf-8")
    return int(any(verdict.fault for verdict in (*problems, *beside)))


if __name__ == "__main__":
    sys.exit(main())
