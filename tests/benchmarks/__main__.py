"""Benchmarks: budgets of speed, accuracy and size, and a profile of the time.

    python -m tests.benchmarks OUT [--kept DIRECTORY] [--minutes M]

Writes benchmarks.md. Every unit runs in its own process.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

from tests.benchmarks import table
from tests.validation.kept import Units, study_parser

SPEED = "pytest", "tests/benchmarks", "--benchmark-only", "--quiet"


def of_process(*arguments: str) -> str:
    """Run a Python module whose last argument ends with the name of a file, and return the text of this file."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "out"
        subprocess.run([sys.executable, "-m", *arguments[:-1], f"{arguments[-1]}{file}"], check=True)
        return file.read_text(encoding="utf-8")


def main() -> int:
    """Measure the missing units, write the page, and return the exit code."""
    asked = study_parser(__doc__).parse_args()
    units = Units(asked.kept, asked.minutes)
    commands = {
        "speed": (*SPEED, "--benchmark-json="),
        "profile": ("tests.benchmarks.profile", ""),
    }
    parts = dict(
        zip(commands, units.completed("parts", commands.items(), lambda one: of_process(*one)), strict=True)
    )
    with tempfile.TemporaryDirectory() as folder:
        files = {name: Path(folder) / name for name in parts}
        for name, text in parts.items():
            files[name].write_text(text, encoding="utf-8")
        table.main(str(files["speed"]), str(asked.out / "benchmarks.md"), str(files["profile"]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
