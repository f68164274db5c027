"""OpenSees has one model per process: threads, such as those of a Dask worker, use it one after the other."""

import time
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import numpy as np
from numpy.testing import assert_array_equal

from fmu.fem.programs.opensees import _WHAT, _alone, _matrix


def test_threads_build_one_after_the_other():
    made = []
    ops = SimpleNamespace(wipe=made.clear, logFile=lambda *arguments: None)

    def build(i):
        with _alone(ops):
            for _ in range(5):
                made.append(i)
                time.sleep(1e-3)
            return list(made)

    with ThreadPoolExecutor(4) as threads:
        assert list(threads.map(build, range(8))) == [[i] * 5 for i in range(8)]


def test_a_matrix_is_the_one_that_opensees_prints():
    """A stand-in assembles a M + b C + c K for the factors that it is given."""
    M, K, given = np.diag([2.0, 0.5]), np.array([[5.0, -1.0], [-1.0, 3.0]]), []
    ops = SimpleNamespace(
        integrator=lambda name, *factors: given.append(factors),
        analyze=lambda *arguments: 0,
        printA=lambda *arguments: (given[-1][0] * M + given[-1][2] * K).ravel().tolist(),
    )
    for what, expected in (("mass", M), ("stiffness", K)):
        assert_array_equal(_matrix(ops, what, 2, _WHAT[what]).toarray(), expected)
