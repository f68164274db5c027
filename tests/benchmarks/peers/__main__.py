"""Run all samplers on all posteriors, or some: python -m tests.benchmarks.peers OUT.json [--one-seed] [NAME …].

Names are of cases or of samplers, such as "NumPyro NUTS"; the report needs all samplers. Everything runs on one
processor core, whatever threads a library starts: processor seconds are then seconds. The samplers take turns, a
seed each, so that what else the machine does slows all of them.
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
    from tests.benchmarks.peers.contenders import CASES, SEEDS, check, contenders
    from tests.benchmarks.peers.target import Target

    rows, differences, near = [], {}, {}
    for case in [option for option in options if option in CASES] or CASES:
        target = Target.load(case, CASES[case])
        differences[case] = check(target)
        ready = []
        everybody = list(contenders(target))
        for contender in [one for one in everybody if one.label in options] or everybody:
            began = time.process_time()
            run = contender.prepare()
            row = {
                "case": case,
                "label": contender.label,
                "model": contender.model,
                "unit": contender.unit,
                "cost": contender.cost(),
                "prepared_s": time.process_time() - began,
                "runs": [],
            }
            rows.append(row)
            ready.append((run, row))
        for seed in SEEDS[: 1 if "--one-seed" in options else None]:
            for run, row in ready:
                began = time.process_time()
                outcome = run(seed)
                row["runs"].append(asdict(outcome.figures()))
                if row["label"] == "hmc":
                    near[case] = target.near_a_bound(outcome.position.reshape(-1, target.problem.ndim))
                took = time.process_time() - began
                name, ess = f"{row['label']} ({row['model']})", round(row["runs"][-1]["ess"])
                print(f"{case}, seed {seed}: {name}, {took:.0f} s, ESS {ess}", flush=True)
    versions = {name: version(name) for name in PEERS}
    result = {"versions": versions, "differences": differences, "near_a_bound": near, "rows": rows}
    Path(out).parent.mkdir(parents=True, exist_ok=True)
    Path(out).write_text(json.dumps(result, indent=1))


if __name__ == "__main__":
    main(*sys.argv[1:])
