"""How often is a correct model contradicted, and how often a wrong one?

    python -m tests.validation.fit OUT [--kept DIRECTORY] [--minutes M]

Measurements of a shear building of eight storeys are simulated without fmu. The stiffnesses of three groups of
storeys are updated by Hamiltonian Monte Carlo, and `fmu.diagnose` gives the verdict on the model. Exit code 1 if a
gate fails.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import beta, binom
from threadpoolctl import threadpool_limits

import fmu
from fmu.analysis.fit.check import LEVEL
from fmu.analysis.fit.model_fit import CONTRADICTED, NOT_CONTRADICTED, NOT_TESTABLE
from fmu.numbers import share
from fmu.types import FloatArray
from tests.validation import ten_storeys
from tests.validation.kept import Units, each, study_parser

STOREYS, STIFFNESS, MASS = 8, 1.5e8, 1e5  # N/m, kg
storey = partial(ten_storeys.storey, storeys=STOREYS, stiffness=STIFFNESS)
GROUPS = ((1, 2), (3, 4, 5), (6, 7, 8))
"""Groups of storeys that share a stiffness; the parameters are their three stiffnesses."""
SPREAD, SD = 0.15, 0.005
"""Prior standard deviation of the logarithm of a stiffness, and relative error of a measured frequency (1 sd)."""
NOISE_SPREAD = 0.4
"""Prior standard deviation of the logarithm of the noise, if the noise is inferred."""
MODES = 6
RIGHT, OTHERS, WRONG, FEW = 300, 40, 20, 10
"""Number of simulated problems: with a correct model; with each other correct model; with each size of an error;
and with each setting of few data."""
WARMUP, DRAWS, CHAINS = 70, 100, 8
SEED = 15
GATE = 1e-3
"""Probability that the gate for false alarms fails if their rate is `LEVEL`."""
FOUND = 0.9
"""Required rate of "contradicted" for the largest errors."""
FLOOR, STOREY, MODE = 8, 4, 3
"""Floor with the missing mass, storey with a lower stiffness than its group, and mode with a wrong frequency."""


class Setting(NamedTuple):
    """A kind of simulated problem: the true structure, the measurement, and the inferred quantities.

    Attributes
    ----------
    label : str
    n : int
        Number of simulated problems.
    place : float or None
        Distance of the true stiffnesses from their prior medians, in prior standard deviations; None to draw them
        from the priors.
    mass, soft, off : float
        Mass missing from the model, as a fraction of a floor's mass; fraction of a storey's stiffness that is
        lost; error of a measured frequency, in standard deviations.
    modes : int
        Number of measured modes.
    held_out : int
        Number of modes, the highest ones, that are not used in updating.
    inferred : bool
        Whether the standard deviation of the frequencies is inferred.
    """

    label: str
    n: int
    place: float | None = None
    mass: float = 0.0
    soft: float = 0.0
    off: float = 0.0
    modes: int = MODES
    held_out: int = 0
    inferred: bool = False


RIGHT_ONES = (
    Setting("true values drawn from the priors", RIGHT),
    Setting("the same, noise inferred, one mode held out", OTHERS, inferred=True, held_out=1),
    Setting("every true stiffness at +2 prior standard deviations", OTHERS, place=2.0),
    Setting("every true stiffness at −2 prior standard deviations", OTHERS, place=-2.0),
)
FEW_ONES = (
    Setting("three frequencies, three parameters, a correct model", FEW, modes=3),
    Setting("two frequencies, three parameters, a correct model", FEW, modes=2),
    Setting("two frequencies, three parameters, half of a storey's stiffness lost", FEW, modes=2, soft=0.5),
    Setting("two frequencies and one held out, three parameters, a correct model", FEW, modes=3, held_out=1),
)
CURVES: Mapping[str, tuple[Setting, ...]] = {
    "mass missing from the top floor, as a fraction of a floor's mass": tuple(
        Setting(f"{x:g}", WRONG, mass=x) for x in (0.1, 0.2, 0.4, 0.6, 0.8)
    ),
    "stiffness lost in one storey of a group, as a fraction": tuple(
        Setting(f"{x:g}", WRONG, soft=x) for x in (0.05, 0.1, 0.15, 0.2, 0.3)
    ),
    "error of one frequency, in standard deviations": tuple(
        Setting(f"{x:g}", WRONG, off=x) for x in (2.0, 4.0, 5.0, 6.0, 8.0)
    ),
}


class Outcome(NamedTuple):
    """The verdict on one simulated problem, the kinds of checks that failed, and the time taken."""

    verdict: str
    kinds: frozenset[str]
    converged: bool
    seconds: float


@dataclass(frozen=True)
class Rate:
    """The verdicts on all problems of a setting."""

    setting: Setting
    outcomes: Sequence[Outcome]

    def count(self, verdict: str) -> int:
        """Return how often the verdict was `verdict`."""
        return sum(one.verdict == verdict for one in self.outcomes)

    @property
    def n(self) -> int:
        """Number of problems."""
        return len(self.outcomes)

    @property
    def interval(self) -> tuple[float, float]:
        """The exact 95 % interval of the rate of "contradicted" (Clopper & Pearson 1934)."""
        k = self.count(CONTRADICTED)
        low = float(beta.ppf(0.025, k, self.n - k + 1)) if k else 0.0
        return low, float(beta.ppf(0.975, k + 1, self.n - k)) if k < self.n else 1.0

    def share(self, kind: str) -> float:
        """Return the fraction of the problems in which a check of this kind failed."""
        return sum(kind in one.kinds for one in self.outcomes) / self.n


@dataclass(frozen=True)
class Study:
    """All rates and their gates."""

    right: Sequence[Rate]
    few: Sequence[Rate]
    curves: Mapping[str, Sequence[Rate]]

    @property
    def all(self) -> list[Rate]:
        """All rates."""
        return [*self.right, *self.few, *(rate for curve in self.curves.values() for rate in curve)]

    @cached_property
    def failures(self) -> list[str]:
        """The gates that fail, one sentence each."""
        found = []
        for rate in self.right:
            k, most = rate.count(CONTRADICTED), int(binom.isf(GATE, rate.n, LEVEL))
            if k > most and rate.setting.place is None:
                found.append(f"{rate.setting.label}: {k} of {rate.n} contradicted (at most {most} allowed)")
        for rate in self.few:
            expected = NOT_CONTRADICTED if rate.setting.held_out else NOT_TESTABLE
            wrong = rate.n - rate.count(expected) - rate.count(CONTRADICTED)
            if wrong:
                words = f"{wrong} of {rate.n} neither “{expected}” nor “{CONTRADICTED}”"
                found.append(f"{rate.setting.label}: {words}")
            elif not rate.count(expected):
                found.append(f"{rate.setting.label}: none of {rate.n} “{expected}”")
        for name, curve in self.curves.items():
            if curve[-1].count(CONTRADICTED) < FOUND * curve[-1].n:
                words = f"{curve[-1].count(CONTRADICTED)} of {curve[-1].n} contradicted ({share(FOUND)} required)"
                found.append(f"{name}, {curve[-1].setting.label}: {words}")
        return found


def matrices(factors: Sequence[float]) -> tuple[FloatArray, FloatArray]:
    """Return stiffness (N/m) and mass matrix (kg) of the building, for one stiffness factor per storey."""
    K = np.zeros((STOREYS, STOREYS))
    for j, factor in enumerate(factors):
        K += factor * storey(j + 1)
    return K, MASS * np.eye(STOREYS)


def true_hz(setting: Setting, theta: FloatArray) -> FloatArray:
    """Return the frequencies of the true building, which the model may be unable to represent."""
    factors = np.empty(STOREYS)
    for x, group in zip(theta, GROUPS, strict=True):
        factors[[j - 1 for j in group]] = x
    factors[STOREY - 1] *= 1.0 - setting.soft
    K, M = matrices(factors.tolist())
    M[FLOOR - 1, FLOOR - 1] += setting.mass * MASS
    return np.asarray(np.sqrt(np.linalg.eigvalsh(K / np.sqrt(np.outer(M.diagonal(), M.diagonal())))) / (2 * np.pi))


@dataclass(frozen=True)
class Building:
    """The first frequencies as functions of the three factors, and their derivatives."""

    n_modes: int
    n_parameters: int = len(GROUPS)

    @cached_property
    def groups(self) -> FloatArray:
        """Stiffness of each group of storeys over the mass of a floor, shape (3, 8, 8)."""
        return np.array([sum(storey(j) for j in group) for group in GROUPS]) / MASS

    def frequencies(self, theta: FloatArray) -> FloatArray:
        """Return the frequencies at theta (n, 3), Hz."""
        return self.frequencies_and_gradient(theta)[0]

    def frequencies_and_gradient(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the frequencies (n, n_modes) and their derivatives (n, n_modes, 3): dω² = φᵀ dK φ/M."""
        values, shapes = np.linalg.eigh(np.tensordot(theta, self.groups, axes=1))
        omega, shapes = np.sqrt(values[:, : self.n_modes]), shapes[:, None, :, : self.n_modes]
        slopes = np.sum(shapes * (self.groups @ shapes), axis=2).swapaxes(1, 2)
        return omega / (2.0 * np.pi), slopes / (4.0 * np.pi * omega[..., None])


def parameters() -> tuple[fmu.Parameter, ...]:
    """Return the parameters of the model."""
    return tuple(
        fmu.Parameter(f"k{i}", 1.0, 0.0, np.inf, fmu.LogNormal(1.0, SPREAD)) for i in range(1, len(GROUPS) + 1)
    )


def simulated(setting: Setting, rng: np.random.Generator, model: Building) -> fmu.UpdatingProblem:
    """Return the updating problem of one simulated measurement."""
    z = rng.standard_normal(len(GROUPS)) if setting.place is None else np.full(len(GROUPS), setting.place)
    sd = SD * np.exp(NOISE_SPREAD * rng.standard_normal()) if setting.inferred else SD
    hz = true_hz(setting, np.exp(SPREAD * z))[: setting.modes]
    measured = hz / (1.0 + sd * rng.standard_normal(setting.modes))
    if setting.off:
        measured[MODE - 1] *= 1.0 + setting.off * SD * rng.choice([-1.0, 1.0])
    noise = fmu.Parameter("sd_frequency", SD, 0.0, np.inf, fmu.LogNormal(SD, NOISE_SPREAD))
    used = tuple(k < setting.modes - setting.held_out for k in range(setting.modes))
    data = fmu.ModalData(measured, tuple(range(1, setting.modes + 1)), use=used)
    error = fmu.FrequencyErrors("relative", sd=noise if setting.inferred else SD)
    return fmu.UpdatingProblem(model, data, parameters(), error=error)


def judged(problem: fmu.UpdatingProblem, seed: int) -> Outcome:
    """Return the verdict on a problem, from a short run."""
    began = time.process_time()
    trace = fmu.sample(problem, "hmc", draws=DRAWS, warmup=WARMUP, chains=CHAINS, seed=seed)
    found = fmu.diagnose(trace)
    kinds = frozenset(check.kind for check in found.fit.checks if check.failed)
    return Outcome(found.fit.verdict, kinds, found.converged, time.process_time() - began)


def study(units: Units) -> Study:
    """Return the study."""
    of_curves = [setting for curve in CURVES.values() for setting in curve]
    settings = [*RIGHT_ONES[:1], *of_curves, *FEW_ONES, *RIGHT_ONES[1:]]

    def run(task: tuple[int, int]) -> list[Any]:
        k, i = task
        setting = settings[k]
        rng = np.random.default_rng(np.random.SeedSequence([SEED, k]).spawn(setting.n)[i])
        found = judged(simulated(setting, rng, Building(setting.modes)), int(rng.integers(2**31)))
        return [k, found.verdict, sorted(found.kinds), found.converged, found.seconds]

    # one problem of each setting in turn: if the budget ends early, every setting has some
    tasks = sorted(
        ((k, i) for k, setting in enumerate(settings) for i in range(setting.n)), key=lambda task: task[1]
    )
    outcomes: dict[Setting, list[Outcome]] = {setting: [] for setting in settings}
    for k, verdict, kinds, converged, seconds in units.completed(
        "problems", each(tasks), run, least=len(settings)
    ):
        outcomes[settings[k]].append(Outcome(verdict, frozenset(kinds), converged, seconds))
    return Study(
        [Rate(setting, outcomes[setting]) for setting in RIGHT_ONES],
        [Rate(setting, outcomes[setting]) for setting in FEW_ONES],
        {name: [Rate(setting, outcomes[setting]) for setting in curve] for name, curve in CURVES.items()},
    )


def main() -> int:
    """Run the study, write ``fit.md`` and its figure, and return the exit code."""
    from tests.validation.fit_page import write

    asked = study_parser(__doc__).parse_args()
    with threadpool_limits(1):
        found = study(Units(asked.kept, asked.minutes))
    write(found, asked.out)
    for failure in found.failures:
        print(failure)
    return 1 if found.failures else 0


if __name__ == "__main__":
    sys.exit(main())
