"""Chains of PINTS, on fmu's log-probability and the unit box."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pints

from tests.benchmarks.peers.ensembles import InBox
from tests.benchmarks.peers.outcome import Length, Outcome, Stopwatch
from tests.benchmarks.peers.target import Target

CHAINS = 4


class _Posterior(pints.LogPDF):
    """What PINTS asks of a log-density."""

    def __init__(self, density: InBox, ndim: int) -> None:
        self._density, self._ndim = density, ndim

    def __call__(self, u: object) -> float:
        return float(self._density(np.asarray(u)))

    def n_parameters(self) -> int:
        return self._ndim


def pints_adaptive(target: Target, length: Length) -> Callable[[int], Outcome]:
    """Return what runs PINTS's default, the adaptive Metropolis of Haario and Bardenet, for a seed.

    It adapts all along; the time is divided between warm-up and draws by their steps.
    """

    def once(seed: int) -> Outcome:
        np.random.seed(seed)  # noqa: NPY002  (PINTS draws from NumPy's global state)
        density = InBox(target)
        controller = pints.MCMCController(
            _Posterior(density, target.problem.ndim),
            CHAINS,
            list(target.to_unit(target.starts(seed, CHAINS))),
            method=pints.HaarioBardenetACMC,
        )
        controller.set_max_iterations(length.warmup + length.draws)
        controller.set_log_to_screen(False)
        stopwatch = Stopwatch()
        u = controller.run()
        total = stopwatch.read(density.inside)
        share = length.warmup / (length.warmup + length.draws)
        return Outcome(target.from_unit(u[:, length.warmup :]), total.share(share), total.share(1.0 - share))

    return once
