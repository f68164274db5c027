"""OpenSees has one model per process: threads, such as those of a Dask worker, use it one after the other."""

import time
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

from fmu.fem.programs.opensees import _alone


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
