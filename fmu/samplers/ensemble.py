"""emcee's affine-invariant ensembles behind the same face as the other samplers."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from fmu.samplers.evaluation import evaluate
from fmu.samplers.kernel import Info, State
from fmu.samplers.loop.settings import one_of, positive_number, whole_number
from fmu.types import FloatArray, LogDensity

MOVES = ("stretch", "de", "snooker")


@dataclass(frozen=True)
class Ensemble:
    """An ensemble of walkers that propose from each other's positions, by the emcee library.

    Walkers are not independent chains: one ensemble is one chain, and its draws are steps × walkers.

    Parameters
    ----------
    walkers : int
        At least twice the number of coordinates, and 8.
    moves : str, mapping or sequence
        "stretch", "de" (differential evolution) or "snooker"; or a mixture: ``{"de": 0.8, "snooker": 0.2}``,
        ``[("de", 0.8), ("snooker", 0.2)]`` or ``["de", "snooker"]`` (equal weights). One move is drawn a step.

    Raises
    ------
    ValueError
        If a move is not known, a weight not positive, or the walkers are too few.

    References
    ----------
    Goodman & Weare (2010), CAMCoS 5, 65-80 (stretch); Foreman-Mackey et al. (2013), PASP 125, 306-312 (emcee);
    Nelson et al. (2014), ApJS 210, 11 (de); ter Braak & Vrugt (2008), Statistics and Computing 18 (snooker).
    """

    walkers: int = 32
    moves: Any = "stretch"

    name: ClassVar[str] = "emcee"

    def __post_init__(self) -> None:
        whole_number("walkers", self.walkers, 8)
        object.__setattr__(self, "moves", _mixture(self.moves))

    def tuner(self, density: LogDensity, chains: int, steps: int) -> None:
        """Return None: the moves of an ensemble adapt by themselves, through where the walkers are."""
        return

    def bind(self, density: LogDensity) -> EnsembleKernel:
        """Return the kernel that samples `density`; ValueError if it has too few walkers for it."""
        if self.walkers < 2 * density.ndim:
            raise ValueError(
                f"walkers: must be at least {2 * density.ndim}, twice the coordinates (got {self.walkers})"
            )
        import emcee

        tally = _Tally(density)
        moves = [(_move(name), weight) for name, weight in self.moves]
        return EnsembleKernel(
            density, tally, emcee.EnsembleSampler(self.walkers, density.ndim, tally, moves=moves, vectorize=True)
        )


@dataclass(frozen=True)
class EnsembleKernel:
    """Ensembles bound to a density. State.position is (chains, walkers, ndim), one ensemble a chain."""

    density: LogDensity
    tally: _Tally
    sampler: Any

    def init(self, positions: FloatArray) -> tuple[State, Info]:
        """Evaluate the start, one solve a walker; ValueError unless the walkers span the space."""
        from emcee import walkers_independent

        for chain, walkers in enumerate(positions):
            if not walkers_independent(walkers):
                raise ValueError(f"init: the walkers must span the space (those of ensemble {chain} do not)")
        shape = positions.shape[:2]
        first = evaluate(self.density, positions.reshape(-1, self.density.ndim))
        log_prob = first.log_prob.reshape(shape)
        nothing = np.zeros(shape, dtype=np.int64)
        info = Info(nothing.astype(bool), log_prob, first.n_solves.reshape(shape), nothing)
        return State(positions, log_prob), info

    def step(self, rng: np.random.Generator, state: State) -> tuple[State, Info]:
        """Move every walker once.

        emcee's generator is seeded anew from `rng` at every step, so that State and `rng` are all that a
        checkpoint needs. The solves of an ensemble's step are exact in sum; emcee does not say which walker they
        belong to, and they are booked on the first ones.
        """
        n_solves, n_nonfinite = (np.zeros(state.log_prob.shape, dtype=np.int64) for _ in range(2))
        position, log_prob = np.empty_like(state.position), np.empty_like(state.log_prob)
        for chain in range(len(position)):
            self.tally.reset()
            end = self._advance(rng, state.position[chain], state.log_prob[chain])
            position[chain], log_prob[chain] = end.coords, end.log_prob
            n_solves[chain, : self.tally.n_solves] = 1
            n_nonfinite[chain, : self.tally.n_nonfinite] = 1
        accepted = np.any(position != state.position, axis=-1)
        extra = {"n_nonfinite": n_nonfinite}
        info = Info(accepted, log_prob, n_solves, np.zeros_like(n_solves), extra)
        return State(position, log_prob), info

    def _advance(self, rng: np.random.Generator, position: FloatArray, log_prob: FloatArray) -> Any:
        """Move one ensemble by one step of emcee and return emcee's state."""
        import emcee

        seed = rng.integers(2**32, size=8, dtype=np.uint32)
        self.sampler.random_state = np.random.RandomState(seed).get_state()
        start = emcee.State(position, log_prob=log_prob, copy=True)
        return next(self.sampler.sample(start, iterations=1, store=False, skip_initial_state_check=True))


class _Tally:
    """The log-density as emcee calls it, counting what it costs. Each walker is proposed once a step."""

    def __init__(self, density: LogDensity) -> None:
        self.density = density
        self.reset()

    def reset(self) -> None:
        """Forget what was counted."""
        self.n_solves = 0
        self.n_nonfinite = 0

    def __call__(self, position: FloatArray) -> FloatArray:
        found = evaluate(self.density, position)
        self.n_solves += int(found.n_solves.sum())
        self.n_nonfinite += int(found.n_nonfinite.sum())
        return found.log_prob


def _mixture(moves: Any) -> tuple[tuple[str, float], ...]:
    """Return the moves as (name, weight) pairs."""
    if isinstance(moves, str):
        pairs: list[tuple[Any, Any]] = [(moves, 1.0)]
    elif isinstance(moves, Mapping):
        pairs = list(moves.items())
    elif isinstance(moves, Iterable):
        pairs = [(move, 1.0) if isinstance(move, str) else tuple(move) for move in moves]
    else:
        pairs = []
    if not pairs or any(len(pair) != 2 for pair in pairs):
        raise ValueError(f"moves: must name one move or weigh several (got {moves!r})")
    return tuple((one_of("moves", name, MOVES), positive_number("moves", weight)) for name, weight in pairs)


def _move(name: str) -> Any:
    from emcee import moves

    from fmu.samplers.snooker import SnookerMove

    return {"stretch": moves.StretchMove, "de": moves.DEMove, "snooker": SnookerMove}[name]()
