"""Evidences of two models of the paper's beam and of Beck & Au's building, each computed by several methods.

    python -m tests.validation.evidence OUT [--kept DIRECTORY] [--minutes M]

The exit code is 1 if two methods disagree.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

import fmu
from fmu.analysis.maxima.mode_weights import mode_weights
from fmu.analysis.maxima.results import Maxima, PosteriorMaximum
from fmu.samplers.mixture.quadratic import Quadratic
from fmu.types import BoolArray, FloatArray
from tests.two_storeys import quadrature
from tests.validation.kept import Units, each, study_parser

CHAINS, WARMUP, DRAWS, SEED = 24, 200, 300, 1
IMPORTANCE_DRAWS = 8192
AGREE = 4.0
"""Largest difference between two estimates, in combined standard errors."""
SHARES = (0.01, 0.03)
BEAMS = tuple(
    (case, pairing) for pairing in ("shape", "index") for case in ("cantilever-young", "cantilever-section")
)


@dataclass(frozen=True)
class Estimate:
    """A log-evidence, its standard error (0 if exact), and whether it comes with a warning."""

    log_evidence: float
    error: float
    warned: bool = False

    def difference(self, other: Estimate) -> float:
        """Return the difference between two estimates in combined standard errors; infinite if both are exact."""
        error = float(np.hypot(self.error, other.error))
        return abs(self.log_evidence - other.log_evidence) / error if error else np.inf

    def agrees(self, other: Estimate) -> bool:
        """Return whether two estimates differ by at most `AGREE` combined standard errors; False for NaN.

        The result is True if either estimate comes with a warning: such an estimate is not compared.
        """
        near = abs(self.log_evidence - other.log_evidence) <= AGREE * np.hypot(self.error, other.error)
        return self.warned or other.warned or bool(near)


@dataclass(frozen=True)
class Row:
    """One evidence, computed by several methods.

    Attributes
    ----------
    case, pairing, region : str
        `region` is empty for the whole box.
    ways : dict of str to Estimate
        Estimates by method.
    laplace : float
        Laplace approximation of the log-evidence, NaN if a bound is active; not compared.
    theta, log_likelihood : ndarray, float
        The highest maximum of the posterior, and the log-likelihood there.
    """

    case: str
    pairing: str
    region: str
    ways: dict[str, Estimate]
    laplace: float
    theta: FloatArray
    log_likelihood: float

    @property
    def failures(self) -> list[str]:
        """Methods that disagree, one sentence each."""
        return [
            f"{self.title}: the log-evidences by {first} and {second} differ by "
            f"{abs(one.log_evidence - other.log_evidence):.2f}, which is {one.difference(other):.1f} combined "
            "standard errors"
            for (first, one), (second, other) in combinations(self.ways.items(), 2)
            if not one.agrees(other)
        ]

    @property
    def title(self) -> str:
        """The problem in words."""
        by = {"index": "number"}.get(self.pairing, self.pairing)
        return f"{self.case}, modes paired by {by}{self.region and ', region ' + self.region}"

    @property
    def is_compared(self) -> bool:
        """Whether at least two methods are compared."""
        return sum(not way.warned for way in self.ways.values()) > 1


class Region:
    """An updating problem whose likelihood is set to zero outside one region of the box.

    If modes are paired by number, the k-th frequency belongs to different mode shapes in different regions of the
    box. A region contains all points where the computed modes paired with the measured ones are the same as at
    `theta`. The regions fill the box, so their evidences add up to the evidence of the whole box.

    Parameters
    ----------
    problem : fmu.UpdatingProblem
    theta : ndarray, shape (ndim,)
        A point in the region.
    """

    def __init__(self, problem: fmu.UpdatingProblem, theta: FloatArray) -> None:
        self.problem = problem
        self.ndim, self.lower, self.upper = problem.ndim, problem.lower, problem.upper
        self.offset, self.scale, self.names, self.start = problem.offset, problem.scale, problem.names, theta
        self.sample_prior, self.log_prior = problem.sample_prior, problem.log_prior
        self._modes = self._labels(theta[None])[0]

    def log_likelihood(self, theta: FloatArray) -> FloatArray:
        """Return the log-likelihood of the problem, −inf outside the region."""
        value = np.asarray(self.problem.log_likelihood(theta))
        return np.where(self.holds(theta), value, -np.inf)

    def log_prob(self, theta: FloatArray) -> FloatArray:
        """Return the log-probability of the problem, −inf outside the region."""
        return np.where(self.holds(theta), self.problem.log_prob(theta), -np.inf)

    def holds(self, theta: FloatArray) -> BoolArray:
        """Return which of theta (n, ndim) are in the region."""
        return np.all(self._labels(theta) == self._modes, axis=1)

    def _labels(self, theta: FloatArray) -> NDArray[np.int64]:
        modes = self.problem.model.modes(theta)  # type: ignore[attr-defined]
        return np.concatenate([modes.block, modes.rank], axis=1)


def tempered(problem: Any, init: str | FloatArray = "prior") -> dict[str, Estimate]:
    """Return the evidence by parallel tempering, with two estimators from the same run."""
    kernel = fmu.Tempering()
    trace = fmu.sample(problem, kernel, draws=DRAWS, warmup=WARMUP, chains=CHAINS, seed=SEED, init=init)
    found = {f"tempering, {method}": fmu.evidence(trace, method) for method in ("stepping-stone", "thermodynamic")}
    return {way: Estimate(one.log_evidence, one.error, bool(one.warnings)) for way, one in found.items()}


def weighed(problem: Any, maxima: list[PosteriorMaximum], draws: int = IMPORTANCE_DRAWS) -> Estimate:
    """Return the evidence by importance sampling around the maxima, within the bounds."""
    scale, offset = problem.scale, problem.offset
    models = [
        Quadratic((m.theta - offset) / scale, m.log_prob, m.gradient * scale, m.hessian * np.outer(scale, scale))
        for m in maxima
    ]
    lower, upper = ((bound - offset) / scale for bound in (problem.lower, problem.upper))

    def log_prob(u: FloatArray) -> FloatArray:
        return np.asarray(problem.log_prob(np.clip(offset + scale * u, problem.lower, problem.upper)))

    found = mode_weights(log_prob, models, lower, upper, np.random.default_rng(SEED), draws)
    log_mass = np.array([mass.log_mass for mass in found])
    total = float(np.logaddexp.reduce(log_mass))
    share = np.exp(log_mass - total)
    error = float(np.sqrt(share @ [mass.evidence_covariance for mass in found]))
    return Estimate(total + float(np.sum(np.log(scale))), error)


def laplace(maxima: list[PosteriorMaximum]) -> float:
    """Return the Laplace approximation of the log-evidence; NaN if a bound is active at a maximum."""
    if any(np.any(m.at_bound) for m in maxima):
        return np.nan
    each = [
        m.log_prob + 0.5 * (len(m.theta) * np.log(2 * np.pi) - np.linalg.slogdet(m.hessian)[1]) for m in maxima
    ]
    return float(np.logaddexp.reduce(each))


def row(case: str, pairing: str, problem: fmu.UpdatingProblem, maxima: Maxima) -> Row:
    """Return the evidence of a problem over the whole box, by all methods."""
    relevant = [m for m in maxima if m.share > 1e-12]
    ways = tempered(problem) | {"importance sampling": weighed(problem, relevant)}
    best = maxima[0].theta
    return Row(case, pairing, "", ways, laplace(relevant), best, float(problem.log_likelihood(best)))


def regions(case: str, problem: fmu.UpdatingProblem, maxima: Maxima) -> Iterator[Row]:
    """Yield the evidence of the regions A, B and C around the three highest maxima, the highest first."""
    for letter, maximum in zip("ABC", maxima, strict=False):
        region = Region(problem, maximum.theta)
        start = np.repeat(maximum.theta[None], CHAINS, axis=0)
        ways = tempered(region, start) | {"importance sampling": weighed(region, [maximum])}
        likelihood = float(problem.log_likelihood(maximum.theta))
        yield Row(case, "index", letter, ways, laplace([maximum]), maximum.theta, likelihood)


def wide(case: str, relative: float) -> Estimate:
    """Return a beam's evidence by importance sampling, with errors proportional to frequency and shape pairing."""
    beta = 1.0 / (2.0 * (relative * fmu.cases.load(case).data.frequencies_hz) ** 2)
    problem = fmu.cases.load(case, "shape", beta=beta)
    return weighed(problem, list(fmu.find_map(problem)))


def evidences(case: str, pairing: str) -> list[Row]:
    """Return the evidence of a case, followed by the evidences of its regions if the case has several."""
    problem = fmu.cases.load(case, pairing)
    maxima = fmu.find_map(problem)
    rows = [row(case, pairing, problem, maxima)]
    if case == "shear-2dof":
        rows[0].ways["quadrature"] = Estimate(quadrature().log_evidence, 0.0)
    return [*rows, *regions(case, problem, maxima)] if (case, pairing) == BEAMS[-1] else rows


def _row(fields: dict[str, Any]) -> Row:
    """Return a row from its stored fields."""
    ways = {name: Estimate(**way) for name, way in fields["ways"].items()}
    return Row(**fields | {"ways": ways, "theta": np.array(fields["theta"])})


def study(units: Units) -> tuple[list[Row], dict[float, list[Estimate]]]:
    """Return all rows, and the evidences of both beams for errors proportional to frequency."""
    rows = units.completed(
        "cases",
        each([("shear-2dof", "index"), *BEAMS]),
        lambda one: [asdict(found) for found in evidences(*one)],
        lambda kept: [_row(fields) for fields in kept],
        least=1 + len(BEAMS),
    )
    shares = units.completed(
        "errors",
        each(SHARES),
        lambda share: [asdict(wide(case, share)) for case, _ in BEAMS[:2]],
        lambda kept: [Estimate(**fields) for fields in kept],
        least=len(SHARES),
    )
    return [one for found in rows for one in found], dict(zip(SHARES, shares, strict=False))


def main() -> int:
    """Run the study, write ``evidence.md``, and return the exit code."""
    from tests.validation.evidence_page import write

    asked = study_parser(__doc__).parse_args()
    units = Units(asked.kept, asked.minutes)
    with threadpool_limits(1):
        rows, shares = study(units)
    write(rows, shares, asked.out, units.processor_s)
    failures = [failure for one in rows for failure in one.failures]
    for failure in failures:
        print(failure)
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
