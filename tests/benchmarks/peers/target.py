"""The posteriors, in the coordinates and with the log-probabilities that the peers need."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg as sl
from scipy.optimize import linear_sum_assignment
from scipy.special import expit, log_expit

import fmu
from fmu.fem.pairing.paired_structure import PairedStructure
from fmu.fem.pairing.rules import RankPairing
from fmu.types import FloatArray


@dataclass(frozen=True, eq=False)
class Target:
    """One case with one pairing.

    Attributes
    ----------
    case, pairing : str
    problem : UpdatingProblem
    """

    case: str
    pairing: str
    problem: Any

    @classmethod
    def load(cls, case: str, pairing: str) -> Target:
        """Return the case with its reduced model trained."""
        return cls(case, pairing, fmu.cases.load(case, pairing=pairing))

    @property
    def key(self) -> str:
        """Short name."""
        return f"{self.case}-{self.pairing}"

    @property
    def title(self) -> str:
        """Name for readers."""
        return f"{self.case}, pairing by {'number' if self.pairing == 'index' else self.pairing}"

    @property
    def structure(self) -> PairedStructure:
        """The beam with its pairing and its reduced model."""
        return self.problem.model

    def starts(self, seed: int, n: int) -> FloatArray:
        """Return starting points, shape (n, ndim), drawn from the prior; the same for every sampler."""
        return self.problem.sample_prior(np.random.default_rng([seed, 20]), n)

    @property
    def is_box(self) -> bool:
        """Whether every parameter has two bounds; otherwise each has a lower one."""
        return bool(np.all(np.isfinite(self.problem.upper)))

    def to_unit(self, theta: FloatArray) -> FloatArray:
        """Return u = (θ − lower)/scale; in a box the scale is upper − lower."""
        return (theta - self.problem.lower) / self.problem.scale

    def from_unit(self, u: FloatArray) -> FloatArray:
        """Return θ."""
        return self.problem.lower + self.problem.scale * u

    def to_free(self, theta: FloatArray) -> FloatArray:
        """Return the coordinates without bounds: log(u/(1 − u)) in a box, otherwise log u."""
        u = self.to_unit(theta)
        return np.log(u) - np.log1p(-u) if self.is_box else np.log(u)

    def from_free(self, z: FloatArray) -> FloatArray:
        """Return θ."""
        u = expit(z) if self.is_box else np.exp(z)
        return np.clip(self.from_unit(u), self.problem.lower, self.problem.upper)

    def free_log_prob_and_grad(self, z: FloatArray) -> tuple[float, FloatArray]:
        """Return the log-density in the coordinates without bounds and its gradient, at z (ndim,), by fmu's."""
        value, gradient = self.problem.log_prob_and_grad(self.from_free(z))
        if self.is_box:
            u = expit(z)
            log_du, slope, du = log_expit(z) + log_expit(-z), 1.0 - 2.0 * u, u * (1.0 - u)
        else:
            log_du, slope, du = z, np.ones_like(z), np.exp(z)
        return float(value + np.sum(log_du)), gradient * self.problem.scale * du + slope

    def near_a_bound(self, theta: FloatArray) -> float:
        """Return which share of the draws (n, ndim) is within 0.1 sd of a bound, of the parameter with most."""
        distance = np.minimum(theta - self.problem.lower, self.problem.upper - theta)
        return float(np.max(np.mean(distance < 0.1 * theta.std(axis=0), axis=0)))


class SciPyLogProb:
    """The log-probability that a user would write with SciPy: dense matrices, one theta, one call of eigh.

    Up to a constant. Generous to its user: the matrices of every term are at hand, so that assembly is one sum.
    """

    def __init__(self, target: Target, dofs: FloatArray | slice = slice(None)) -> None:
        problem, model = target.problem, target.structure.structure
        self.lower, self.upper = problem.lower, problem.upper
        self.precision = np.array([p.prior.sd for p in problem.parameters]) ** -2.0
        self.mean = np.array([p.prior.mean for p in problem.parameters])
        self.beta = problem.likelihood.beta
        self.measured = np.asarray(problem.data.frequencies_hz)
        self.K, self.K_powers = _dense(model.K_terms, dofs)
        self.M, self.M_powers = _dense(model.M_terms, dofs)
        self.solves = 0

    def __call__(self, theta: FloatArray) -> float:
        """Return the log-probability at theta (ndim,)."""
        if np.any(theta < self.lower) or np.any(theta > self.upper):
            return -np.inf
        self.solves += 1
        error = self.frequencies(theta) - self.measured
        return -np.sum(self.beta * error**2) - 0.5 * np.sum(self.precision * (theta - self.mean) ** 2)

    def matrices(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return K and M, dense."""
        K = np.tensordot(np.prod(theta**self.K_powers, axis=1), self.K, 1)
        return K, np.tensordot(np.prod(theta**self.M_powers, axis=1), self.M, 1)

    def frequencies(self, theta: FloatArray) -> FloatArray:
        """Return the paired frequencies in Hz."""
        raise NotImplementedError


class WholeBeam(SciPyLogProb):
    """The ten lowest modes of all 300 degrees of freedom, paired by number or by MAC."""

    def __init__(self, target: Target) -> None:
        super().__init__(target)
        self.rule = target.structure.rule
        self.by_number = target.pairing == "index"

    def frequencies(self, theta: FloatArray) -> FloatArray:
        """Return the paired frequencies in Hz."""
        lam, phi = sl.eigh(*self.matrices(theta), subset_by_index=[0, 9])
        if self.by_number:
            picked = np.array(self.rule.numbers) - 1
        else:
            seen, reference = self.rule.rows @ phi, self.rule.shapes
            mac = (reference.T @ seen) ** 2 / np.outer(np.sum(reference**2, 0), np.sum(seen**2, 0))
            picked = linear_sum_assignment(mac, maximize=True)[1]
        return np.sqrt(lam[picked]) / (2.0 * np.pi)


class WeakPlane(SciPyLogProb):
    """The five lowest eigenvalues of the 100 degrees of freedom of the weak plane, which need no pairing."""

    def __init__(self, target: Target) -> None:
        super().__init__(target, target.structure.structure.blocks[weak_block(target)])

    def frequencies(self, theta: FloatArray) -> FloatArray:
        """Return the frequencies in Hz."""
        lam = sl.eigh(*self.matrices(theta), subset_by_index=[0, 4], eigvals_only=True)
        return np.sqrt(lam) / (2.0 * np.pi)


def weak_block(target: Target) -> int:
    """Return which decoupled block the measured modes live in.

    Raises
    ------
    ValueError
        If they are not the lowest modes of one block.
    """
    pairing = target.structure.pairing
    if not isinstance(pairing, RankPairing) or len(set(pairing.block)) > 1 or pairing.rank != (0, 1, 2, 3, 4):
        raise ValueError(f"target: its modes must be the five lowest of one block (got {pairing})")
    return pairing.block[0]


def disagreement(target: Target, log_prob: Any, theta: FloatArray) -> float:
    """Return how much a log-probability differs from the target's at most at theta (n, ndim), a constant apart."""
    difference = np.array([float(log_prob(x)) for x in theta]) - target.problem.log_prob(theta)
    return float(np.ptp(difference))


def _dense(terms: Any, dofs: Any) -> tuple[FloatArray, FloatArray]:
    matrices = np.stack([term.matrix.toarray()[dofs][:, dofs] for term in terms])
    powers = np.array([term.powers for term in terms])
    used = np.array([np.any(matrix) for matrix in matrices])
    return matrices[used], powers[used]


def of_unit_cube(problem: Any) -> Callable[[FloatArray], FloatArray]:
    """Return what maps the unit cube (..., ndim) to the prior, truncated to the bounds."""

    def theta(u: FloatArray) -> FloatArray:
        each = [p.prior.quantile(u[..., j], p.lower, p.upper) for j, p in enumerate(problem.parameters)]
        return np.stack(each, axis=-1)

    return theta
