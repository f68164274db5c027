"""One BLAS thread around our own calls: many small eigenproblems are slower with more."""

from __future__ import annotations

from contextlib import AbstractContextManager
from functools import cache
from typing import Any

from threadpoolctl import ThreadpoolController


def single_thread() -> AbstractContextManager[Any]:
    """Return a context in which BLAS uses one thread; the process has its own setting back afterwards."""
    return _controller().limit(limits=1, user_api="blas")


@cache
def _controller() -> ThreadpoolController:
    # NumPy and SciPy each bring a BLAS of their own: both must be loaded before the controller looks for them
    import numpy.linalg  # noqa: F401
    import scipy.linalg  # noqa: F401

    return ThreadpoolController()
