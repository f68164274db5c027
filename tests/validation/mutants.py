"""Put every deliberate fault into a copy of the project, and find the test that catches it.

    python -m tests.validation.mutants OUT [--kept DIRECTORY] [--minutes M] [--only WORD …] [--workers N]

With `--only`, only the faults are tried whose names contain one of the words. The test files of a fault run one
after the other, the fastest first. Exit code 1 if a fault survives, 2 if tests fail without any fault.
"""

from __future__ import annotations

import ast
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from queue import Queue

from fmu.tables import markdown_table
from tests.validation.fault import Fault
from tests.validation.faults import FAULTS
from tests.validation.kept import Units, each, fields_of, study_parser

PROJECT = Path(__file__).parents[2]
PATIENCE_S = 180.0
"""Time limit of one test file. A fault that makes the tests exceed it is not caught: it survives."""
FAILED = re.compile(r"^(?:FAILED|ERROR) (.*?)(?: - .*)?$", re.MULTILINE)
NUMERICAL, MANY = ("fem", "posterior", "samplers", "surrogates", "analysis"), 15
"""Packages with formulas, and the fewest arithmetic operations of a module that counts as having formulas."""
ARITHMETIC = (ast.Add, ast.Sub, ast.Mult, ast.Div, ast.Pow, ast.MatMult)
TESTS_FAILED = 1
"""Exit code of pytest if tests ran and failed."""


@dataclass(frozen=True)
class Verdict:
    """The first test that failed, or None if all passed; and the time taken."""

    caught_by: str | None
    wall_s: float


def mutated(text: str, fault: Fault) -> str:
    """Return the text of a file with the fault.

    Raises
    ------
    ValueError
        If the text to be replaced does not occur exactly once.
    """
    found = text.count(fault.old)
    if found != 1:
        raise ValueError(f"{fault.name}: {fault.file} must contain {fault.old!r} once (got {found} times)")
    return text.replace(fault.old, fault.new)


def copy_of_the_project(directory: Path) -> Path:
    """Copy the parts of the project that the tests need into `directory`, and return the root of the copy."""
    root = directory / "project"
    root.mkdir(parents=True)
    for part in ("fmu", "tests"):
        shutil.copytree(PROJECT / part, root / part, ignore=shutil.ignore_patterns("__pycache__", ".*_cache"))
    for part in ("pyproject.toml", "README.md"):
        shutil.copy(PROJECT / part, root / part)
    where = _python(root, "-c", "import fmu; print(fmu.__file__)").stdout.strip()
    if not Path(where).is_relative_to(root):
        raise RuntimeError(f"the copy must test itself (it imports {where})")
    return root


def try_tests(root: Path, tests: Sequence[str]) -> Verdict:
    """Run tests of the copy until one fails, or until they have taken `PATIENCE_S` per file.

    Raises
    ------
    RuntimeError
        If pytest cannot run the tests.
    """
    began = time.perf_counter()
    options = ("-x", "-q", "--tb=no", "-rfE", "-p", "no:cacheprovider")
    try:
        done = _python(root, "-m", "pytest", *options, *tests, patience_s=PATIENCE_S * len(tests))
    except subprocess.TimeoutExpired:
        return Verdict(None, time.perf_counter() - began)
    wall_s = time.perf_counter() - began
    if done.returncode == 0:
        return Verdict(None, wall_s)
    failed = FAILED.search(done.stdout)
    if done.returncode != TESTS_FAILED or failed is None:
        raise RuntimeError(f"pytest {' '.join(tests)} ended with {done.returncode}:\n{done.stdout}\n{done.stderr}")
    return Verdict(failed.group(1), wall_s)


def try_fault(root: Path, fault: Fault, tests: Sequence[str]) -> Verdict:
    """Put the fault into the copy, run the tests, and remove the fault."""
    path = root / fault.file
    sound = path.read_text()
    path.write_text(mutated(sound, fault))
    try:
        return try_tests(root, tests)
    finally:
        path.write_text(sound)


def main() -> int:
    """Try the faults, write the table, and return the exit code."""
    parser = study_parser(__doc__)
    parser.add_argument("--only", nargs="*", default=[""], metavar="WORD")
    parser.add_argument("--workers", type=int, default=2, help="copies of the project that are tested at once")
    asked = parser.parse_args()
    faults = [fault for fault in FAULTS if any(word in fault.name for word in asked.only)]
    units, tests = Units(asked.kept, asked.minutes), sorted({test for fault in faults for test in fault.tests})
    with tempfile.TemporaryDirectory() as directory:
        roots: Queue[Path] = Queue()
        for number in range(asked.workers):
            roots.put(copy_of_the_project(Path(directory) / str(number)))

        def in_a_copy(run: Callable[[Path], Verdict]) -> Verdict:
            root = roots.get()
            try:
                return run(root)
            finally:
                roots.put(root)

        def sound(test: str) -> Verdict:
            return in_a_copy(lambda root: try_tests(root, [test]))

        def put(fault: Fault) -> Verdict:
            return in_a_copy(lambda root: try_fault(root, fault, sorted(fault.tests, key=seconds.__getitem__)))

        read = fields_of(Verdict)
        found = units.completed("files of tests", each(tests), sound, read, asked.workers)
        failing = [verdict.caught_by for verdict in found if verdict.caught_by is not None]
        if failing or len(found) < len(tests):
            print(f"without any fault: {', '.join(failing) or 'not all test files have run'}")
            return 2
        seconds = {test: verdict.wall_s for test, verdict in zip(tests, found, strict=True)}
        jobs = ((fault.name, fault) for fault in faults)
        verdicts = dict(zip(faults, units.completed("faults", jobs, put, read, asked.workers), strict=False))
    (asked.out / "mutants.md").write_text(page(verdicts, units.processor_s), encoding="utf-8")
    return 1 if any(verdict.caught_by is None for verdict in verdicts.values()) else 0


def operations(source: str) -> int:
    """Return the number of arithmetic operations in a module."""
    nodes = ast.walk(ast.parse(source))
    return sum(isinstance(node, ast.BinOp) and isinstance(node.op, ARITHMETIC) for node in nodes)


def without_a_fault() -> tuple[list[str], int]:
    """Return the modules with formulas that have no fault, and the number of modules with formulas."""
    counts = {
        str(path.relative_to(PROJECT)): operations(path.read_text())
        for room in NUMERICAL
        for path in sorted((PROJECT / "fmu" / room).rglob("*.py"))
    }
    formulas = [name for name, count in counts.items() if count >= MANY]
    return sorted(set(formulas) - {fault.file for fault in FAULTS}), len(formulas)


def page(verdicts: dict[Fault, Verdict], processor_s: float) -> str:
    """Return the report."""
    missing, formulas = without_a_fault()
    rows = [
        [fault.name, f"`{fault.file}`", f"`{verdict.caught_by}`" if verdict.caught_by else "**survives**"]
        for fault, verdict in verdicts.items()
    ]
    survivors = [fault.name for fault, verdict in verdicts.items() if verdict.caught_by is None]
    return PAGE.format(
        caught=len(rows) - len(survivors),
        faults=len(rows),
        survivors=f" Survivors: {'; '.join(survivors)}." if survivors else "",
        minutes=processor_s / 60.0,
        rows=markdown_table(["fault", "file", "caught by"], rows, (0, 1, 2)),
        formulas=formulas,
        many=MANY,
        rooms=", ".join(NUMERICAL),
        missing=len(missing),
        names=": " + ", ".join(f"`{name}`" for name in missing) if missing else "",
    )


def _python(root: Path, *arguments: str, patience_s: float = PATIENCE_S) -> subprocess.CompletedProcess[str]:
    # No byte code: Python could take that of another fault, if file size and time stamp are equal.
    environment = os.environ | {
        "PYTHONPATH": os.fspath(root),
        "PYTHONDONTWRITEBYTECODE": "1",
        "OPENBLAS_NUM_THREADS": "1",
    }
    command = [sys.executable, *arguments]
    return subprocess.run(
        command, cwd=root, env=environment, capture_output=True, text=True, timeout=patience_s, check=False
    )


PAGE = """# Deliberate faults

Do the tests notice wrong formulas? **{caught} of {faults} faults caught.{survivors}**

Each fault is one change to a source file, such as a missing factor, a wrong sign or a wrong index, with which the
program still runs and gives plausible results (`tests/validation/faults.py`). It is put into a copy of the
project, and the tests of this part of the code run until one fails. A fault survives if no test fails, or if the
tests hang. Without a fault, all of these tests pass. The study took {minutes:.0f} minutes of processor time.

Of the {formulas} modules of {rooms} with at least {many} arithmetic operations, {missing} have no fault{names}.

{rows}"""


if __name__ == "__main__":
    sys.exit(main())
