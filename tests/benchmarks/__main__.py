"""The speed budget and the samplers' peers.

    python -m tests.benchmarks OUT [--kept DIRECTORY] [--minutes M]

Writes benchmarks.md and benchmarks/peers.png. Every unit is a process of its own.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from tests.benchmarks import table
from tests.benchmarks.peers import report
from tests.benchmarks.peers.contenders import CASES
from tests.validation.kept import Units, each, study_parser

SPEED = "pytest", "tests/benchmarks", "--benchmark-only", "--quiet"


def of_process(*arguments: str) -> str:
    """Return what a module of Python writes into a file, which is named at the end of its arguments."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "out"
        subprocess.run([sys.executable, "-m", *arguments[:-1], f"{arguments[-1]}{file}"], check=True)
        return file.read_text(encoding="utf-8")


def peers(case: str) -> Any:
    """Return the runs of all samplers on a posterior."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "peers.json"
        subprocess.run([sys.executable, "-m", "tests.benchmarks.peers", str(file), case], check=True)
        return json.loads(file.read_text(encoding="utf-8"))


def merged(found: list[Any]) -> dict[str, Any]:
    """Return the runs on several posteriors together, as one process that runs all would write them."""
    together = {"versions": found[0]["versions"], "rows": [row for one in found for row in one["rows"]]}
    of_cases = ("differences", "near_a_bound")
    return together | {name: {k: v for one in found for k, v in one[name].items()} for name in of_cases}


def main() -> int:
    """Measure what is missing, write the page, and return the exit code."""
    asked = study_parser(__doc__).parse_args()
    units = Units(asked.kept, asked.minutes)
    commands = {
        "speed": (*SPEED, "--benchmark-json="),
        "profile": ("tests.benchmarks.profile", ""),
    }
    parts = dict(
        zip(commands, units.completed("parts", commands.items(), lambda one: of_process(*one)), strict=True)
    )
    runs = merged(units.completed("posteriors", each(CASES), peers))
    figure = asked.out / "benchmarks" / "peers.png"
    figure.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        files = {name: Path(folder) / name for name in (*parts, "runs", "peers")}
        for name, text in (parts | {"runs": json.dumps(runs)}).items():
            files[name].write_text(text, encoding="utf-8")
        report.main(str(files["runs"]), str(files["peers"]), str(figure))
        page = asked.out / "benchmarks.md"
        table.main(str(files["speed"]), str(page), str(files["profile"]), str(files["peers"]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
