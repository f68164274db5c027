"""Affine-invariant ensemble sampling with emcee, behind the same interface as the other samplers."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, ClassVar

import numpy as np

from fmu.arguments import OwnRule, check_arguments
from fmu.samplers.kernel import Info, Sampler, State, Target
from fmu.samplers.settings import one_of, positive_number, whole_number
from fmu.types import FloatArray, LogDensity

if TYPE_CHECKING:
    from emcee.moves.move import Move

Moves = str | Mapping[str, float] | Iterable[str | tuple[str, float]]
"""One move, or several moves with their weights."""
MOVES = ("stretch", "de", "snooker", "kde")
_BEST = (("de", 1.0), ("kde", 1.0))
_PER_COORDINATE = 4
"""Smallest number of walkers per coordinate for which half of them give a usable kernel density."""


@check_arguments
@dataclass(frozen=True)
class Ensemble(Sampler):
    """emcee's ensemble sampler, in which each walker's proposal uses the positions of other walkers.

    Walkers are not independent chains: one ensemble is one chain, with steps × walkers draws. Nothing is tuned in
    warm-up, because the proposals adapt to the positions of the walkers.

    Parameters
    ----------
    walkers : int
        Number of walkers; at least 8 and at least twice the number of coordinates.
    moves : str, mapping or sequence
        "stretch", "de" (differential evolution), "snooker" or "kde" (draws from a kernel density estimated with
        the other half of the walkers); or a mixture: ``{"de": 0.8, "snooker": 0.2}``, ``[("de", 0.8), ("snooker",
        0.2)]`` or ``["de", "snooker"]`` (equal weights). One move is drawn per step. The default is "de" and "kde"
        with equal weights. With fewer than four walkers per coordinate, which are too few for a kernel density,
        the default is "de" alone.

    Raises
    ------
    ValueError
        If `moves` is empty or has another form, a move is unknown, a weight is not positive, or there are too few
        walkers.

    Notes
    -----
    The default gave the largest effective sample size (ESS) per evaluation on the posteriors of the paper. The
    list shows the smaller of bulk and tail ESS of the worst parameter, per 1000 evaluations after warm-up, for
    four ensembles of 32 walkers and 3000 steps. The four values are for cantilever-young paired by shape and by
    number, then for cantilever-section paired by shape and by number:

    - stretch: 11, 13, 16, 15;
    - de: 42, 43, 48, 37;
    - de 0.8 and snooker 0.2: 42, 44, 47, 42;
    - kde: 46, 69, 42, 51; on the third posterior some walkers stopped moving;
    - de and kde: 61, 64, 75, 67.

    A run that ends at convergence has 100 warm-up steps, which are four autocorrelation times on these posteriors.
    Its walkers start around the maxima.

    References
    ----------
    Goodman & Weare (2010), CAMCoS 5, 65-80 (stretch); Foreman-Mackey et al. (2013), PASP 125, 306-312 (emcee);
    Nelson et al. (2014), ApJS 210, 11 (de); ter Braak & Vrugt (2008), Statistics and Computing 18 (snooker).
    """

    walkers: int = 32
    moves: Annotated[Moves | None, OwnRule()] = None

    name: ClassVar[str] = "emcee"
    title: ClassVar[str] = "emcee ensemble"
    colour: ClassVar[str] = "#CC79A7"
    cost: ClassVar[tuple[float, float, float]] = (0.6, 0.6, 0.2)
    first: ClassVar[tuple[int, int]] = (100, 200)

    def __post_init__(self) -> None:
        whole_number("walkers", self.walkers, 8)
        if self.moves is not None:
            object.__setattr__(self, "moves", _mixture(self.moves))

    def bind(self, density: LogDensity) -> EnsembleKernel:
        """Return the kernel that samples `density`; raise ValueError if there are too few walkers."""
        if self.walkers < 2 * density.ndim:
            raise ValueError(
                f"walkers: must be at least {2 * density.ndim}, twice the coordinates (got {self.walkers})"
            )
        moves, weights = zip(*self.weighted_moves(density.ndim), strict=True)
        return EnsembleKernel(_Tally(density), moves, np.array(weights) / sum(weights))

    def weighted_moves(self, ndim: int) -> list[tuple[Move, float]]:
        """Return emcee's moves for `ndim` coordinates, with their weights.

        Raises
        ------
        ValueError
            If there are too few walkers for the "kde" move.
        """
        enough = _PER_COORDINATE * ndim
        given = (_BEST if self.walkers >= enough else _BEST[:1]) if self.moves is None else _mixture(self.moves)
        if self.walkers < enough and any(name == "kde" for name, _ in given):
            raise ValueError(
                f"walkers: must be at least {enough}, four per coordinate, for the move kde (got {self.walkers})"
            )
        return [(_move(name), weight) for name, weight in given]


@dataclass(frozen=True)
class EnsembleKernel:
    """Kernel of an ensemble sampler. Each chain is an ensemble: State.position is (chains, walkers, ndim)."""

    target: _Tally
    moves: tuple[Move, ...]
    weights: FloatArray

    def init(self, positions: FloatArray) -> tuple[State, Info]:
        """Evaluate the starting points, at one solve per walker.

        Raise ValueError if the walkers of an ensemble do not span the space.
        """
        from emcee import walkers_independent

        for chain, walkers in enumerate(positions):
            if not walkers_independent(walkers):
                raise ValueError(f"init: the walkers must span the space (those of ensemble {chain} do not)")
        return self.target.start(positions)

    def step(self, rng: np.random.Generator, state: State) -> tuple[State, Info]:
        """Move every walker once; return the new state and the step's diagnostics.

        emcee draws its numbers from the stream of `rng`, so a checkpoint needs only State and `rng`. An
        ensemble's total number of solves is exact. emcee does not report which walkers caused them, so they are
        assigned to the first walkers.
        """
        n_solves, n_nonfinite = (np.zeros(state.log_prob.shape, dtype=np.int64) for _ in range(2))
        position, log_prob = state.position.copy(), state.log_prob.copy()
        for chain in range(len(position)):
            self.target.reset()
            position[chain], log_prob[chain] = self._advance(rng, position[chain], log_prob[chain])
            n_solves[chain, : self.target.n_solves] = 1
            n_nonfinite[chain, : self.target.n_nonfinite] = 1
        accepted, extra = np.any(position != state.position, axis=-1), {"n_nonfinite": n_nonfinite}
        return State(position, log_prob), Info(accepted, log_prob, n_solves, np.zeros_like(n_solves), extra)

    def _advance(
        self, rng: np.random.Generator, position: FloatArray, log_prob: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Take one step as emcee's EnsembleSampler does; return the walkers and their log-densities.

        emcee overwrites `position` and `log_prob`.
        """
        from emcee import State as EnsembleState
        from emcee.model import Model

        # made anew in each step: a RandomState may keep a normal draw for later, which a checkpoint would miss
        generator = np.random.RandomState(rng.bit_generator)
        move = self.moves[generator.choice(len(self.moves), p=self.weights)]
        model = Model(self.target, lambda walkers: (self.target(walkers), None), map, generator)
        end = move.propose(model, EnsembleState(position, log_prob))[0]
        return end.coords, end.log_prob


class _Tally(Target):
    """Log-density for emcee that counts all evaluations, and those whose result is not finite."""

    def __init__(self, density: LogDensity) -> None:
        super().__init__(density)
        self.reset()

    def reset(self) -> None:
        self.n_solves = self.n_nonfinite = 0

    def __call__(self, position: FloatArray) -> FloatArray:
        found = self.evaluate(position)
        self.n_solves += int(found.n_solves.sum())
        self.n_nonfinite += int(found.n_nonfinite.sum())
        return found.log_prob


def _mixture(moves: Moves) -> tuple[tuple[str, float], ...]:
    """Return the moves as (name, weight) pairs.

    Raise ValueError if a move is unknown, a weight is not positive, or `moves` is empty or has another form.
    """
    given = [moves] if isinstance(moves, str) else moves.items() if isinstance(moves, Mapping) else moves
    listed = given if isinstance(given, Iterable) else ()
    pairs = [(move, 1.0) if isinstance(move, str) else move for move in listed]
    if not pairs or any(np.size(pair) != 2 for pair in pairs):
        raise ValueError(f"moves: must name one move or weigh several (got {moves!r})")
    return tuple((one_of("moves", name, MOVES), positive_number("moves", weight)) for name, weight in pairs)


def _move(name: str) -> Move:
    from emcee import moves

    from fmu.samplers.snooker import SnookerMove

    return {
        "stretch": moves.StretchMove,
        "de": moves.DEMove,
        "snooker": SnookerMove,
        "kde": moves.KDEMove,
    }[name]()
