"""One BLAS thread around our own calls: many small eigenproblems are slower with more."""

from __future__ import annotations

from contextlib import AbstractContextManager
from functools import cache
from typing import Any

from threadpoolctl import ThreadpoolController


def single_thread() -> AbstractContextManager[None]:
    """Return a context in which BLAS uses one thread; the process has its own setting back afterwards.

    Where there is one thread already nothing is touched: threadpoolctl's own context takes as long as a reduced
    eigenproblem.
    """
    return _OneThread()


class _OneThread:
    def __enter__(self) -> None:
        self._limited = [(blas, n) for blas in _libraries() if (n := blas.num_threads) not in (None, 1)]
        for blas, _ in self._limited:
            blas.set_num_threads(1)

    def __exit__(self, *exception: object) -> None:
        for blas, n in self._limited:
            blas.set_num_threads(n)


@cache
def _libraries() -> tuple[Any, ...]:
    # NumPy and SciPy each bring a BLAS of their own: both must be loaded before the controller looks for them
    import numpy.linalg  # noqa: F401
    import scipy.linalg  # noqa: F401

    return tuple(ThreadpoolController().select(user_api="blas").lib_controllers)
