"""Whole runs of large structures, from their files to the report: wall time, processor time and memory.

    python -m tests.validation.large_structures OUT [--kept DIRECTORY] [--minutes M] [--fast PYTHON] [--only NAME]

PYTHON is an interpreter with the extra ``fast``; `make test-fast` makes the default. Runs that are kept are not
repeated. The exit code is 1 if a run fails or takes more memory or time than allowed.
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
PHASES = {
    "modes": "modes of the draws",
    "warmup": "warm-up",
    "draws": "sampling",
    "no phase": "the rest",
}
"""Labels of phases whose names in fmu's messages are not clear by themselves."""
ALLOWED_GIB, ALLOWED_S = 20.0, 45 * 60.0
"""Largest memory and wall time of a run."""


def page(rows: Mapping[str, Mapping[str, Any]], counts: str) -> str:
    """Return the page in Markdown; `counts` says how many runs are done."""
    missed = faults(rows)
    minutes = fixed(ALLOWED_S / 60.0, 0)
    verdict = (
        f"**Not all of them: {'; '.join(missed)}.**"
        if missed
        else f"**All runs end with exit code 0, within {minutes} minutes and {significant(ALLOWED_GIB)} GiB.**"
    )
    table = _whole_runs(list(rows), list(rows.values()))
    return f"{_HEAD.format(counts=counts, verdict=verdict)}\n{table}\n\n{limits(rows)}"


def faults(rows: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Return the runs that fail or take more memory or time than allowed, in words."""
    found = []
    for name, row in rows.items():
        if row["code"]:
            found.append(f"{name} ends with exit code {row['code']}")
        if row["peak_gib"] > ALLOWED_GIB:
            found.append(f"{name} takes {fixed(row['peak_gib'], 1)} GiB")
        if row["wall_s"] > ALLOWED_S:
            found.append(f"{name} takes {fixed(row['wall_s'] / 60.0, 0)} minutes")
    return found


_HEAD = """# Large structures

Do complete runs of large structures stay within the time and memory of a workstation? {verdict} The command is
`fmu run FILE --chains 4` with the default `reduction = true` and an empty cache ({counts}). A run reads the
matrices, trains the reduced basis, searches for the maxima, and samples until every effective sample size is
400. It ends with the certificate of the reduced basis and the report. PARDISO factorises, on as many threads as
there are processors.

- The frame is of concrete. It comes as `.npz` files; its ten frequencies have errors of 0.5 %.
- The plates are of steel, 2.5 m × 0.9 m × 0.1 m, clamped at one end. They consist of trilinear hexahedra by
  scikit-fem and come as Matrix Market files. Six zones have separate moduli; eight frequencies are measured.
- The wing box is of aluminium, 8 m × 1.6 m × 0.32 m, with four-node shells (`tests/validation/wing_box.py`). Each
  third of the skin, the spars and the ribs have separate moduli; six frequencies are measured.
- The space frame is of steel, a double-layer grid of 348 × 240 bays supported along its edges
  (`tests/validation/space_frame.py`). Each layer and each direction of the diagonals have separate moduli; six
  frequencies are measured.

The rows *wall time in* give the parts of a run. A part inside another one counts in both. Where the wall time is
much longer than the processor time, other programs used the machine.
"""


def limits(rows: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the degrees of freedom that would fill the allowed memory, from the largest solid and shell.

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
        f"{' and '.join(words).capitalize()} would fill {significant(ALLOWED_GIB)} GiB. This is an extrapolation "
        "from the peaks above: all memory is assumed to grow as the factors by nested dissection do, as n^(4/3) "
        "in solids and as n log n in shells. Factors that would take more than a sixth of the memory of a "
        "machine are computed in single precision, and factors that still do not fit are stored in files. Both "
        "take longer; neither was measured at this size.\n"
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
        ("wall time, s", *(fixed(row["wall_s"], 0) for row in rows)),
        ("processor time, s", *(fixed(row["cpu_s"], 0) for row in rows)),
        *(
            (
                f"wall time in {PHASES.get(phase, phase)}, s",
                *(fixed(row["phases"].get(phase, 0.0), 0) for row in rows),
            )
            for phase in dict.fromkeys(phase for row in rows for phase in row["phases"])
        ),
        ("sampler, solves with warm-up", *(f"{row['sampler']}, {whole(row['solves'])}" for row in rows)),
        ("largest R-hat, smallest bulk ESS", *(f"{row['rhat']:.3f}, {row['ess']:.0f}" for row in rows)),
        ("draws with an error bound", *(whole(int(n)) for n in of("bound_draws"))),
        ("largest bound of a frequency's error", *(significant(value, 2) for value in of("bound"))),
        ("draws solved by the full model", *(whole(int(n)) for n in of("draws"))),
        (
            "largest relative error of a frequency, these draws",
            *(significant(value, 2) for value in of("frequency_error")),
        ),
        (
            "largest error of the log-probability, these draws",
            *(significant(value, 2) for value in of("log_prob_error")),
        ),
        ("tolerance of the log-probability", *(significant(value, 2) for value in of("log_prob_tolerance"))),
        ("draws whose error exceeds its bound", *(whole(int(n)) for n in of("bound_exceeded"))),
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
    """Do the missing runs and write the page; 1 if a run fails or takes too much memory or time."""
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
    return int(bool(faults(found)))


if __name__ == "__main__":
    sys.exit(main())
