"""Validate every sampler, long: python -m tests.validation OUT_DIRECTORY. Exit code 1 where a gate fails."""

from __future__ import annotations

import os
import sys
import tempfile
import time
from pathlib import Path

from threadpoolctl import threadpool_limits

from tests.validation.calibration import calibrate
from tests.validation.contenders import CONTENDERS
from tests.validation.effective_size import TARGETS, error_ratios
from tests.validation.page import Study, write

REPLICATES = 200
"""Truths a sampler is calibrated with."""
RUNS, ENSEMBLE_RUNS = 256, 100
"""Runs whose errors are compared with their ESS. Ensembles cost more, and run on the first target alone."""


def main(directory: str) -> int:
    """Run both studies, write ``validation.md`` and its figure, and return the exit code."""
    calibrations, ratios = {}, {}
    with threadpool_limits(1), tempfile.TemporaryDirectory() as cache:
        os.environ["FMU_CACHE_DIR"] = cache  # a reduced model of an earlier version must not answer for this one
        for i, contender in enumerate(CONTENDERS):
            calibrations[contender.title] = calibrate(contender, REPLICATES, seed=i)
            print(f"{contender.title}: calibrated after {time.process_time():.0f} s", flush=True)
            single = contender.sampler.walkers == 1
            ratios[contender.title] = [
                ratio
                for target in (TARGETS if single else TARGETS[:1])
                for ratio in error_ratios(contender, target(), RUNS if single else ENSEMBLE_RUNS, seed=i)
            ]
            print(f"{contender.title}: ESS checked after {time.process_time():.0f} s", flush=True)
    study = Study(calibrations, ratios)
    write(study, Path(directory), time.process_time())
    for failure in study.failures:
        print(failure)
    return 1 if study.failures else 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
