"""A run with a checkpoint, to be killed."""

from __future__ import annotations

import os
import resource
import time

import numpy as np

import fmu
from fmu.posterior.failures import Failure
from fmu.runs import Checkpoint
from tests.samplers.targets import CorrelatedGaussian

WARMUP, DRAWS, CHAINS = 40, 60, 2
STEPS = 10
"""After how many of them a run is kept."""


class Watched(CorrelatedGaussian):
    """A Gaussian that fails here and there, and can be made slow."""

    delay = 0.0

    def __init__(self):
        super().__init__()
        self.failed = []

    def log_prob(self, theta):
        time.sleep(self.delay)
        value = super().log_prob(theta)
        bad = theta[:, 0] > self.mean[0] + 0.8
        self.failed += [Failure(point.copy(), "too far\0 \udcff") for point in theta[bad]]
        return np.where(bad, -np.inf, value)

    def take_failures(self):
        failed, self.failed = self.failed, []
        return failed


def sampled(directory, draws=DRAWS, density=None, **more):
    """The run, in any process."""
    density = density or Watched()
    start = density.mean + 0.1 * np.arange(CHAINS)[:, None]
    where = None if directory is None else Checkpoint(directory, draws=STEPS)
    settings = {"warmup": WARMUP, "chains": CHAINS, "seed": 2, "init": start} | more
    return fmu.sample(density, "mh", draws=draws, checkpoint=where, **settings)


def main(output, errors, directory, draws=DRAWS, phase="", step=0, full=False):
    """Run, and say on a connection what is going on.

    Every step is a line, such as "draws 25". From the step that is given on, a step takes for ever; or, if `full`,
    the disk is full.
    """
    for connection, descriptor in ((output, 1), (errors, 2)):
        os.dup2(connection.fileno(), descriptor)
        connection.close()
    density = Watched()
    density.delay = 0.003

    def progress(now, done, total, info):
        print(now, done, flush=True)
        if (now, done) == (phase, step):
            density.delay = 0.0 if full else 60.0
            if full:
                resource.setrlimit(resource.RLIMIT_FSIZE, (100, resource.RLIM_INFINITY))

    try:
        sampled(directory, draws, density, progress=progress)
        print("complete", flush=True)
    except fmu.sampling.StoppedRun as stop:
        print(
            f"stopped {stop.where}, {stop.trace and stop.trace['posterior'].sizes['draw']} in the trace",
            flush=True,
        )
    except KeyboardInterrupt:
        print("interrupted", flush=True)
    except OSError as error:
        print(f"OSError {error}", flush=True)
