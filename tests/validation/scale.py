"""How time and memory grow with degrees of freedom, parameters and chains, and where the reduced basis ends.

    python -m tests.validation.scale OUT_DIRECTORY [--quick] [--keep]

Every row is measured in a process of its own, one after the other, with one BLAS thread. It takes an hour and
more. With ``--keep`` rows that are in OUT_DIRECTORY/scale/rows already are not measured again; ``--quick``
measures small frames alone, in a minute.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from dataclasses import asdict
from pathlib import Path

from tests.validation.scale_page import figures, page
from tests.validation.scale_row import Row

SIZES = ((3, 3, 2), (28, 3, 2), (70, 6, 4))
HUGE = (140, 12, 10)
PARAMETERS = (2, 5, 10, 20, 50)
CHAINS = (1, 4, 16, 64, 256, 1024)
TOLERANCES = (1e-6, 1e-5, 1e-4, 1e-3)
STEPS = 200
MEDIUM, LARGE = SIZES[1], SIZES[2]
FEW, MANY = 5, 50


def rows(quick: bool = False) -> dict[str, list[Row]]:
    """Return the rows of every table."""
    if quick:
        small = SIZES[0]
        return {
            "dof": [Row(*small, 2, 1e-6, 16)],
            "parameters": [Row(*small, p, 1e-6, 16) for p in (2, 5)],
            "chains": [Row(*small, 2, 1e-6, n, cached=True) for n in (1, 16)],
            "demand": [Row(*small, 5, t, 16, 20 if t == 1e-3 else 0) for t in (1e-6, 1e-3)],
        }
    return {
        "dof": [*(Row(*size, FEW, 1e-6) for size in SIZES), Row(*HUGE, FEW, False, 1)],
        "parameters": [Row(*MEDIUM, p, t) for t in (1e-6, 1e-3) for p in PARAMETERS],
        "chains": [Row(*MEDIUM, FEW, 1e-6, n, cached=True) for n in CHAINS],
        "demand": [Row(*LARGE, MANY, t, 64, STEPS if t == 1e-3 else 0) for t in TOLERANCES],
    }


def measure(row: Row, folder: Path, cache: str) -> None:
    """Measure one row in a process of its own."""
    out = folder / f"{row.name}.json"
    environment = os.environ | {"FMU_CACHE_DIR": cache, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "tests.validation.scale_row", json.dumps(asdict(row)), str(out)]
    subprocess.run(command, env=environment, check=True)


def main(out: Path, quick: bool, keep: bool) -> int:
    """Measure what is missing and write the page."""
    tables = rows(quick)
    folder = out / "scale" / "rows"
    folder.mkdir(parents=True, exist_ok=True)
    known = {path.stem for path in folder.glob("*.json")} if keep else set()
    with tempfile.TemporaryDirectory() as cache:
        for row in (row for wanted in tables.values() for row in wanted):
            if row.name in known:
                continue
            if row.cached and not os.listdir(cache):
                measure(row, folder, cache)
            measure(row, folder, cache if row.cached else "")
            known.add(row.name)
            print(row.name, flush=True)
    found = {
        name: [json.loads((folder / f"{row.name}.json").read_text(encoding="utf-8")) for row in wanted]
        for name, wanted in tables.items()
    }
    for name, figure in figures(found).items():
        figure.savefig(out / "scale" / name, dpi=150)
    (out / "scale.md").write_text(page(found), encoding="utf-8")
    return 0


if __name__ == "__main__":
    flags = set(sys.argv[2:])
    sys.exit(main(Path(sys.argv[1]), "--quick" in flags, "--keep" in flags))
