"""Validate every sampler, long: python -m tests.validation OUT_DIRECTORY [--workers N] [--only WORD].

Exit code 1 where a gate fails. The numbers do not depend on the workers. With a word, only the samplers whose
title has it are tried, and their numbers are printed instead of written.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path

from threadpoolctl import threadpool_limits

from fmu.engines import engine
from tests.validation.calibration import calibrate
from tests.validation.contenders import CONTENDERS
from tests.validation.effective_size import TARGETS, error_ratios
from tests.validation.page import Study, calibration_table, ratio_table, write

REPLICATES = 200
"""Truths a sampler is calibrated with."""
RUNS, ENSEMBLE_RUNS = 256, 100
"""Runs whose errors are compared with their ESS. Ensembles cost more, and run on the first target alone."""


def main(directory: Path, workers: int, only: str = "") -> int:
    """Run both studies, write ``validation.md`` and its figure, and return the exit code."""
    calibrations, ratios, began = {}, {}, time.perf_counter()
    chosen = [(i, contender) for i, contender in enumerate(CONTENDERS) if only in contender.title]
    with threadpool_limits(1), tempfile.TemporaryDirectory() as cache:
        os.environ["FMU_CACHE_DIR"] = cache  # a reduced model of an earlier version must not answer for this one
        with engine(workers) as at_work:
            for i, contender in chosen:
                calibrations[contender.title] = calibrate(contender, REPLICATES, i, at_work)
                print(f"{contender.title}: calibrated after {time.perf_counter() - began:.0f} s", flush=True)
        for i, contender in chosen:
            single = contender.sampler.walkers == 1
            ratios[contender.title] = [
                ratio
                for target in (TARGETS if single else TARGETS[:1])
                for ratio in error_ratios(contender, target(), RUNS if single else ENSEMBLE_RUNS, seed=i)
            ]
            print(f"{contender.title}: ESS checked after {time.perf_counter() - began:.0f} s", flush=True)
    study = Study(calibrations, ratios)
    if only:
        print(calibration_table(study), ratio_table(study), sep="\n")
    else:
        write(study, directory, sum(os.times()[:4]))  # of this process and of the workers, which have ended
    for failure in study.failures:
        print(failure)
    return 1 if study.failures else 0


if __name__ == "__main__":
    parser = argparse.ArgumentParser(prog="python -m tests.validation")
    parser.add_argument("directory", type=Path)
    parser.add_argument("--workers", type=int, default=1, help="processes that share the replicates")
    parser.add_argument(
        "--only", default="", help="part of the titles of the samplers to be tried; nothing is written"
    )
    sys.exit(main(**vars(parser.parse_args())))
