"""Validate every sampler by simulation-based calibration and by the accuracy of its effective sample size.

    python -m tests.validation OUT [--kept DIRECTORY] [--minutes M] [--workers N] [--only WORD]

The exit code is 1 if a gate fails. The results do not depend on the number of workers. With ``--only``, only the
samplers whose title contains WORD are validated, and their tables are printed instead of written.
"""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from fmu.engines import engine
from tests.validation.calibration import Calibration, calibrate
from tests.validation.contenders import CONTENDERS
from tests.validation.effective_size import TARGETS, Ratio, error_ratios
from tests.validation.kept import Units, study_parser
from tests.validation.page import Study, calibration_table, ratio_table, write

REPLICATES = 200
"""Number of true parameter vectors in the calibration of a sampler."""
RUNS, ENSEMBLE_RUNS = 256, 100
"""Runs whose errors are compared with their ESS. Ensembles cost more and run on the first target only."""


@dataclass(frozen=True)
class Tried:
    """Results of one sampler."""

    title: str
    calibration: Calibration
    ratios: Sequence[Ratio]
    processor_s: float

    @classmethod
    def of_line(cls, title: str, calibration: Any, ratios: Any, processor_s: float) -> Tried:
        """Return the results from the fields that were stored as JSON."""
        arrays = {name: np.array(values) for name, values in calibration.items()}
        return cls(title, Calibration(**arrays), [Ratio(**fields) for fields in ratios], processor_s)


def tried(number: int, workers: int) -> Tried:
    """Validate a sampler, given its index in `CONTENDERS`, which also determines its seeds."""
    contender, began = CONTENDERS[number], _processor_s()
    with engine(workers) as at_work:
        calibration = calibrate(contender, REPLICATES, number, at_work)
    single = contender.sampler.walkers == 1
    ratios = [
        ratio
        for target in (TARGETS if single else TARGETS[:1])
        for ratio in error_ratios(contender, target(), RUNS if single else ENSEMBLE_RUNS, seed=number)
    ]
    found = Tried(contender.title, calibration, ratios, _processor_s() - began)
    print(f"{found.title}: validated in {found.processor_s:.0f} s of processor time", flush=True)
    return found


def _processor_s() -> float:
    """Return the processor time of this process and of its finished workers."""
    return sum(os.times()[:4])


def main() -> int:
    """Run both studies, write ``validation.md`` and its figure, and return the exit code."""
    parser = study_parser(__doc__)
    parser.add_argument("--workers", type=int, default=1, help="number of processes that share the replicates")
    parser.add_argument("--only", default="", help="validate only samplers whose title contains this word")
    asked = parser.parse_args()
    units = Units(asked.kept, asked.minutes)
    chosen = [(contender.title, i) for i, contender in enumerate(CONTENDERS) if asked.only in contender.title]
    with threadpool_limits(1), tempfile.TemporaryDirectory() as cache:
        os.environ["FMU_CACHE_DIR"] = cache  # do not use a reduced model cached by an earlier version
        runs = units.completed(
            "samplers", chosen, lambda i: tried(i, asked.workers), lambda kept: Tried.of_line(**kept)
        )
    study = Study({one.title: one.calibration for one in runs}, {one.title: one.ratios for one in runs})
    if asked.only:
        print(calibration_table(study), ratio_table(study), sep="\n")
    else:
        write(study, asked.out, units.processor_s)
    for failure in study.failures:
        print(failure)
    return 1 if study.failures else 0


if __name__ == "__main__":
    sys.exit(main())
