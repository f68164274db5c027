"""Two thousand randomly changed problem files, and some five hundred broken files that problem files name.

    python -m tests.validation.hostile OUT [--kept DIRECTORY] [--minutes M] [--workers N]

Each file is given to ``fmu check``. The exit code is 1 if any check ends in a traceback, a crash or an unclear
message, or takes too much time or memory.
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
"""First word of a fault -> its name on the page."""
LABELS = {
    "another file in its place": "file missing, or replaced by a directory, link, pipe or device",
    "lines lost, moved or twice": "lines deleted, moved or repeated", "nested deeply": "deep nesting",
    "very much of it": "very many entries", "function": "Python function, made by hand",
    "python": "Python file, bytes changed", "table": "table, made by hand", "tables": "table, bytes changed",
    "operational": "operational modal analysis",
}  # fmt: skip
"""Name of a change or of a kind of file in a verdict -> its name on the page."""


def how(verdict: Verdict) -> str:
    """Return the change that was made to a problem file."""
    change = verdict.name.partition(": ")[2]
    return LABELS.get(change, change)


def what(verdict: Verdict) -> str:
    """Return the kind of a file that a problem file names."""
    kind = "huge matrix" if verdict.name.startswith("huge") else verdict.name.partition(": ")[0]
    return LABELS.get(kind, kind)


def page(problems: Sequence[Verdict], beside: Sequence[Verdict]) -> str:
    """Return the page in Markdown."""
    everything = [*problems, *beside]
    wrong = [verdict for verdict in everything if verdict.fault]
    refused = [verdict for verdict in everything if verdict.code == BAD_INPUT]
    slowest, largest = max(refused, key=_time), max(everything, key=lambda verdict: verdict.peak_mib)
    faults = "".join(f"- {verdict.name}: {verdict.fault}\n" for verdict in wrong)
    verdict = f"{len(wrong)} of {len(everything)} files cause a fault" if wrong else "No file causes a fault"
    return f"""# Hostile input files

Does `fmu check` refuse broken input files with clear messages, in short time and little memory? **{verdict}.**
The {len(problems)} problem files are made from all templates with their options and from the built-in cases, by
random changes of structure, types, values, bytes, references and size (seed {SEED}). The {len(beside)} other
files are broken matrices, tables of measured modes and Python files that a problem file names.

A file may be refused, with exit code {BAD_INPUT} and a clear message, within {SOON_S:g} s of processor time.
Otherwise it is checked; then the log-probability at the start values must be finite. No process may take more
than {MOST_MIB / 1024:g} GiB. Huge matrices are checked in a separate process.

{faults}- slowest refusal: {slowest.processor_s:.1f} s of processor time ({slowest.name})
- largest memory: {largest.peak_mib:.0f} MiB ({largest.name})

## Problem files

{_table(problems, "change", how)}
## Files that a problem file names

{_table(beside, "file", what)}
The time of a refusal excludes the start of Python, about 0.4 s, except for huge matrices.
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
    """Check all files and write the page; return 1 if any file causes a fault."""
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
