"""Whole runs of large structures, from their files to the report, by the clock and in processor seconds.

    python -m tests.validation.large_structures OUT [--kept DIRECTORY] [--minutes M] [--fast PYTHON] [--only NAME]

PYTHON has the extra ``fast`` (`make test-fast` makes one, the default). A run that has been kept is not repeated.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import brentq

from fmu.numbers import fixed, significant, whole
from fmu.tables import markdown_table
from tests.validation.kept import Units, study_parser
from tests.validation.large_run import WholeRun

FAST = Path(".venv/fast/bin/python")
RUNS = {
    "the frame": WholeRun("frame", (140, 12, 10), 5),
    "the plate": WholeRun("plate", (100, 36, 4), 6),
    "the fine plate": WholeRun("plate", (100, 50, 20), 6),
    "the wing box": WholeRun("wing", (720, 90, 15), 5),
    "the space frame": WholeRun("space-frame", (348, 240, 1), 4),
}
ALLOWED_GIB, ALLOWED_S = 20.0, 45 * 60.0
"""Memory and time of the two largest."""


def page(rows: Mapping[str, Mapping[str, Any]], counts: str) -> str:
    """Return the page in Markdown."""
    return (
        "# Large structures\n\nWritten by `python -m tests.validation.large_structures results` "
        f"({counts}). `fmu run FILE --chains 4`, nothing cached, with the default `reduction = true`, until "
        "every effective sample size is 400: reading, training, search for maxima, sampling, certificate and "
        "report, with PARDISO, which factorises on as many threads as there are processors. The frame of "
        "concrete comes as `.npz` files, its ten frequencies have errors of 0.5 %. The plates are of steel, "
        "2.5 m × 0.9 m × 0.1 m, clamped at one end, of trilinear hexahedra by scikit-fem, as Matrix Market "
        "files; six zones have moduli of their own, and eight frequencies are measured. The wing box of "
        "aluminium, 8 m × 1.6 m × 0.32 m, of shells of four nodes (`tests/validation/wing_box.py`), has a "
        "modulus for each third of its skin, for its spars and for its ribs, and six frequencies. The space frame "
        "of steel, a double-layer grid of 348 × 240 bays held at its edges (`tests/validation/space_frame.py`), "
        "has a modulus for each layer and for the webs of each diagonal, and six frequencies. A phase "
        "within another counts for both. Where the clock is far above the processor seconds, other programs used "
        "the machine.\n\n" + _whole_runs(list(rows), list(rows.values())) + "\n\n" + limits(rows)
    )


def limits(rows: Mapping[str, Mapping[str, Any]]) -> str:
    """Return how many degrees of freedom would fill the memory allowed, from those of the largest two runs.

    Factors by nested dissection grow as n^(4/3) in solids and as n log n in shells (George 1973, *SIAM J. Numer.
    Anal.* 10, 345–363; Lipton, Rose & Tarjan 1979, *SIAM J. Numer. Anal.* 16, 346–358).
    """
    words = []
    for name, kind, growth in (("the fine plate", "solid", _of_solids), ("the wing box", "shell", _of_shells)):
        if name in rows:
            n, peak = int(rows[name]["n_dof"]), float(rows[name]["peak_gib"])
            most = brentq(
                lambda m, n=n, peak=peak, growth=growth: peak * growth(m) / growth(n) - ALLOWED_GIB, n, 1e9
            )
            words.append(f"a {kind} of {significant(most / 1e6, 2)} million degrees of freedom")
    if not words:
        return ""
    return (
        f"{' and '.join(words).capitalize()} would fill {significant(ALLOWED_GIB)} GiB: computed from the peaks "
        "above, with all memory growing as the factors by nested dissection do, as n^(4/3) in solids and as "
        "n log n in shells. Factors that would take more than a sixth of a machine's memory are made in single "
        "precision, and those that still do not fit are kept in files: both take longer, and neither was measured "
        "at this size.\n"
    )


def _of_solids(n: float) -> float:
    return n ** (4.0 / 3.0)


def _of_shells(n: float) -> float:
    return n * float(np.log(n))


def _whole_runs(names: Sequence[str], rows: Sequence[Mapping[str, Any]]) -> str:
    header = ("quantity", *(f"{name}, {whole(row['n_dof'])} DOF" for name, row in zip(names, rows, strict=True)))

    def of(name: str) -> list[float]:
        return [row["certificate"][name] for row in rows]

    lines = [
        ("parameters", *(whole(row["parameters"]) for row in rows)),
        ("whole run by the clock, s", *(fixed(row["wall_s"], 0) for row in rows)),
        ("processor seconds", *(fixed(row["cpu_s"], 0) for row in rows)),
        *(
            (f"of it by the clock: {phase}, s", *(fixed(row["phases"].get(phase, 0.0), 0) for row in rows))
            for phase in dict.fromkeys(phase for row in rows for phase in row["phases"])
        ),
        ("sampler, solves with warm-up", *(f"{row['sampler']}, {whole(row['solves'])}" for row in rows)),
        ("largest R-hat, smallest bulk ESS", *(f"{row['rhat']:.3f}, {row['ess']:.0f}" for row in rows)),
        ("draws with a bound", *(whole(int(n)) for n in of("bound_draws"))),
        ("largest bound of a frequency's error", *(significant(value, 2) for value in of("bound"))),
        ("draws solved by the full model", *(whole(int(n)) for n in of("draws"))),
        ("largest error of a frequency there", *(significant(value, 2) for value in of("frequency_error"))),
        ("largest error of the log-probability there", *(significant(value, 2) for value in of("log_prob_error"))),
        ("promised error of the log-probability", *(significant(value, 2) for value in of("log_prob_tolerance"))),
        ("draws with an error above its bound", *(whole(int(n)) for n in of("bound_exceeded"))),
        ("peak memory, GiB", *(fixed(row["peak_gib"], 2) for row in rows)),
        ("exit code", *(str(row["code"]) for row in rows)),
    ]
    said = [
        f"- {name}: {line}" for name, row in zip(names, rows, strict=True) for line in row["said"] if line.strip()
    ]
    return (markdown_table(header, lines) + "\n\n" + "\n".join(said)).rstrip()


def _measured(run: WholeRun, python: str) -> Any:
    environment = os.environ | {"FMU_CACHE_DIR": "", "OPENBLAS_NUM_THREADS": "1"}
    environment = {
        name: of for name, of in environment.items() if name not in ("OMP_NUM_THREADS", "MKL_NUM_THREADS")
    }
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "run.json"
        command = [python, "-m", "tests.validation.large_run", json.dumps(asdict(run)), str(file)]
        subprocess.run(command, env=environment, check=True)
        return json.loads(file.read_text(encoding="utf-8"))


def main() -> int:
    """Run what is missing and write the page."""
    parser = study_parser(__doc__)
    parser.add_argument("--fast", default=str(FAST))
    parser.add_argument("--only", choices=RUNS)
    asked = parser.parse_args()
    jobs = {name: run for name, run in RUNS.items() if asked.only in (None, name)}
    units = Units(asked.kept, asked.minutes)
    rows = units.completed("runs", jobs.items(), lambda run: _measured(run, asked.fast))
    name_of = {(run.kind, run.size): name for name, run in RUNS.items()}
    found = {name_of[row["kind"], tuple(row["size"])]: row for row in rows}
    (asked.out / "large-structures.md").write_text(page(found, units.counts), encoding="utf-8")
    return int(any(row["code"] or row["peak_gib"] > ALLOWED_GIB or row["wall_s"] > ALLOWED_S for row in rows))


if __name__ == "__main__":
    sys.exit(main())
