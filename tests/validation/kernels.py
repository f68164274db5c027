"""The whole test suite with the arithmetic of other processors: once with each OpenBLAS kernel that can run here.

    python -m tests.validation.kernels OUT [--kept DIRECTORY] [--minutes M]

The last bits of a matrix product depend on the kernel. A test that passes with only one kernel has a tolerance
below the rounding errors of its arithmetic. The exit code is 1 if a test failed.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from collections.abc import Sequence
from typing import NamedTuple

from fmu.tables import markdown_table
from tests.kernels import kernels
from tests.validation.kept import Units, each, study_parser

LEFT_OUT = ("tests/programs", "tests/report/test_there_and_back.py")
"""Tests that need other programs; `make test-programs` runs them."""


class Outcome(NamedTuple):
    """Result of a run of pytest with one kernel."""

    kernel: str
    passed: int
    skipped: int
    failed: tuple[str, ...]
    minutes: float


def run_suite(kernel: str) -> Outcome:
    """Run the suite with a kernel and show its output.

    Raises
    ------
    RuntimeError
        If pytest ended without a count of tests.
    """
    environment = os.environ | {"OPENBLAS_CORETYPE": kernel, "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "pytest", "--quiet", "--numprocesses=auto", "--no-loadscope-reorder"]
    began, said = time.monotonic(), []
    ignored = [f"--ignore={path}" for path in LEFT_OUT]
    with subprocess.Popen([*command, *ignored], env=environment, stdout=subprocess.PIPE, text=True) as run:
        for line in run.stdout or ():
            print(line, end="", flush=True)
            said.append(line)
    return outcome(kernel, said, (time.monotonic() - began) / 60.0)


def outcome(kernel: str, said: Sequence[str], minutes: float) -> Outcome:
    """Return the result of a run from the lines of pytest's output."""
    failed = tuple(re.split(r" - ", line.split(maxsplit=1)[1])[0].strip() for line in said if is_failure(line))
    last = next((line for line in reversed(said) if re.search(r"\d+ (passed|failed|error)", line)), None)
    if last is None:
        raise RuntimeError(f"pytest: must say how many tests passed with {kernel} (got {''.join(said[-3:])!r})")
    found = {word: int(number) for number, word in re.findall(r"(\d+) (passed|skipped)", last)}
    return Outcome(kernel, found.get("passed", 0), found.get("skipped", 0), failed, minutes)


def is_failure(line: str) -> bool:
    """Say whether a line of pytest's summary names a test that failed."""
    return line.startswith(("FAILED ", "ERROR "))


def page(outcomes: Sequence[Outcome]) -> str:
    """Return the page as Markdown."""
    rows = [(one.kernel, one.passed, one.skipped, len(one.failed), f"{one.minutes:.1f}") for one in outcomes]
    failures = [f"- {one.kernel}: `{test}`" for one in outcomes for test in one.failed]
    verdict = "**No test failed with any kernel.**"
    if failures:
        of = [f"{len(one.failed)} with {one.kernel}" for one in outcomes if one.failed]
        verdict = f"**Tests failed: {', '.join(of)}.**"
    columns = ("kernel", "passed", "skipped", "failed", "minutes")
    named = "\nThe tests that failed:\n\n" + "\n".join(failures) + "\n" if failures else ""
    return f"""# The test suite with each OpenBLAS kernel

Do the tests pass with the arithmetic of other processors? {verdict} The last bits of a matrix product depend on
the kernel that OpenBLAS chooses for a processor. The test suite, without the tests that need other programs,
runs once with each kernel in the table (`kernels` in `tests/kernels.py`).

{markdown_table(columns, rows)}{named}"""


def main() -> int:
    """Run the suite with every kernel and write the page; return the exit code."""
    asked = study_parser(__doc__).parse_args()
    units = Units(asked.kept, asked.minutes)
    outcomes = units.completed("kernels", each(kernels()), run_suite, lambda kept: Outcome(*kept))
    (asked.out / "kernels.md").write_text(page(outcomes), encoding="utf-8")
    return int(any(one.failed for one in outcomes))


if __name__ == "__main__":
    sys.exit(main())
