"""Run all samplers on both experiments: python -m tests.benchmarks.peers OUT.json [--short].

Everything runs on one processor core, whatever threads a library starts: processor seconds are then seconds.
"""

from __future__ import annotations

import json
import os
import sys
import time
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path

PEERS = ("numpyro", "jax", "nutpie", "pints", "emcee")


def main(out: str, *options: str) -> None:
    """Run, and write the figures of every run as JSON."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    # XLA and BLAS count the cores when they are loaded
    from tests.benchmarks.peers.contenders import CASES, SEEDS, check, contenders, gradient_cost
    from tests.benchmarks.peers.target import Target

    short = "--short" in options
    rows, differences, gradient = [], {}, {}
    for case in CASES:
        target = Target.load(case, "shape")
        differences[case] = check(target)
        gradient[case] = gradient_cost(target)
        for contender in contenders(target, short):
            began = time.process_time()
            run = contender.prepare()
            row = {
                "case": case,
                "label": contender.label,
                "model": contender.model,
                "unit": contender.unit,
                "parameters": list(target.problem.names),
                "prepared_s": time.process_time() - began,
                "runs": [asdict(run(seed).figures()) for seed in SEEDS[: 1 if short else None]],
            }
            rows.append(row)
            took, ess = time.process_time() - began, [round(r["ess"]) for r in row["runs"]]
            print(f"{case}: {contender.label} ({contender.model}), {took:.0f} s, ESS {ess}", flush=True)
    versions = {name: version(name) for name in PEERS}
    result = {"versions": versions, "differences": differences, "gradient_cost": gradient, "rows": rows}
    Path(out).parent.mkdir(parents=True, exist_ok=True)
    Path(out).write_text(json.dumps(result, indent=1))


if __name__ == "__main__":
    main(*sys.argv[1:])
