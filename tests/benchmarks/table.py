"""Turn measurements into results/benchmarks.md: python -m tests.benchmarks.table RUN.json OUT.md [FRAGMENT.md …].

RUN.json is pytest-benchmark's; its rows and tables are in `extra_info` (see conftest.py). Fragments, Markdown that
other measurements left, are appended as they are.
"""

from __future__ import annotations

import json
import platform
import sys
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from threadpoolctl import threadpool_info

from fmu.tables import markdown_table

HEAD = """# Benchmarks: the speed budget

Written by `make bench`. A ratio is the median over interleaved pairs of processor times, measured in one process
with one BLAS thread, its quartiles in brackets: a machine that is busy with other things slows both sides.

{machine}
"""

SECTIONS = {
    "speed": (
        "Log-probability and gradient",
        "Against the LAPACK calls that no eigenvalue model can do without, on as many matrices of order 20; and "
        "against the obvious thing, SciPy's dense solver on the whole beam.",
    ),
    "accuracy": (
        "Accuracy of the reduced model",
        "The largest error against the full model. Gradients: of log f over the width of the box, relative to the "
        "largest at that theta. The log-probability: at the ends of 1000 random walks in the posterior.",
    ),
    "tower": (
        "A structure of 10⁴ degrees of freedom",
        "The offline stage (a few hundred sparse full solves, compression, verification on fresh points) is paid "
        "once: the basis is cached on disk.",
    ),
    "reductions": (
        "Size against accuracy: Guyan, Craig–Bampton, parametric reduced basis",
        "Largest relative error of the first five weak-plane frequencies of the cantilever (100 DOF) at the "
        "maximum of the posterior of `cantilever-young` by shape. Guyan and Craig–Bampton are built for that one "
        "theta; the reduced basis serves every theta of the box.",
    ),
    "checkpoints": (
        "Keeping a run on disk",
        "Against the same run that is not kept, in turns. Processor time counts what the process does; wall time "
        "also its waiting for the disk, and whatever else the machine did.",
    ),
    "threads": (
        "BLAS threads",
        "Wall time with two BLAS threads over time with one. The log-probability runs its own small problems on "
        "one thread, whatever the process has set; what is left is the cost of switching.",
    ),
}


def main(source: str, target: str, *fragments: str) -> None:
    """Write the report."""
    info = [b["extra_info"] for b in json.loads(Path(source).read_text())["benchmarks"]]
    rows = [row for i in info for row in i.get("rows", [])]
    tables = [table for i in info for table in i.get("tables", [])]
    parts = [HEAD.format(machine=machine())]
    for name, (title, text) in SECTIONS.items():
        parts += [f"## {title}\n", f"{text}\n"]
        of_section = [row for row in rows if row["section"] == name]
        if of_section:
            parts.append(budget_table(of_section))
        parts += [markdown_table(t["head"], t["rows"]) for t in tables if t["section"] == name]
    parts += [Path(fragment).read_text() for fragment in fragments]
    Path(target).parent.mkdir(parents=True, exist_ok=True)
    Path(target).write_text("\n".join(parts))


def budget_table(rows: list[dict[str, Any]]) -> str:
    """Return what was measured beside what was promised."""
    verdict = {True: "yes", False: "**no**", None: "—"}
    cells = [[row["what"], row["budget"], row["measured"], verdict[row["met"]]] for row in rows]
    return markdown_table(["what", "budget", "measured", "met"], cells, words=range(4))


def machine() -> str:
    """Describe processor and software."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    model = next(
        (line.split(":")[1].strip() for line in lines if line.startswith("model name")), platform.machine()
    )
    cores = sum(line.startswith("processor") for line in lines) or "?"
    blas = {
        f"{pool['internal_api']} {pool['version']}" for pool in threadpool_info() if pool["user_api"] == "blas"
    }
    return (
        f"Machine: {model}, {cores} cores; Python {platform.python_version()}, NumPy {np.__version__}, "
        f"SciPy {scipy.__version__}, {', '.join(sorted(blas))}."
    )


if __name__ == "__main__":
    main(*sys.argv[1:])
