"""Growth of time and memory with degrees of freedom, parameters and chains, and limits of the reduced basis.

    python -m tests.validation.scale OUT [--kept DIRECTORY] [--minutes M] [--quick] [--fast PYTHON]
        [--before CHECKOUT]

Rows are measured one after the other, each in its own process with one BLAS thread. ``--quick`` measures only
small frames, in a minute. PYTHON is an interpreter with the extra ``fast``; `make test-fast` makes the default.
CHECKOUT is a copy of the sources before training by residuals; only its training is measured.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from fmu.fem.modes.solver import PARDISO, SUPERLU
from tests.validation.kept import Units, study_parser
from tests.validation.scale_page import figures, page
from tests.validation.scale_row import Row

FAST = Path(".venv/fast/bin/python")
SIZES = ((3, 3, 2), (28, 3, 2), (70, 6, 4))
HUGE = (140, 12, 10)
PARAMETERS = (2, 5, 10, 20, 50)
CHAINS = (1, 4, 16, 64, 256, 1024)
TOLERANCES = (1e-6, 1e-5, 1e-4, 1e-3)
MEDIUM, LARGE = SIZES[1], SIZES[2]
FEW, MANY = 5, 50

Tables = dict[str, Sequence[Row]]


def rows(quick: bool = False) -> Tables:
    """Return the rows of every table."""
    if quick:
        small = SIZES[0]
        return {
            "dof": [Row(*small, 2, 1e-6, 16)],
            "parameters": [Row(*small, p, 1e-6, 16) for p in (2, 5)],
            "chains": [Row(*small, 2, 1e-6, n, cached=True) for n in (1, 16)],
            "demand": [Row(*small, 5, t, 16) for t in (1e-6, 1e-3)],
            "superlu": [],
        }
    return {
        "dof": [*(Row(*size, FEW, 1e-6) for size in SIZES), Row(*HUGE, FEW, 1e-6, solver=PARDISO)],
        "parameters": [Row(*MEDIUM, p, t) for t in (1e-6, 1e-3) for p in PARAMETERS],
        "chains": [Row(*MEDIUM, FEW, 1e-6, n, cached=True) for n in CHAINS],
        "demand": [Row(*LARGE, MANY, t) for t in TOLERANCES],
        "superlu": [Row(*HUGE, FEW, 1e-6, 1)],
    }


BEFORE = (Row(*LARGE, FEW, 1e-6), Row(*LARGE, MANY, 1e-3), Row(*LARGE, MANY, 1e-6))
"""Rows whose training is also measured with the sources of ``--before``."""
BEFORE_ROWS = Path("results/scale/rows")
"""Folder of these measurements, which are from another commit."""


def measure(row: Row, file: Path, cache: str, python: str, source: Path | None = None) -> None:
    """Measure one row in its own process, with the sources of a checkout if one is given."""
    environment = os.environ | {"FMU_CACHE_DIR": cache, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    given = asdict(row)
    if source is not None:
        environment["PYTHONPATH"] = str(source)
        del given["solver"]
    command = [python, "-m", "tests.validation.scale_row", json.dumps(given), str(file)]
    subprocess.run(command, env=environment, cwd=source, check=True)


def measured_before(folder: Path, checkout: Path) -> None:
    """Measure the training of another checkout, and keep the numbers that the page compares."""
    describe = ["git", "-C", str(checkout), "rev-parse", "--short", "HEAD"]
    commit = subprocess.run(describe, capture_output=True, text=True, check=True).stdout.strip()
    for row in BEFORE:
        file = folder / f"before-{row.name}.json"
        if not file.exists():
            measure(replace(row, chains=1), file.resolve(), "", sys.executable, checkout)
            found = json.loads(file.read_text(encoding="utf-8"))
            kept = {
                name: found[name] for name in ("offline_s", "offline_solves", "basis", "offline_gib", "finished")
            }
            file.write_text(json.dumps(kept | {"commit": commit}, indent=1), encoding="utf-8")
            print(file.stem, flush=True)


def main() -> int:
    """Measure the missing rows and write the page."""
    parser = study_parser(__doc__)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--fast", default=str(FAST))
    parser.add_argument("--before", type=Path)
    asked = parser.parse_args()
    tables, folder = rows(asked.quick), asked.out / "scale" / "rows"
    folder.mkdir(parents=True, exist_ok=True)
    if asked.before is not None:
        measured_before(BEFORE_ROWS, asked.before)
    with tempfile.TemporaryDirectory() as cache:

        def run(row: Row) -> Any:
            file, cached = folder / f"{row.name}.json", row.cached
            python = {SUPERLU: sys.executable, PARDISO: asked.fast}[row.solver]
            if cached and not os.listdir(cache):
                measure(row, file, cache, python)
            measure(row, file, cache if cached else "", python)
            return json.loads(file.read_text(encoding="utf-8"))

        every = {row.name: row for wanted in tables.values() for row in wanted}
        measured = Units(asked.kept, asked.minutes).completed(
            "rows", every.items(), lambda row: {"name": row.name, "row": run(row)}
        )
    known = {one["name"]: one["row"] for one in measured}
    for name, row in known.items():
        (folder / f"{name}.json").write_text(json.dumps(row, indent=1), encoding="utf-8")

    def earlier(name: str) -> Any:
        file = BEFORE_ROWS / f"before-{name}.json"
        return json.loads(file.read_text(encoding="utf-8")) if file.exists() else None

    found = {
        name: [known[row.name] | {"before": earlier(row.name)} for row in wanted if row.name in known]
        for name, wanted in tables.items()
    }
    for name, figure in figures(found).items():
        figure.savefig(asked.out / "scale" / name, dpi=150)
    (asked.out / "scale.md").write_text(page(found), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
