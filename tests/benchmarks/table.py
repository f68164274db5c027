"""Turn pytest-benchmark's JSON into results/benchmarks.md: python -m tests.benchmarks.table RUN.json OUT.md."""

from __future__ import annotations

import json
import platform
import sys
from pathlib import Path

import numpy as np
import scipy
from threadpoolctl import threadpool_info

HEAD = """# Benchmarks: the speed budget

Written by `make bench`. A ratio is the median over interleaved pairs measured in one process with one BLAS thread:
a machine that is busy with other things slows both sides. Absolute times mean little there and are not given.

{machine}

## Log-probability, gradient and reduced model

| what | budget | measured | met |
|---|---|---|---|
{rows}

## A structure of 10⁴ degrees of freedom

{tower}

The offline stage (a few hundred sparse full solves, compression, verification on fresh points) is paid once: the
basis is cached on disk.

## Size against accuracy: Guyan, Craig–Bampton, parametric reduced basis

Largest relative error of the first five weak-plane frequencies of the cantilever (100 DOF) at the maximum of the
posterior of `cantilever-young` by shape. Guyan and Craig–Bampton are built for that one theta; the reduced basis
serves every theta of the box.

| reduction | size | largest relative error |
|---|---|---|
{reductions}
"""


def main(source: str, target: str) -> None:
    """Write the table."""
    info = [b["extra_info"] for b in json.loads(Path(source).read_text())["benchmarks"]]
    rows = [
        f"| {i['what']} | {i['budget']} | {i['measured']} | {'yes' if i['met'] else '**no**'} |"
        for i in info
        if "what" in i and "reductions" not in i
    ]
    tower = next((i["tower"] for i in info if "tower" in i), {})
    reductions = next((i["reductions"] for i in info if "reductions" in i), [])
    text = HEAD.format(
        machine=machine(),
        rows="\n".join(rows),
        tower="\n".join(["| | |", "|---|---|", *(f"| {name} | {value} |" for name, value in tower.items())]),
        reductions="\n".join(f"| {name} | {size} | {error:.1e} |" for name, size, error in reductions),
    )
    Path(target).parent.mkdir(parents=True, exist_ok=True)
    Path(target).write_text(text)


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
