"""Samplers of fmu and of other libraries on a posterior, with all costs counted.

    python -m tests.benchmarks.peers OUT --posterior KEY [--kept DIRECTORY] [--minutes M]

Writes peers/KEY.md and peers/KEY.png. All samplers run on one processor core, whatever threads a library starts.
They take turns, one seed at a time, so that other work on the machine slows all of them.
"""

from __future__ import annotations

import os
import sys
from collections import defaultdict
from dataclasses import asdict
from importlib.metadata import version

from tests.validation.kept import CORE, Units, each, study_parser

PEERS = (
    "emcee", "numpyro", "jax", "nutpie", "pints", "nautilus-sampler", "dynesty", "ultranest", "nessai", "pocomc",
)  # fmt: skip


def main() -> int:
    """Do the missing runs, write the page, and return the exit code."""
    parser = study_parser(__doc__)
    parser.add_argument("--posterior", required=True, help="such as garteur-shape")
    asked = parser.parse_args()
    if hasattr(os, "sched_setaffinity"):
        cores = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, {cores[(int(os.environ.get(CORE, 0)) - 1) % len(cores)]})
    os.environ["OMP_NUM_THREADS"] = "1"
    # XLA, BLAS and PyTorch count the cores when they are loaded
    from tests.benchmarks.peers.contenders import COSTLY, POSTERIORS, SEEDS, contenders
    from tests.benchmarks.peers.ensembles import wrapping
    from tests.benchmarks.peers.figure import draw
    from tests.benchmarks.peers.page import page
    from tests.benchmarks.peers.posteriors import Target
    from tests.benchmarks.peers.rows import Row
    from tests.benchmarks.peers.run import Run

    target = Target.load(*dict(zip(map("-".join, POSTERIORS), POSTERIORS, strict=True))[asked.posterior])
    everybody = list(contenders(target))
    keyed = [([one.label, seed], (one, seed)) for seed in SEEDS for one in everybody if seed in one.seeds]
    units = Units(asked.kept, asked.minutes)
    share = COSTLY.get(target.key, 1.0)
    (overhead,) = units.completed("timings", each(["emcee"]), lambda _: wrapping(target, share))
    found = units.completed("runs", keyed, lambda one: asdict(one[0].run(one[1])))
    runs: dict[tuple[str, str], list[Run]] = defaultdict(list)
    for (_, (one, _)), result in zip(keyed, found, strict=False):
        runs[one.label, one.whose].append(Run.read(result))
    rows = [Row(whose, label, tuple(of_one)) for (label, whose), of_one in runs.items()]
    folder = asked.out / "peers"
    folder.mkdir(parents=True, exist_ok=True)
    draw(rows, str(folder / f"{target.key}.png"))
    text = page(target, rows, overhead, units.counts, {name: version(name) for name in PEERS})
    (folder / f"{target.key}.md").write_text(
        f"{text}\n![Effective draws per evaluation and per second]({target.key}.png)\n", encoding="utf-8"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
