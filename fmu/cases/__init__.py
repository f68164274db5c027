"""Ready problems."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from fmu.posterior.problem import UpdatingProblem

_CASES = {
    "cantilever-young": "the paper's section 5.1: Young's moduli of five parts of a cantilever",
    "cantilever-section": "the paper's section 5.2: second moments of area and areas of its two halves",
}


def names() -> tuple[str, ...]:
    """List the built-in cases.

    Returns
    -------
    tuple of str
        What `load` and `describe` take.
    """
    return tuple(_CASES)


def describe(name: str) -> str:
    """Say in one line what a case is.

    Parameters
    ----------
    name : str
        One of `names`.

    Returns
    -------
    str

    Raises
    ------
    ValueError
        If there is no such case.
    """
    if name not in _CASES:
        raise ValueError(f"case: must be one of {', '.join(_CASES)} (got {name!r})")
    return _CASES[name]


def load(name: str, pairing: str = "shape", beta: ArrayLike = 1.0) -> UpdatingProblem:
    """Return a built-in problem.

    Parameters
    ----------
    name : str
        One of `names`.
    pairing : {"shape", "index"}
        By MAC, or by number in the sorted spectrum as in the paper.
    beta : float or array_like, shape (n_modes,)
        Weight of a squared frequency error, 1/Hz²; 1 for every mode in the paper.

    Returns
    -------
    UpdatingProblem

    Raises
    ------
    ValueError
        If there is no such case or pairing, or `beta` is not positive.
    """
    describe(name)
    from fmu.cases import cantilever

    return {"cantilever-young": cantilever.young, "cantilever-section": cantilever.section}[name](pairing, beta)
