"""Turn measurements into results/benchmarks.md: python -m tests.benchmarks.table RUN.json OUT.md [FRAGMENT.md …].

RUN.json is the output of pytest-benchmark; its rows and tables are in `extra_info` (see conftest.py). Fragments
are Markdown from other measurements, and are appended unchanged.
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

HEAD = """# Benchmarks: speed, accuracy and size

Does fmu meet its budgets of time, error and memory? {verdict}A ratio is the median over interleaved pairs of
processor times, measured in one process with one BLAS thread; the quartiles are in brackets. Other work on the
machine slows both sides of a pair.
"""

SECTIONS = {
    "speed": (
        "Log-probability and gradient",
        "Times are relative to the LAPACK calls that any eigenvalue model needs, on as many matrices of order "
        "20, and to SciPy's dense solver on the whole beam. *By shape* and *by index* are the ways in which "
        "modes are paired. The last rows compare a model with embedded scatter to the same model without it.",
    ),
    "accuracy": (
        "Accuracy of the reduced model",
        "Measured values are the largest errors against the full model. Gradients are of log f over the width of "
        "the box, relative to the largest gradient at the same θ. Errors of the log-probability are at the ends "
        "of 1000 random walks in the posterior.",
    ),
    "tower": (
        "A structure of 10⁴ degrees of freedom",
        "The offline stage trains the reduced basis and verifies it at new points. It is needed once, because "
        "the basis is stored in the cache.",
    ),
    "reductions": (
        "Size and accuracy: Guyan, Craig–Bampton and parametric reduced basis",
        "The error is the largest relative error of the first five weak-plane frequencies of the cantilever (100 "
        "DOF), at the maximum of the posterior of `cantilever-young` by shape. Guyan and Craig–Bampton are "
        "computed for this θ; the parametric basis applies to every θ in the box.",
    ),
    "checkpoints": (
        "Saving a run to disk",
        "Times are relative to the same run without saving. Processor time excludes waiting for the disk; wall "
        "time includes it, and other work on the machine.",
    ),
    "threads": (
        "BLAS threads",
        "The ratio is wall time with two BLAS threads over wall time with one. The log-probability solves its "
        "small problems on one thread, whatever the setting of the process; its ratio shows the cost of "
        "switching.",
    ),
}


def main(source: str, target: str, *fragments: str) -> None:
    """Write the report."""
    info = [b["extra_info"] for b in json.loads(Path(source).read_text())["benchmarks"]]
    rows = [row for i in info for row in i.get("rows", [])]
    tables = [table for i in info for table in i.get("tables", [])]
    parts = [HEAD.format(verdict=verdict(rows))]
    for name, (title, text) in SECTIONS.items():
        parts += [f"## {title}\n", f"{text}\n"]
        of_section = [row for row in rows if row["section"] == name]
        if of_section:
            parts.append(budget_table(of_section))
        parts += [markdown_table(t["head"], t["rows"]) for t in tables if t["section"] == name]
    parts += [Path(fragment).read_text() for fragment in fragments]
    Path(target).parent.mkdir(parents=True, exist_ok=True)
    Path(target).write_text("\n".join(parts))


def verdict(rows: list[dict[str, Any]]) -> str:
    """Return how many budgets are met, and which ones are not."""
    judged = [row for row in rows if row["met"] is not None]
    missed = [f"- {row['what']}: {row['measured']} (budget: {row['budget']})" for row in judged if not row["met"]]
    if not missed:
        return f"**All {len(judged)} budgets are met.** "
    met = f"**{len(judged) - len(missed)} of {len(judged)} budgets are met.**"
    return f"{met} These are not:\n\n{'\n'.join(missed)}\n\n"


def budget_table(rows: list[dict[str, Any]]) -> str:
    """Return the table of measured values and their budgets."""
    words = {True: "yes", False: "**no**", None: "—"}
    cells = [[row["what"], row["budget"], row["measured"], words[row["met"]]] for row in rows]
    return markdown_table(["quantity", "budget", "measured", "met"], cells, words=range(4))


def machine() -> str:
    """Return a sentence on processor and software; the stamps of pages use it."""
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
