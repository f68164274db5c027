"""The effect of BLAS threads on batches of small eigenproblems, of LAPACK alone and of the log-probability."""

import time

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from tests.benchmarks.ratio import spd


def with_threads(count, run, repeats=1):
    """Return `run` repeated, with `count` BLAS threads."""

    def limited():
        with threadpool_limits(count, user_api="blas"):
            for _ in range(repeats):
                run()

    return limited


@pytest.mark.parametrize("size", [20, 64, 128])
def test_plain_lapack(against, size):
    matrices = spd(64, size)

    def run():
        np.linalg.eigh(matrices)

    what = f"numpy.linalg.eigh of 64 matrices {size}×{size}"
    against(what, with_threads(2, run), with_threads(1, run), section="threads", clock=time.perf_counter)


@pytest.mark.parametrize(("n", "repeats"), [(1, 50), (64, 3)])
def test_log_prob(load, against, n, repeats):
    problem = load("cantilever-young")
    theta = problem.sample_prior(np.random.default_rng(1), n)

    def run():
        problem.log_prob(theta)

    what = f"log_prob, cantilever-young by shape, batch of {n}"
    against(
        what,
        with_threads(2, run, repeats),
        with_threads(1, run, repeats),
        section="threads",
        clock=time.perf_counter,
    )
