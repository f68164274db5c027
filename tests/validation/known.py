"""Posteriors with known means, variances and evidence, by quadrature or, in more dimensions, by formula."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np
from scipy.spatial.distance import pdist
from scipy.special import gammaln

import fmu
from fmu.analysis.maxima.results import Maxima, PosteriorMaximum
from fmu.analysis.trace.densities import is_updating, names_of
from fmu.fem.pairing.paired_structure import PairedStructure
from fmu.fem.reduced.reduced_structure import train
from fmu.types import FloatArray
from tests.samplers.targets import Banana, BoundedBeta, Funnel, SkewedGumbel, Target, TruncatedGaussian, TwoModes
from tests.samplers.tempered_targets import Tempered
from tests.shear_building import frequencies_hz, shear_building
from tests.validation import storeys

NEGLIGIBLE = 45.0
"""A cell of the quadrature is left out if its log-density is this far below the maximum: e⁻⁴⁵ = 3e-20."""
_AT_ONCE = 200_000
"""Points evaluated in one batch."""


class Moments(NamedTuple):
    """Mean and variance of every parameter, shape (ndim,) each, and the logarithm of the density's integral."""

    mean: FloatArray
    variance: FloatArray
    log_mass: float


def moments(
    log_prob: Callable[[FloatArray], Any], lower: FloatArray, upper: FloatArray, cells: int, nodes: int = 4
) -> Moments:
    """Integrate a density over a box by Gauss–Legendre quadrature in all cells that are not negligible.

    Parameters
    ----------
    log_prob : callable
        Maps theta (n, ndim) to (n,).
    lower, upper : ndarray, shape (ndim,)
    cells, nodes : int
        Number of cells along each coordinate, and number of nodes along each coordinate of a cell. The cells must
        be so small that the log-density at their centres shows where the density is not negligible.
    """
    ndim = len(lower)
    edge = (upper - lower) / cells
    grid = np.indices((cells,) * ndim).reshape(ndim, -1).T
    middles = np.array_split(lower + (grid + 0.5) * edge, max(1, len(grid) // _AT_ONCE))
    height = np.concatenate([np.asarray(log_prob(part)) for part in middles])
    kept = (height > height.max() - NEGLIGIBLE).reshape((cells,) * ndim)
    for axis in range(ndim):  # neighbours are included too, because the density may extend into them
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
    log_mass = float(height.max() + np.log(sums[0, 0]) + np.sum(np.log(0.5 * edge)))
    return Moments(origin + mean, sums[2] / sums[0] - mean**2, log_mass)


def _product(x: FloatArray, ndim: int) -> FloatArray:
    """Return all combinations of `ndim` entries of x, shape (len(x)^ndim, ndim)."""
    return np.stack(np.meshgrid(*[x] * ndim, indexing="ij"), axis=-1).reshape(-1, ndim)


class Boxed(Tempered):
    """Any density as the likelihood with a uniform prior in a box, so that tempering has a prior to start from."""

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
        """Return points from the uniform distribution in the box."""
        return self.lower + (self.upper - self.lower) * rng.random((n, self.ndim))


class Normal(Target):
    """A Gaussian with given centre, standard deviations and one correlation for all pairs."""

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
    """Student's t with five degrees of freedom: the fourth moment is finite, the sixth is not."""

    freedom = 5.0

    def value_and_slope(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return log-density and gradient."""
        value, pull = super().value_and_slope(x)
        over = self.freedom - 2.0 * value
        power = self.freedom + self.ndim
        return -0.5 * power * np.log(over), power * pull / over[:, None]


class ThinBanana(Banana):
    """A curved ridge, narrower than `Banana`."""

    b, s = 1.0, 0.3

    def __init__(self) -> None:
        super().__init__()
        self.covariance = np.diag([1.0, 2.0 * self.b**2 + self.s**2])
        self.log_mass = float(np.log(2.0 * np.pi * self.s))

    def value_and_slope(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return log-density and gradient."""
        r = (x[:, 1] - self.b * (x[:, 0] ** 2 - 1.0)) / self.s
        value = -0.5 * x[:, 0] ** 2 - 0.5 * r**2
        return value, np.stack([-x[:, 0] + 2 * self.b * r * x[:, 0] / self.s, -r / self.s], axis=1)


class Separated(TwoModes):
    """Two Gaussians with unit covariance and unequal weights, `distance` standard deviations apart."""

    def __init__(self, weight: float, distance: float) -> None:
        Target.__init__(self, 2)
        self.weights = np.array([1.0 - weight, weight])
        self.centres = 0.5 * distance * np.array([[-0.8, -0.6], [0.8, 0.6]])
        self.covariances = np.array([np.eye(2), np.eye(2)])
        self.precisions = self.covariances


class Modes(TwoModes):
    """Separated Gaussians of different widths, shapes and weights in any dimension; the first is narrow."""

    weight: ClassVar = {2: (0.3, 0.7), 5: (0.1, 0.3, 0.2, 0.3, 0.1)}
    sd: ClassVar = {2: (0.5, 1.1), 5: (0.5, 1.2, 0.8, 1.0, 0.6)}
    apart = 7.0

    def __init__(self, count: int, ndim: int) -> None:
        Target.__init__(self, ndim)
        rng = np.random.default_rng(10 * count + ndim)
        self.weights = np.array(self.weight[count])
        self.centres = rng.uniform(-8.0, 8.0, (count, ndim))
        while np.min(pdist(self.centres)) < self.apart:
            self.centres = rng.uniform(-8.0, 8.0, (count, ndim))
        rotation, _ = np.linalg.qr(rng.standard_normal((count, ndim, ndim)))
        spread = np.array(self.sd[count])[:, None] * rng.uniform(0.6, 1.0, (count, ndim))
        self.covariances = np.einsum("kij,kj,klj->kil", rotation, spread**2, rotation)
        self.precisions = np.linalg.inv(self.covariances)
        self.mean = self.weights @ self.centres
        away = self.centres - self.mean
        self.covariance = np.einsum("k,kij->ij", self.weights, self.covariances) + away.T * self.weights @ away
        self.log_mass = 0.5 * ndim * np.log(2.0 * np.pi)

    def value_and_slope(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return log-density and gradient."""
        pull = np.einsum("nki,kij->nkj", self.centres - x[:, None], self.precisions)
        parts = np.log(self.weights) - 0.5 * np.linalg.slogdet(self.covariances)[1]
        parts = parts - 0.5 * np.sum((self.centres - x[:, None]) * pull, axis=2)
        value = np.logaddexp.reduce(parts, axis=1)
        return value, np.sum(np.exp(parts - value[:, None])[:, :, None] * pull, axis=1)


class Flat(Target):
    """A flat likelihood: the posterior equals the prior."""

    def value_and_slope(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return log-density and gradient."""
        return np.zeros(len(x)), np.zeros(x.shape)


class Shell(Target):
    """A spherical shell with log-density −(|x| − r)²/(2 w²)."""

    radius, w = 2.0, 0.25

    def __init__(self, ndim: int) -> None:
        super().__init__(ndim)
        r = np.linspace(0.0, self.radius + 10.0 * self.w, 20_001)
        mass = np.exp(-0.5 * ((r - self.radius) / self.w) ** 2) * r ** (ndim - 1)
        self.mean = np.zeros(ndim)
        self.covariance = np.eye(ndim) * np.trapezoid(mass * r**2, r) / np.trapezoid(mass, r) / ndim
        surface = np.log(2.0) + 0.5 * ndim * np.log(np.pi) - gammaln(0.5 * ndim)
        self.log_mass = float(surface + np.log(np.trapezoid(mass, r)))

    def value_and_slope(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return log-density and gradient."""
        r = np.maximum(np.linalg.norm(x, axis=1), 1e-12)
        over = (r - self.radius) / self.w**2
        return -0.5 * over * (r - self.radius), -(over / r)[:, None] * x


class Beside(Target):
    """A product of independent densities in boxes, each with its own coordinates, in order."""

    def __init__(self, *blocks: tuple[Target, Any, Any]) -> None:
        self.blocks = [block for block, *_ in blocks]
        super().__init__(sum(block.ndim for block in self.blocks))
        each = [moments(Boxed(*block).log_prob, *_box(*block), 40) for block in blocks]
        self.mean = np.concatenate([one.mean for one in each])
        self.covariance = np.diag(np.concatenate([one.variance for one in each]))
        self.lower, self.upper = (np.concatenate(ends) for ends in zip(*(_box(*b) for b in blocks), strict=True))
        self.log_mass = sum(one.log_mass for one in each) + float(np.sum(np.log(self.upper - self.lower)))

    def value_and_slope(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return log-density and gradient."""
        ends = np.cumsum([block.ndim for block in self.blocks])[:-1]
        parts = np.split(x, ends, axis=1)
        found = [block.value_and_slope(part) for block, part in zip(self.blocks, parts, strict=True)]
        return sum(value for value, _ in found), np.concatenate([slope for _, slope in found], axis=1)


def _box(target: Target, lower: Any, upper: Any) -> tuple[FloatArray, FloatArray]:
    lower, upper = (np.broadcast_to(np.asarray(end, dtype=float), (target.ndim,)) for end in (lower, upper))
    return lower, upper


class LogNormals(Tempered):
    """Log-normal priors without an upper bound, and a flat likelihood."""

    sd = 0.5

    def __init__(self, ndim: int) -> None:
        super().__init__(np.zeros(ndim), np.full(ndim, np.inf))
        self.target = Target(ndim)
        self.target.mean = np.full(ndim, np.exp(0.5 * self.sd**2))
        self.target.covariance = np.eye(ndim) * np.exp(self.sd**2) * np.expm1(self.sd**2)
        self.target.log_mass = 0.0

    def prior(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the log-density of the prior and its gradient."""
        theta = np.maximum(theta, 1e-300)
        log = np.log(theta)
        value = -0.5 * (log / self.sd) ** 2 - log - 0.5 * np.log(2.0 * np.pi * self.sd**2)
        return np.sum(value, axis=1), -(log / self.sd**2 + 1.0) / theta

    def likelihood(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the log-likelihood and its gradient."""
        return np.zeros(len(theta)), np.zeros(theta.shape)

    def sample_prior(self, rng: np.random.Generator, n: int) -> FloatArray:
        """Return draws from the prior."""
        return np.exp(self.sd * rng.standard_normal((n, self.ndim)))


@dataclass(frozen=True)
class Known:
    """A posterior with known moments.

    Attributes
    ----------
    name : str
    kind : str
        The difficulty for a sampler.
    make : callable
        Returns the density: an updating problem or a plain log-density.
    cells : int, optional
        Number of cells of the quadrature along each coordinate; without it the target has a formula.
    box : (lower, upper), optional
        Limits of the integration; by default the bounds of the density.
    one_place : tuple of float, optional
        One of several separated maxima; chains that start there are not expected to find the others.
    """

    name: str
    kind: str
    make: Callable[[], Any]
    cells: int | None = None
    box: tuple[Any, Any] | None = None
    one_place: tuple[float, ...] | None = None

    @cached_property
    def density(self) -> Any:
        """The density to sample."""
        return self.make()

    @property
    def is_searched(self) -> bool:
        """Whether it is an updating problem, for which the search for maxima is complete."""
        return is_updating(self.density)

    @cached_property
    def truth(self) -> Moments:
        """Means, variances and log-evidence."""
        if self.cells is not None:
            return self.integrated(self.cells)
        target, density = self.density.target, self.density
        volume = np.sum(np.log(density.upper - density.lower)) if isinstance(density, Boxed) else 0.0
        return Moments(target.mean, np.diag(target.covariance), float(target.log_mass - volume))

    @cached_property
    def maxima(self) -> Maxima | None:
        """All maxima, with their shares, if the density consists of separated Gaussians; otherwise None."""
        target = getattr(self.density, "target", None)
        return None if not isinstance(target, TwoModes) else _maxima(self.density, target, self.truth.log_mass)

    def integrated(self, cells: int) -> Moments:
        """Return the moments by quadrature with `cells` cells along each coordinate."""
        lower, upper = self.box or (self.density.lower, self.density.upper)
        size = (self.density.ndim,)
        return moments(self.density.log_prob, np.broadcast_to(lower, size), np.broadcast_to(upper, size), cells)


def _maxima(density: Boxed, target: TwoModes, log_mass: float) -> Maxima:
    ndim, none = density.ndim, np.zeros(0)
    found = [
        PosteriorMaximum(
            theta=centre,
            log_prob=float(density.log_prob(centre[None])[0]),
            frequencies=none,
            starts=1,
            at_bound=np.zeros(ndim, dtype=np.int64),
            gradient=np.zeros(ndim),
            hessian=np.linalg.inv(covariance),
            curvature="exact",
            mean=centre,
            sd=np.sqrt(np.diag(covariance)),
            log_mass=log_mass + float(np.log(weight)),
            effective_draws=1e6,
            share=float(weight),
        )
        for centre, covariance, weight in zip(target.centres, target.covariances, target.weights, strict=True)
    ]
    found.sort(key=lambda one: -one.log_prob)
    names = names_of(density)
    units = ("",) * ndim
    return Maxima(tuple(found), names, units, (), density.lower, density.upper, target.centres[0], none, none)


def _uneven() -> fmu.UpdatingProblem:
    """Return Beck & Au's building with a prior that gives one of its two maxima little probability."""
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
    """Return a frame of three storeys with three measured frequencies, which several sets of stiffnesses fit."""
    names, numbers = ["k1", "k2", "k3"], (1, 2, 3)
    sensors = tuple((j, "x") for j in numbers)
    model = shear_building(names, 2e8, 1e5, dofs=sensors)
    paired = PairedStructure.of(
        model, pairing="index", numbers=numbers, sensors=sensors, reference=np.ones(3), shapes=None
    )
    lower, upper = np.full(3, 0.2), np.full(3, 5.0)
    reduced, _ = train(paired, lower, upper)
    f = frequencies_hz(model, (1.5, 1.0, 1.6))[0]
    parameters = [fmu.Parameter(name, start=1.0, lower=0.2, upper=5.0) for name in names]
    error = fmu.FrequencyErrors("relative", sd=0.04)
    return fmu.UpdatingProblem(reduced, fmu.ModalData(f, numbers), parameters, error=error)


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
"""Posteriors on which the verdicts on every sampler are tested."""


def _modes(count: int, ndim: int) -> Known:
    target = Modes(count, ndim)
    words = {2: "two", 5: "five"}[count]
    return Known(
        f"{words} modes, {ndim} parameters", "separated modes", lambda: Boxed(target, -16.0, 16.0),
        one_place=tuple(target.centres[0]),
    )  # fmt: skip


def _in_a_corner(ndim: int) -> Known:
    def make() -> Boxed:
        blocks = [(Normal([-0.2, 1.1], [0.3] * 2, 0.8), 0.0, 1.0)] * (ndim // 2)
        blocks += [(Normal([-0.2, 1.1, 0.5], [0.3] * 3, 0.8), 0.0, 1.0)] * (ndim % 2)
        if ndim % 2:
            blocks = blocks[1:]
        return Boxed(target := Beside(*blocks), target.lower, target.upper)

    return Known(f"corner, {ndim} parameters", "bounded", make)


def _banana(ndim: int) -> Known:
    def make() -> Boxed:
        thin = [(ThinBanana(), [-6.0, -4.0], [6.0, 36.0])]
        blocks = thin * (ndim // 5) + [(Normal([0.0] * 3, [1.0, 2.0, 0.5], 0.5), -12.0, 12.0)] * (ndim // 5)
        return Boxed(target := Beside(*blocks), target.lower, target.upper)

    return Known(f"banana, {ndim} parameters", "ridge", make)


FURTHER = (
    *(_modes(count, ndim) for count in (2, 5) for ndim in (2, 5, 10)),
    *(_in_a_corner(ndim) for ndim in (2, 5, 10)),
    *(_banana(ndim) for ndim in (5, 10)),
    *(
        Known(f"funnel, {ndim} parameters", "skewed", lambda ndim=ndim: Boxed(Funnel(ndim), -20.0, 20.0))
        for ndim in (5, 10)
    ),
    *(
        Known(f"shell, {ndim} parameters", "shell", lambda ndim=ndim: Boxed(Shell(ndim), -5.0, 5.0))
        for ndim in (2, 5, 10)
    ),
    *(
        Known(f"prior, uniform, {ndim} parameters", "no data", lambda ndim=ndim: Boxed(_flat(ndim), 1.0, 3.0))
        for ndim in (2, 5, 10)
    ),
    Known("prior, log-normal, 5 parameters", "no data, half-bounded", lambda: LogNormals(5)),
)
"""Further posteriors, on which only the verdicts on samplers with mixture proposals are tested."""


def _flat(ndim: int) -> Flat:
    flat = Flat(ndim)
    flat.mean, flat.covariance, flat.log_mass = np.full(ndim, 2.0), np.eye(ndim) / 3.0, ndim * np.log(2.0)
    return flat
