"""Limit BLAS to one thread within a ``with`` block."""

from __future__ import annotations

from functools import cache
from typing import Any

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS")
"""Environment variables that are 1 in workers and in the programs that workers start, unless the user set them."""


class _OneThread:
    """Context in which BLAS uses one thread, because many small eigenproblems are slower with more threads.

    The previous number of threads is restored afterwards. If BLAS has only one thread already, nothing is changed,
    because threadpoolctl's own context takes as long as a reduced eigenproblem.
    """

    def __enter__(self) -> None:
        self._limited = [(blas, n) for blas in _libraries() if (n := blas.num_threads) not in (None, 1)]
        for blas, _ in self._limited:
            blas.set_num_threads(1)

    def __exit__(self, *exception: object) -> None:
        for blas, n in self._limited:
            blas.set_num_threads(n)


single_thread = _OneThread


@cache
def _libraries() -> tuple[Any, ...]:
    # NumPy and SciPy each bring their own BLAS: both must be loaded before the controller looks for them
    import numpy.linalg  # noqa: F401
    import scipy.linalg  # noqa: F401
    from threadpoolctl import ThreadpoolController

    return tuple(ThreadpoolController().select(user_api="blas").lib_controllers)
