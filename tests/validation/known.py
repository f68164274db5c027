"""Posteriors of two and three parameters whose means and variances are known by quadrature."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

import fmu
from fmu.analysis.maxima.search import is_searchable
from fmu.fem.pairing.paired_model import PairedStructure
from fmu.types import FloatArray
from tests.samplers.targets import Banana, BoundedBeta, Funnel, SkewedGumbel, Target, TruncatedGaussian, TwoModes
from tests.samplers.tempered_targets import Tempered
from tests.validation import storeys, ten_storeys

NEGLIGIBLE = 45.0
"""Drop of the log-density below its maximum at which a cell of the quadrature is left out: e⁻⁴⁵ = 3e-20."""
_AT_ONCE = 200_000


class Moments(NamedTuple):
    """Mean and variance of every parameter, shape (ndim,) each."""

    mean: FloatArray
    variance: FloatArray


def moments(
    log_prob: Callable[[FloatArray], Any], lower: FloatArray, upper: FloatArray, cells: int, nodes: int = 4
) -> Moments:
    """Integrate a density over a box, by Gauss–Legendre quadrature in every cell that holds anything.

    Parameters
    ----------
    log_prob : callable
        Maps theta (n, ndim) to (n,).
    lower, upper : ndarray, shape (ndim,)
    cells, nodes : int
        Cells along each coordinate, and nodes in a cell along each. The middles of the cells must show where the
        density is.
    """
    ndim = len(lower)
    edge = (upper - lower) / cells
    grid = np.indices((cells,) * ndim).reshape(ndim, -1).T
    middles = np.array_split(lower + (grid + 0.5) * edge, max(1, len(grid) // _AT_ONCE))
    height = np.concatenate([np.asarray(log_prob(part)) for part in middles])
    kept = (height > height.max() - NEGLIGIBLE).reshape((cells,) * ndim)
    for axis in range(ndim):  # and their neighbours, into which the density may reach
        wider = kept.copy()
        np.moveaxis(wider, axis, 0)[1:] |= np.moveaxis(kept, axis, 0)[:-1]
        np.moveaxis(wider, axis, 0)[:-1] |= np.moveaxis(kept, axis, 0)[1:]
        kept = wider
    corners = lower + grid[kept.ravel()] * edge
    x, w = np.polynomial.legendre.leggauss(nodes)
    points = 0.5 * (1.0 + _product(x, ndim)) * edge
    weights = _product(w, ndim).prod(axis=1)
    origin = lower + (grid[np.argmax(height)] + 0.5) * edge
    sums = np.zeros((3, ndim))
    for part in np.array_split(corners, max(1, len(corners) * len(weights) // _AT_ONCE)):
        theta = (part[:, None] + points).reshape(-1, ndim)
        mass = np.tile(weights, len(part)) * np.exp(np.asarray(log_prob(theta)) - height.max())
        sums += [mass @ (theta - origin) ** power for power in range(3)]
    mean = sums[1] / sums[0]
    return Moments(origin + mean, sums[2] / sums[0] - mean**2)


def _product(x: FloatArray, ndim: int) -> FloatArray:
    """Return all combinations of the entries of x, shape (len(x)^ndim, ndim)."""
    return np.stack(np.meshgrid(*[x] * ndim, indexing="ij"), axis=-1).reshape(-1, ndim)


class Boxed(Tempered):
    """Any density as the likelihood under a uniform prior in a box; it has a prior for tempering to start from."""

    def __init__(self, target: Target, lower: Any, upper: Any) -> None:
        super().__init__(*(np.broadcast_to(bound, (target.ndim,)) for bound in (lower, upper)))
        self.target = target

    def prior(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the log-density of the prior and its gradient."""
        return np.full(len(theta), -np.sum(np.log(self.upper - self.lower))), np.zeros(theta.shape)

    def likelihood(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the log-density of the target and its gradient."""
        value, slope = self.target.value_and_slope(theta)
        return value, slope

    def sample_prior(self, rng: np.random.Generator, n: int) -> FloatArray:
        """Return points that are uniform in the box."""
        return self.lower + (self.upper - self.lower) * rng.random((n, self.ndim))


class Normal(Target):
    """A Gaussian of any centre, standard deviations and equal correlation."""

    def __init__(self, centre: Any, sd: Any, correlation: float) -> None:
        super().__init__(len(centre))
        one = np.eye(self.ndim)
        self.mean, self.covariance = (
            np.asarray(centre),
            np.outer(sd, sd) * (one + correlation * (1.0 - one)),
        )
        self.precision = np.linalg.inv(self.covariance)

    def value_and_slope(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return log-density and gradient."""
        pull = (self.mean - x) @ self.precision
        return -0.5 * np.sum((self.mean - x) * pull, axis=1), pull


class Student(Normal):
    """Student's t of five degrees of freedom: the fourth moment is finite, the sixth is not."""

    freedom = 5.0

    def value_and_slope(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return log-density and gradient."""
        value, pull = super().value_and_slope(x)
        over = self.freedom - 2.0 * value
        power = self.freedom + self.ndim
        return -0.5 * power * np.log(over), power * pull / over[:, None]


class ThinBanana(Banana):
    """A ridge that is bent, and a third as wide."""

    b, s = 1.0, 0.3

    def value_and_slope(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return log-density and gradient."""
        r = (x[:, 1] - self.b * (x[:, 0] ** 2 - 1.0)) / self.s
        value = -0.5 * x[:, 0] ** 2 - 0.5 * r**2
        return value, np.stack([-x[:, 0] + 2 * self.b * r * x[:, 0] / self.s, -r / self.s], axis=1)


class Separated(TwoModes):
    """Two round Gaussians of unequal weight, some standard deviations apart."""

    def __init__(self, weight: float, distance: float) -> None:
        Target.__init__(self, 2)
        self.weights = np.array([1.0 - weight, weight])
        self.centres = 0.5 * distance * np.array([[-0.8, -0.6], [0.8, 0.6]])
        self.covariances = np.array([np.eye(2), np.eye(2)])
        self.precisions = self.covariances


@dataclass(frozen=True)
class Known:
    """A posterior with its quadrature.

    Attributes
    ----------
    name : str
    kind : str
        What is hard about it.
    make : callable
        Returns the density: an updating problem, whose maxima can be searched for, or a plain log-density.
    box : (lower, upper), optional
        Where it is integrated; its bounds, where they are not given.
    cells : int
        Of the quadrature, along each coordinate.
    one_place : tuple of float, optional
        One of its maxima, from where chains are not expected to find the other: the maxima are separated.
    """

    name: str
    kind: str
    make: Callable[[], Any]
    cells: int
    box: tuple[Any, Any] | None = None
    one_place: tuple[float, ...] | None = None

    @cached_property
    def density(self) -> Any:
        """What is sampled."""
        return self.make()

    @property
    def is_searched(self) -> bool:
        """Whether it is an updating problem, whose maxima fmu searches for; a plain log-density is not."""
        return is_searchable(self.density)

    @cached_property
    def truth(self) -> Moments:
        """Means and variances by quadrature."""
        return self.integrated(self.cells)

    def integrated(self, cells: int) -> Moments:
        """Return means and variances by quadrature with so many cells along each coordinate."""
        lower, upper = self.box or (self.density.lower, self.density.upper)
        size = (self.density.ndim,)
        return moments(self.density.log_prob, np.broadcast_to(lower, size), np.broadcast_to(upper, size), cells)


def _uneven() -> fmu.UpdatingProblem:
    """Return Beck & Au's building with another prior, under which one of both maxima holds little."""
    both = fmu.cases.load("shear-2dof")
    priors = [fmu.LogNormal(mode, sd) for mode, sd in ((0.8, 0.5), (0.9, 0.6))]
    parameters = [
        fmu.Parameter(name, start=0.9, lower=0.0, upper=np.inf, prior=prior)
        for name, prior in zip(("theta1", "theta2"), priors, strict=True)
    ]
    error = fmu.FrequencyErrors("eigenvalue", sd=1 / 16)
    return fmu.UpdatingProblem(both.model, both.data, parameters, error=error)


def _three_storeys(measured: FloatArray) -> fmu.UpdatingProblem:
    return storeys.problem(storeys.reduced_model(), measured)


def _three_frequencies() -> fmu.UpdatingProblem:
    """Return three storeys whose stiffnesses are to follow from three frequencies: several frames have them."""
    names, numbers = ["k1", "k2", "k3"], (1, 2, 3)
    storey = [ten_storeys.storey(j, storeys=3, stiffness=2e8) for j in numbers]
    sensors = tuple((j, "x") for j in numbers)
    model = fmu.SeparableModel.from_terms(
        names, stiffness=list(zip(storey, names, strict=True)), mass=[1e5 * np.eye(3)], dofs=sensors
    )
    paired = PairedStructure.of(
        model, pairing="index", numbers=numbers, sensors=sensors, reference=np.ones(3), shapes=None
    )
    lower, upper = np.full(3, 0.2), np.full(3, 5.0)
    paired.train(lower, upper)
    truth = sum(factor * K for factor, K in zip((1.5, 1.0, 1.6), storey, strict=True))
    f = np.sqrt(np.linalg.eigvalsh(truth) / 1e5) / (2.0 * np.pi)
    parameters = [fmu.Parameter(name, start=1.0, lower=0.2, upper=5.0) for name in names]
    error = fmu.FrequencyErrors("relative", sd=0.04)
    return fmu.UpdatingProblem(paired, fmu.ModalData(f, numbers), parameters, error=error)


KNOWN = (
    Known("truncated Gaussian", "bounded", lambda: Boxed(t := TruncatedGaussian(), t.lower, t.upper), 40),
    Known("beta, mass at a wall", "bounded", lambda: Boxed(t := BoundedBeta(), t.lower, t.upper), 40),
    Known(
        "Gaussian in a corner", "bounded", lambda: Boxed(Normal([-0.2, 1.1, 0.5], [0.3] * 3, 0.8), 0.0, 1.0), 30
    ),
    Known("straight ridge", "ridge", lambda: Boxed(Normal([1.0, 2.0], [1.0, 3.0], 0.99), -19.0, 21.0), 400),
    Known("bent ridge", "ridge", lambda: Boxed(ThinBanana(), [-6.0, -4.0], [6.0, 36.0]), 400),
    Known("Gumbel", "skewed", lambda: Boxed(SkewedGumbel(), [-3.0, -5.0, -8.0], [14.0, 14.0, 14.0]), 50),
    Known("funnel", "skewed", lambda: Boxed(Funnel(), [-4.0, -20.0, -20.0], [4.0, 20.0, 20.0]), 80),
    Known("Student's t", "heavy tails", lambda: Boxed(Student([0.0, 0.0], [1.0, 2.0], 0.6), -60.0, 60.0), 400),
    Known("two maxima, near", "two maxima", lambda: Boxed(TwoModes(), -6.0, 7.0), 100),
    Known(
        "two maxima, seldom crossed", "two maxima", lambda: Boxed(Separated(0.3, 5.5), -9.0, 9.0), 100,
        one_place=(-2.2, -1.65),
    ),
    Known(
        "two maxima, far", "two maxima", lambda: Boxed(Separated(0.3, 16.0), -15.0, 15.0), 150,
        one_place=(-6.4, -4.8),
    ),
    Known(
        "two maxima, one of 5 %", "two maxima", lambda: Boxed(Separated(0.05, 16.0), -15.0, 15.0), 150,
        one_place=(-6.4, -4.8),
    ),
    Known(
        "shear-2dof", "frame, two maxima", lambda: fmu.cases.load("shear-2dof"), 200, (1e-9, 8.0),
        one_place=(0.498, 0.904),
    ),
    Known("shear-2dof, another prior", "frame, two maxima", _uneven, 200, (1e-9, 8.0)),
    Known("three storeys, two frequencies", "frame, ridge", lambda: _three_storeys(storeys.DESIGN_HZ), 30),
    Known("the same at its bounds", "frame, bounded", lambda: _three_storeys(0.86 * storeys.DESIGN_HZ), 30),
    Known("three storeys, three frequencies", "frame, several maxima", _three_frequencies, 80),
)  # fmt: skip
"""Everything that the verdicts are tried on."""
