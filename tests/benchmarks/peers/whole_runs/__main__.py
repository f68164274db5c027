"""Run everybody on every posterior, search and warm-up counted.

    python -m tests.benchmarks.peers.whole_runs OUT [--kept DIRECTORY] [--minutes M] [--only NAME …] [--one-seed]

Writes whole-runs.md and benchmarks/whole-runs.png. Names of posteriors (cantilever-young, or
cantilever-young-index), or of contenders, pick some. `--one-seed` for one run of each. All run on one processor
core.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
from importlib.metadata import version
from pathlib import Path

from tests.validation.kept import Units, study_parser


def main() -> int:
    """Run what is missing, write the page, and return the exit code."""
    parser = study_parser(__doc__)
    parser.add_argument("--only", nargs="*", default=[])
    parser.add_argument("--one-seed", action="store_true")
    asked = parser.parse_args()
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    # BLAS counts the cores when it is loaded
    from tests.benchmarks.peers.whole_runs import page
    from tests.benchmarks.peers.whole_runs.runs import POSTERIORS, measured

    chosen = [one for one in POSTERIORS if {one[0], "-".join(one)} & set(asked.only)] or POSTERIORS
    found = Units(asked.kept, asked.minutes).completed(
        "posteriors",
        (("-".join(one), one) for one in chosen),
        lambda one: measured(*one, asked.only, one_seed=asked.one_seed),
    )
    versions = {name: version(name) for name in ("nautilus-sampler", "dynesty")}
    figure = asked.out / "benchmarks" / "whole-runs.png"
    figure.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        runs = Path(folder) / "runs.json"
        rows = [row for of_posterior in found for row in of_posterior]
        runs.write_text(json.dumps({"versions": versions, "rows": rows}), encoding="utf-8")
        page.main(str(runs), str(asked.out / "whole-runs.md"), str(figure))
    return 0


if __name__ == "__main__":
    sys.exit(main())
