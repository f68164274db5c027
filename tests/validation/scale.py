"""How time and memory grow with degrees of freedom, parameters and chains, and where the reduced basis ends.

    python -m tests.validation.scale OUT_DIRECTORY [--quick] [--keep | --page] [--fast PYTHON] [--before CHECKOUT]

Every row is measured in a process of its own, one after the other, with one BLAS thread. It takes an hour and
more. With ``--keep`` rows that are in OUT_DIRECTORY/scale/rows already are not measured again, with ``--page``
none is, and the page is that of the rows that are there; ``--quick`` measures small frames alone, in a minute.
PYTHON has the extra ``fast`` (`make test-fast` makes one, the default); CHECKOUT is a copy of the sources before
training by residuals, of which the training alone is measured.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

from fmu.fem.modes.solver import PARDISO, SUPERLU
from tests.validation.scale_files import CELLS
from tests.validation.scale_page import figures, page
from tests.validation.scale_row import Row
from tests.validation.scale_run import WholeRun

FAST = Path(".venv/fast/bin/python")
SIZES = ((3, 3, 2), (28, 3, 2), (70, 6, 4))
HUGE = (140, 12, 10)
PARAMETERS = (2, 5, 10, 20, 50)
CHAINS = (1, 4, 16, 64, 256, 1024)
TOLERANCES = (1e-6, 1e-5, 1e-4, 1e-3)
MEDIUM, LARGE = SIZES[1], SIZES[2]
FEW, MANY = 5, 50

Tables = dict[str, Sequence[Row | WholeRun]]


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
            "runs": [WholeRun("frame", small, 2, 1e-6), WholeRun("plate", (6, 3, 2), 6, 1e-6)],
        }
    return {
        "dof": [*(Row(*size, FEW, 1e-6) for size in SIZES), Row(*HUGE, FEW, 1e-6, solver=PARDISO)],
        "parameters": [Row(*MEDIUM, p, t) for t in (1e-6, 1e-3) for p in PARAMETERS],
        "chains": [Row(*MEDIUM, FEW, 1e-6, n, cached=True) for n in CHAINS],
        "demand": [Row(*LARGE, MANY, t) for t in TOLERANCES],
        "superlu": [Row(*HUGE, FEW, 1e-6, 1)],
        "runs": [
            WholeRun("frame", HUGE, FEW, 1e-6, PARDISO),
            WholeRun("plate", CELLS, 6, 1e-6, PARDISO),
        ],
    }


BEFORE = (Row(*LARGE, FEW, 1e-6), Row(*LARGE, MANY, 1e-3), Row(*LARGE, MANY, 1e-6))
"""Rows of which the training before this one is measured too."""


def measure(row: Row | WholeRun, file: Path, cache: str, python: str, source: Path | None = None) -> None:
    """Measure one row in a process of its own, by the sources of a checkout if given."""
    environment = os.environ | {"FMU_CACHE_DIR": cache, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    module = "scale_row" if isinstance(row, Row) else "scale_run"
    given = asdict(row)
    if source is not None:
        environment["PYTHONPATH"] = str(source)
        del given["solver"]
    command = [python, "-m", f"tests.validation.{module}", json.dumps(given), str(file)]
    subprocess.run(command, env=environment, cwd=source, check=True)


def measured_before(folder: Path, checkout: Path) -> None:
    """Measure the training of another checkout, and keep what is compared."""
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


def main(out: Path, quick: bool, keep: bool, page_only: bool, fast: str, before: Path | None) -> int:
    """Measure what is missing and write the page."""
    tables = rows(quick)
    folder = out / "scale" / "rows"
    folder.mkdir(parents=True, exist_ok=True)
    known = {path.stem for path in folder.glob("*.json")} if keep or page_only else set()
    pythons = {SUPERLU: sys.executable, PARDISO: fast}
    with tempfile.TemporaryDirectory() as cache:
        for row in (row for wanted in tables.values() for row in wanted):
            if row.name in known or page_only:
                continue
            file, cached = folder / f"{row.name}.json", isinstance(row, Row) and row.cached
            if cached and not os.listdir(cache):
                measure(row, file, cache, pythons[row.solver])
            measure(row, file, cache if cached else "", pythons[row.solver])
            known.add(row.name)
            print(row.name, flush=True)
    if before is not None:
        measured_before(folder, before)

    def read(name: str) -> dict[str, object] | None:
        file = folder / f"{name}.json"
        return json.loads(file.read_text(encoding="utf-8")) if file.exists() else None

    found = {
        name: [of | {"before": read(f"before-{row.name}")} for row in wanted if (of := read(row.name)) is not None]
        for name, wanted in tables.items()
    }
    for name, figure in figures(found).items():
        figure.savefig(out / "scale" / name, dpi=150)
    (out / "scale.md").write_text(page(found), encoding="utf-8")
    return 0


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("out", type=Path)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--keep", action="store_true")
    parser.add_argument("--page", action="store_true", dest="page_only")
    parser.add_argument("--fast", default=str(FAST))
    parser.add_argument("--before", type=Path)
    sys.exit(main(**vars(parser.parse_args())))
