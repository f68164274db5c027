"""The size from which a matrix counts as large, and checks whether factors fit in free memory."""

from __future__ import annotations

from functools import cache

from fmu.engines.memory import free_memory
from fmu.numbers import significant, whole
from fmu.progress.phases import tell_fact

LARGE = 20_000
"""Number of degrees of freedom from which factorising a block is so expensive that factors are stored and
reused."""


def require_memory(needed: int, n_dof: int, advice: str = "coarsen or condense the model") -> None:
    """Raise MemoryError if the factors for `n_dof` rows do not fit in free memory.

    `needed` is the size of the factors in bytes; `advice` ends the error message. Nothing is checked if the free
    memory is unknown. For `LARGE` rows or more, the size is logged, but each size only once.
    """
    free = free_memory()
    if free is not None and needed > free:
        beside = f"and {significant(free / 2**30, 3)} GiB of memory are free"
        raise MemoryError(f"{needed_in_words(needed, n_dof)}, {beside}; {advice}")
    if n_dof >= LARGE:
        _tell_once(n_dof, significant(needed / 2**30, 2))


def is_short(needed: int) -> bool:
    """Return True if fewer than `needed` bytes of memory are free. Return False if the free memory is unknown."""
    free = free_memory()
    return free is not None and needed > free


def needed_in_words(needed: int, n_dof: int) -> str:
    """Return a clause that states how much memory the factors of a matrix with `n_dof` rows need."""
    return f"the factors of {whole(n_dof)} degrees of freedom need {significant(needed / 2**30, 3)} GiB"


@cache
def _tell_once(n_dof: int, gib: str) -> None:
    """Log the memory that factors need, but only at the first call with these arguments."""
    tell_fact(f"The factors of {whole(n_dof)} degrees of freedom will take {gib} GiB of memory.")
