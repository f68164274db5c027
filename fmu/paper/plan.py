"""Plan the runs: lengths and settings for the paper's protocol and for the long runs.

The paper's protocol is a single chain with the paper's number of samples; the long runs are meant to converge.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from fmu.analysis.certificate import CertificateWarning
from fmu.paper.published import EXPERIMENTS, N_SAMPLES
from fmu.progress import Report
from fmu.samplers import Ensemble, HamiltonianMonteCarlo, MetropolisHastings, RandomWalk, Slice, make_sampler
from fmu.samplers.kernel import Sampler
from fmu.types import FloatArray

if TYPE_CHECKING:
    import xarray as xr

    from fmu.analysis.maxima.results import Maxima
    from fmu.posterior.problem import UpdatingProblem


PAPER_SAMPLERS = ("mh", "slice", "hmc")
SAMPLERS = (*PAPER_SAMPLERS, "emcee", "mixture")
PAIRINGS = ("index", "shape")


@dataclass(frozen=True)
class Length:
    """A run's length: steps after warm-up, warm-up steps, and number of chains (ensembles for emcee)."""

    draws: int
    warmup: int
    chains: int

    @property
    def steps(self) -> int:
        """Number of steps per chain, warm-up included."""
        return self.warmup + self.draws


@dataclass(frozen=True)
class Plan:
    """The runs of the replication and their lengths.

    Attributes
    ----------
    experiments : tuple of (case, pairing)
        The experiments, in page order.
    paper : Length
        Length of the paper's protocol: the paper's number of samples from one chain, which starts at the starting
        vector and has no warm-up.
    pace : mapping of str to Length
        Lengths, keyed by sampler, of runs with the paper's settings that start from posterior draws. These runs
        show how many solves one effective sample costs.
    long : mapping of str to Length
        Lengths of the long runs, keyed by sampler (`long_start`).
    one_start : Length
        Length of an HMC run without jumps, in which all chains start at the starting vector. This run shows the
        R-hat of chains with a common starting point.
    weighted : tuple of (case, pairing)
        The experiments that are repeated by HMC with a separate β for every mode.
    wrong : Length
        Length of the mixture sampler's runs with a model that may be wrong.
    starts : int
        Number of starting points in the search for maxima.
    box_points : int
        Number of points within the parameter bounds at which the spectrum is examined; a power of two.
    seed : int
    """

    experiments: tuple[tuple[str, str], ...] = tuple(
        (case, pairing) for case in EXPERIMENTS for pairing in PAIRINGS
    )
    paper: Length = Length(N_SAMPLES, 0, 1)
    pace: Mapping[str, Length] = field(
        default_factory=lambda: {
            "mh": Length(10 * N_SAMPLES, 0, 4),
            "slice": Length(N_SAMPLES, 0, 4),
            "hmc": Length(N_SAMPLES, 0, 4),
        }
    )
    long: Mapping[str, Length] = field(
        default_factory=lambda: {
            "mh": Length(20_000, 2_000, 4),
            "slice": Length(20_000, 1_000, 4),
            "hmc": Length(2_000, 1_000, 4),
            "emcee": Length(4_000, 500, 4),
            "mixture": Length(2_000, 1_000, 4),
        }
    )
    one_start: Length = Length(2_000, 1_000, 4)
    weighted: tuple[tuple[str, str], ...] = (
        ("cantilever-young", "index"),
        ("cantilever-young", "shape"),
        ("cantilever-section", "shape"),
    )
    wrong: Length = Length(8_000, 1_000, 4)
    starts: int = 256
    box_points: int = 2**14
    seed: int = 1

    @property
    def steps(self) -> int:
        """Number of steps per chain in all runs of `fmu.paper.experiment.compute` together."""
        runs = (*(self.paper for _ in PAPER_SAMPLERS), *self.pace.values(), *self.long.values(), self.one_start)
        return sum(length.steps for length in runs)


def paper_settings(name: str) -> Sampler:
    """Return one of the paper's samplers with manually chosen settings, in scaled coordinates.

    The paper states neither step sizes nor widths. Here they are chosen so that the samplers move. HMC uses the
    numerical gradient in eq. (15) of the paper and trajectories of fixed length.
    """
    settings: dict[str, Sampler] = {
        "mh": MetropolisHastings(RandomWalk(0.01)),
        "slice": Slice(scheme="hyperrectangle", width=0.5),
        "hmc": HamiltonianMonteCarlo(gradient="central-difference", step_size=0.001, n_steps=10, jitter=0.0),
    }
    return settings[name]


def long_settings(name: str) -> Sampler:
    """Return the sampler for a long run. Its settings are fmu's defaults, except for emcee.

    emcee uses differential-evolution and snooker moves, which here mix about four times as fast as the stretch
    move, the default of the package emcee.
    """
    return Ensemble(moves={"de": 0.8, "snooker": 0.2}) if name == "emcee" else make_sampler(name)


def long_start(name: str, n_maxima: int) -> str:
    """Return where a long run starts: ``"maxima"``, or ``"prior"`` for the mixture sampler.

    The paper's samplers also start at draws from the prior if the posterior has one maximum. If it has several,
    their chains, which make no jumps, would stay near a negligible maximum in which they start. So would emcee's
    walkers.
    """
    return "prior" if name == "mixture" or (name in PAPER_SAMPLERS and n_maxima == 1) else "maxima"


class Runs:
    """Successive runs on one problem that share a progress line.

    Parameters
    ----------
    problem : UpdatingProblem
    maxima : Maxima
        The posterior maxima, stored in every trace.
    seed : int
        Seed for every run.
    phase : str
        Name of the progress line.
    total : int
        Number of steps per chain, including warm-up, summed over all runs.
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

    def run(
        self,
        words: str,
        settings: Sampler,
        length: Length,
        init: str | FloatArray = "prior",
        *,
        jumps: bool | None = None,
    ) -> xr.DataTree:
        """Perform a run, shown as `words` in the progress line, and return its trace.

        `jumps` has the same meaning as in `fmu.sample`. Warnings about the reduced model's certificate are
        ignored.
        """
        from fmu.sampling import sample

        with warnings.catch_warnings():
            # the page shows every certificate; a warning about draws far from the maximum is irrelevant
            warnings.simplefilter("ignore", CertificateWarning)
            trace = sample(
                self.problem,
                settings,
                draws=length.draws,
                warmup=length.warmup,
                chains=length.chains,
                seed=self.seed,
                init=init,
                jumps=jumps,
                maxima=self.maxima,
                progress=self._watch(words),
            )
        self.done += length.steps
        return trace

    def finish(self) -> None:
        """Report that the runs are complete, even if not every planned run was performed."""
        if self.progress is not None:
            self.progress(self.phase, self.total, self.total, {"run": "all"})

    def _watch(self, words: str) -> Report | None:
        """Return a callback that reports one run's warm-up steps and draws, or None if no progress is reported."""
        report = self.progress
        if report is None:
            return None
        before = {"draws": 0}
        groups: dict[str, int] = {}

        def step(phase: str, done: int, total: int, info: Mapping[str, str | int | float]) -> None:
            if phase not in ("warmup", "draws"):  # computations after sampling count no steps
                return
            if phase == "warmup":
                before["draws"] = total
            group = str(info.get("group", "1/1"))
            groups[group] = done + (before["draws"] if phase == "draws" else 0)
            steps = sum(groups.values()) // int(group.rpartition("/")[2])
            report(self.phase, min(self.done + steps, self.total - 1), self.total, {"run": words})

        return step
