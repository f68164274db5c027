"""The posteriors in the coordinates of the peers, with their log-probabilities."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import numpy as np
import scipy.linalg as sl
from scipy.special import expit, log_expit

import fmu
from fmu.analysis.estimate import gradient_cost
from fmu.fem.pairing.paired_structure import PairedStructure
from fmu.posterior.reduction.region import plausible_points
from fmu.types import BoolArray, FloatArray

FRAME = "frame-50"
_STOREYS, _BAYS, _MODES, _SD = 10, 2, 12, 0.005


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
    @cache
    def load(cls, case: str, pairing: str) -> Target:
        """Return the case with its reduced model trained, or the frame."""
        return cls(case, pairing, frame() if case == FRAME else fmu.cases.load(case, pairing=pairing))

    @property
    def key(self) -> str:
        """Short name."""
        return f"{self.case}-{self.pairing}"

    @property
    def title(self) -> str:
        """Name for readers."""
        return f"{self.case}, pairing by {'number' if self.pairing == 'index' else self.pairing}"

    @cached_property
    def gradient_cost(self) -> float:
        """Time of a gradient, in log-probabilities, for a batch of 4 plausible points."""
        return gradient_cost(self.problem, plausible_points(self.problem, 4, np.random.default_rng(7)))

    @property
    def structure(self) -> PairedStructure:
        """The beam with its pairing and its reduced model."""
        return self.problem.model

    def starts(self, seed: int, n: int) -> FloatArray:
        """Return starting points, shape (n, ndim), drawn from the prior; the same for every sampler."""
        return self.problem.sample_prior(np.random.default_rng([seed, 20]), n)

    @property
    def boxed(self) -> BoolArray:
        """Whether a parameter has two bounds, shape (ndim,); all others have a lower one."""
        return np.isfinite(self.problem.upper)

    @property
    def width(self) -> FloatArray:
        """Distance between two bounds, or the problem's scale, shape (ndim,)."""
        return np.where(self.boxed, self.problem.upper - self.problem.lower, self.problem.scale)

    def to_unit(self, theta: FloatArray) -> FloatArray:
        """Return u = (θ − lower)/width, between 0 and 1 with two bounds."""
        return (theta - self.problem.lower) / self.width

    def from_unit(self, u: FloatArray) -> FloatArray:
        """Return θ."""
        return self.problem.lower + self.width * u

    def to_free(self, theta: FloatArray) -> FloatArray:
        """Return the coordinates without bounds: log(u/(1 − u)) with two bounds, otherwise log u."""
        u = self.to_unit(theta)
        return np.log(u) - np.where(self.boxed, np.log1p(-np.where(self.boxed, u, 0.0)), 0.0)

    def from_free(self, z: FloatArray) -> FloatArray:
        """Return θ."""
        u = np.where(self.boxed, expit(z), np.exp(np.where(self.boxed, 0.0, z)))
        return np.clip(self.from_unit(u), self.problem.lower, self.problem.upper)

    def free_log_prob_and_grad(self, z: FloatArray) -> tuple[float, FloatArray]:
        """Return the log-density and its gradient in the unbounded coordinates, at z (ndim,)."""
        value, gradient = self.problem.log_prob_and_grad(self.from_free(z))
        u = expit(z)
        log_du = np.where(self.boxed, log_expit(z) + log_expit(-z), z)
        slope = np.where(self.boxed, 1.0 - 2.0 * u, 1.0)
        du = np.where(self.boxed, u * (1.0 - u), np.exp(np.where(self.boxed, 0.0, z)))
        return float(value + np.sum(log_du)), gradient * self.width * du + slope

    def of_unit_cube(self, u: FloatArray) -> FloatArray:
        """Return the prior's quantiles θ, truncated to the bounds, at u (..., ndim)."""
        return of_unit_cube(self.problem)(u)


def disagreement(target: Target, log_prob: Any, theta: FloatArray) -> float:
    """Return the range of `log_prob` minus the target's log-probability over theta, shape (n, ndim)."""
    difference = np.array([float(log_prob(x)) for x in theta]) - target.problem.log_prob(theta)
    return float(np.ptp(difference))


def of_unit_cube(problem: Any) -> Callable[[FloatArray], FloatArray]:
    """Return the map from the unit cube (..., ndim) to the prior, truncated to the bounds."""

    def theta(u: FloatArray) -> FloatArray:
        each = [p.prior.quantile(u[..., j], p.lower, p.upper) for j, p in enumerate(problem.parameters)]
        return np.stack(each, axis=-1)

    return theta


def frame() -> fmu.UpdatingProblem:
    """Return a plane frame of ten storeys and two bays with a modulus for each of its 50 members.

    Twelve frequencies of a simulated structure whose moduli scatter by 10 % are measured within 0.5 %. The priors
    scatter by 15 %, and the bounds are six of their standard deviations away.
    """
    columns, stations = range(_BAYS + 1), range(_STOREYS + 1)
    nodes = [(6.0 * bay, 0.0, 3.5 * level) for level in stations for bay in columns]
    across = len(columns)
    pairs = [(across * level + bay, across * (level + 1) + bay) for level in range(_STOREYS) for bay in columns]
    pairs += [(across * level + bay, across * level + bay + 1) for level in stations[1:] for bay in range(_BAYS)]
    steel, section = (
        fmu.Material(E=2.1e11, nu=0.3, rho=7850.0),
        fmu.Section(A=1.5e-2, Iy=2.5e-4, Iz=2.5e-4, J=1e-6),
    )
    groups = [fmu.ElementGroup(f"member {i}", [pair], section, steel) for i, pair in enumerate(pairs, 1)]
    in_plane = dict.fromkeys(range(across, len(nodes)), ("y", "rx", "rz"))
    clamped = dict.fromkeys(range(across), ("x", "y", "z", "rx", "ry", "rz"))
    masses = [fmu.PointMass(i, 5e3) for i in range(across, len(nodes))]
    updates = {f"e{i}": fmu.Factor([("E", group.name)]) for i, group in enumerate(groups, 1)}
    model = fmu.Frame(nodes, groups, clamped | in_plane, masses).separable(updates)
    prior = fmu.Normal(0.15, mean=1.0)
    parameters = [fmu.Parameter(name, 1.0, 0.1, 1.9, prior=prior) for name in updates]
    rng = np.random.default_rng(20)
    truth = 1.0 + 0.1 * rng.standard_normal(len(parameters))
    lam = sl.eigh(
        model.K(truth).toarray(), model.M(truth).toarray(), subset_by_index=[0, _MODES - 1], eigvals_only=True
    )
    exact = np.sqrt(lam) / (2.0 * np.pi)
    measured = exact * (1.0 + _SD * rng.standard_normal(_MODES))
    data = fmu.ModalData(measured, numbers=tuple(range(1, _MODES + 1)), sd_hz=_SD * measured)
    return fmu.UpdatingProblem(model, data, parameters, pairing="index", name=FRAME)
