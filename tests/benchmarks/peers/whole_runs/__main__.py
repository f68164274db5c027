"""Run everybody on every posterior: python -m tests.benchmarks.peers.whole_runs OUT.json [NAME …].

Names of posteriors (cantilever-young, or cantilever-young-index), or of contenders, pick some. `--one-seed` for
one run of each. All run on one processor core.
"""

from __future__ import annotations

import json
import os
import sys
from importlib.metadata import version
from pathlib import Path


def main(out: str, *options: str) -> None:
    """Run, and write what every run gave as JSON, after each posterior."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    # BLAS counts the cores when it is loaded
    from tests.benchmarks.peers.whole_runs.runs import POSTERIORS, measured

    versions = {name: version(name) for name in ("nautilus-sampler", "dynesty")}
    rows = []
    Path(out).parent.mkdir(parents=True, exist_ok=True)
    for posterior in [one for one in POSTERIORS if {one[0], "-".join(one)} & set(options)] or POSTERIORS:
        rows += measured(*posterior, options, one_seed="--one-seed" in options)
        Path(out).write_text(json.dumps({"versions": versions, "rows": rows}, indent=1))


if __name__ == "__main__":
    main(*sys.argv[1:])
