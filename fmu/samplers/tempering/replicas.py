"""State and info of parallel tempering: those of its chains, and of all the replicas behind them."""

from __future__ import annotations

from dataclasses import dataclass, field

from fmu.samplers.kernel import Info, State
from fmu.samplers.tempering.density import Points
from fmu.types import FloatArray, IntArray


@dataclass(frozen=True)
class TemperedState(State):
    """The posterior's points as State has them, and all replicas.

    Attributes
    ----------
    replicas : Points
        Leading shape (rungs, chains).
    temperatures : ndarray, shape (rungs,)
    heading : ndarray of int, shape (rungs, chains)
        1 for a replica that was last at the posterior, 2 for one that has been at the prior since then, else 0.
    n_steps : int
        Steps taken.
    """

    replicas: Points = field(kw_only=True)
    temperatures: FloatArray = field(kw_only=True)
    heading: IntArray = field(kw_only=True)
    n_steps: int = field(kw_only=True)


@dataclass(frozen=True)
class TemperedInfo(Info):
    """Info of the chains, the cost of all rungs included, and `of_rungs`: that of all replicas' own steps.

    The leading dimension there is (rungs − 1) · chains, rung by rung, from the first above the prior.
    """

    of_rungs: Info = field(kw_only=True)
