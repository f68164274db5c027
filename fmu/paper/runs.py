"""Runs on one problem, one after the other, and the line of progress that they share."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from fmu.paper.plan import Length
from fmu.progress import Report

if TYPE_CHECKING:
    import xarray as xr

    from fmu.analysis.maxima.results import Maxima
    from fmu.posterior.problem import UpdatingProblem
    from fmu.samplers.kernel import Sampler


class Runs:
    """Makes runs on one problem.

    Parameters
    ----------
    problem : UpdatingProblem
    maxima : Maxima
        Of the problem; every trace keeps them.
    seed : int
        The same for every run.
    phase : str
    total : int
        Name of the line of progress, and the steps of all runs.
    progress : callable, optional
        Called after every step as ``progress(phase, done, total, info)``.
    """

    def __init__(
        self,
        problem: UpdatingProblem,
        maxima: Maxima,
        seed: int,
        phase: str,
        total: int,
        progress: Report | None,
    ) -> None:
        self.problem, self.maxima, self.seed = problem, maxima, seed
        self.phase, self.total, self.progress = phase, total, progress
        self.done = 0

    def run(self, words: str, settings: Sampler, length: Length, init: Any = "prior") -> xr.DataTree:
        """Make a run, called `words` in the line of progress, and return its trace."""
        from fmu.analysis.certificate import CertificateWarning
        from fmu.sampling import sample

        with warnings.catch_warnings():
            # every run's certificate stands on the page; on the way from a far start its warning means nothing
            warnings.simplefilter("ignore", CertificateWarning)
            trace = sample(
                self.problem,
                settings,
                draws=length.draws,
                warmup=length.warmup,
                chains=length.chains,
                seed=self.seed,
                init=init,
                maxima=self.maxima,
                progress=self._watch(words),
            )
        self.done += length.steps
        return trace

    def finish(self) -> None:
        """Report the end, whether or not every planned run was made."""
        if self.progress is not None:
            self.progress(self.phase, self.total, self.total, {"run": "all"})

    def _watch(self, words: str) -> Report | None:
        """Return the callback of one run, whose warm-up precedes its draws."""
        report = self.progress
        if report is None:
            return None
        before = {"draws": 0}
        groups: dict[str, int] = {}

        def step(phase: str, done: int, total: int, info: Mapping[str, str | int | float]) -> None:
            if phase == "warmup":
                before["draws"] = total
            group = str(info.get("group", "1/1"))
            groups[group] = done + (before["draws"] if phase == "draws" else 0)
            steps = sum(groups.values()) // int(group.rpartition("/")[2])
            report(self.phase, min(self.done + steps, self.total - 1), self.total, {"run": words})

        return step
