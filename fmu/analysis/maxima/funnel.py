"""Mixture components along the funnel-shaped posterior of a model with discrepancy.

The larger the discrepancy, the wider the posterior of the other parameters. Given the size τ of the
discrepancy, the posterior is nearly Gaussian. To first order, its covariance is (Jᵀ V(τ)⁻¹ J + prior
precision)⁻¹, where J is the Jacobian of the computed modes, and V(τ) is the covariance of their errors, including
the discrepancy. Gaussians at the highest points for many values of τ therefore cover the posterior, whereas a few
Gaussians would not.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from fmu.analysis.maxima.results import NEGLIGIBLE
from fmu.posterior.ascent import GaussNewton, ascend
from fmu.posterior.maxima import leaders
from fmu.posterior.parameters import box
from fmu.posterior.scaled import LogScaledDensity, ScaledDensity, clip_to_support
from fmu.samplers.mixture.quadratic import Quadratic, definite
from fmu.samplers.mixture.warp import Warp
from fmu.types import FloatArray

if TYPE_CHECKING:
    from fmu.analysis.maxima.results import Maxima
    from fmu.posterior.problem import UpdatingProblem

_SIZES, _VALUES = 12, 7
"""Number of sizes of the discrepancy, from none to the largest, and of values of a parameter with a plateau."""
_WIDTH = 0.8
"""Standard deviation of a component along a grid, relative to the distance between neighbouring values."""
_COARSE = 2.0
"""Largest distance between neighbouring values of a parameter, in standard deviations of the largest component."""
_MATTERS = 0.01
"""Mass of a component, relative to the largest, above which it is used."""
_FIXED, _ARRIVED = 1e12, 1e-3
"""Curvature along a coordinate that is held fixed in an ascent, and predicted gain, in nats, at which it ends."""
_FAR, _EXCESS = 2.0, 0.5
"""Distance from a Gaussian's centre, in standard deviations, at which the density is compared with the Gaussian,
and difference of their logarithms above which the density has a plateau there."""
_INSIDE = 1e-9  # of x, in which rounding may move a point out of the box
"""Largest change of x on the way to u and back at which a point counts as within the bounds."""


class _Components(NamedTuple):
    """Mixture components in the coordinates x of a warp, with the logarithms of their masses."""

    quadratics: list[Quadratic]
    log_mass: FloatArray

    @property
    def largest(self) -> Quadratic:
        """The component with the largest mass."""
        return self.quadratics[int(np.argmax(self.log_mass))]

    @property
    def share(self) -> FloatArray:
        """Fraction of the total mass in each component, shape (n,)."""
        share = np.exp(self.log_mass - self.log_mass.max())
        return np.asarray(share / share.sum())

    def drop_small(self) -> _Components:
        """Return only the components with more than 1 % of the largest component's mass."""
        kept = self.log_mass > self.log_mass.max() + np.log(_MATTERS)
        return _Components([q for q, one in zip(self.quadratics, kept, strict=True) if one], self.log_mass[kept])


def components_along(problem: UpdatingProblem, maxima: Maxima) -> tuple[list[Quadratic], FloatArray, Warp]:
    """Return mixture components along the funnel of an inferred discrepancy.

    The size of the discrepancy is the problem's last parameter. For each size on a grid, ascents from the maxima
    find the highest points with this size fixed. The component at such a point is the Gaussian of the other
    parameters given the size. Along the size, its standard deviation is 0.8 times the grid spacing. If the data
    hardly inform a parameter beyond some value, such as the stiffness of a nearly rigid spring, its density has a
    plateau that no Gaussian covers. A second grid of seven values then extends over the parameter with the highest
    plateau, provided that its spacing is at most two standard deviations of the largest component. Components with
    at most 1 % of the largest component's mass are dropped.

    Parameters
    ----------
    problem : UpdatingProblem
    maxima : Maxima
        The maxima of the problem's posterior.

    Returns
    -------
    quadratics : list of Quadratic
        The components, in scaled units.
    share : ndarray, shape (n,)
        Fraction of the total mass in each component.
    warp : Warp
        Coordinates in which the components are Gaussians.

    References
    ----------
    Neal (2003), Annals of Statistics 31, 705-767, section 8 (the funnel).
    """
    given = _Given(problem)
    size, lower, upper = problem.ndim - 1, *given.to_x(np.array(box(problem.parameters)))
    x = given.to_x(np.array([m.theta for m in maxima if m.share > NEGLIGIBLE]))
    sizes = np.linspace(lower[size], upper[size], _SIZES)
    x, width = _on_grid(x, size, sizes, np.full(problem.ndim, np.inf))
    found = given.components(x, width).drop_small()
    k = given.highest_plateau(found.largest, (upper - lower) / (_VALUES - 1) / _COARSE)
    if k >= 0:
        values = np.linspace(lower[k], upper[k], _VALUES)
        x, width = _on_grid(np.array([q.position for q in found.quadratics]), k, values, width)
        found = given.components(x, width).drop_small()
    return [given.warp.straighten(q) for q in found.quadratics], found.share, given.warp


def _on_grid(x: FloatArray, k: int, values: FloatArray, width: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Combine each point of x (n, ndim) with each value of coordinate k.

    Return the points, shape (n · n_values, ndim), and the components' widths (ndim,), in which entry k is set from
    the spacing of the values.
    """
    points, width = np.repeat(x, len(values), axis=0), width.copy()
    points[:, k] = np.tile(values, len(x))
    width[k] = _WIDTH * (values[1] - values[0])
    return points, width


class _Given:
    """The posterior of some parameters given the values of the others, near its highest points.

    Attributes
    ----------
    warp : Warp
        Coordinates x. For the size of the discrepancy, and for parameters with log-normal priors, they are
        logarithmic except close to the lower bound.
    """

    def __init__(self, problem: UpdatingProblem) -> None:
        self._problem = problem
        self._plain = clip_to_support(ScaledDensity(problem), problem)
        self._logs = clip_to_support(LogScaledDensity(problem, wide=0.0), problem)
        self._is_size = np.arange(problem.ndim) == problem.ndim - 1
        bent = self._is_size | (self._logs.is_log & np.isfinite(self._plain.lower))
        self.warp = Warp(self._plain.lower, self._plain.upper, bent)

    def to_x(self, theta: FloatArray) -> FloatArray:
        """Return the coordinates x of parameter vectors theta; both have shape (n, ndim)."""
        return self.warp.to_x(self._plain.to_scaled(theta))

    def components(self, x: FloatArray, width: FloatArray) -> _Components:
        """Return a component for each distinct point that ascents from x (n, ndim) reach.

        A coordinate whose `width` (ndim,) is finite keeps its value in the ascents, and this width is the
        component's standard deviation along it.
        """
        fixed, quadratic = np.isfinite(width), GaussNewton(self._problem, self._logs)
        crossed = fixed | fixed[:, None]

        def of_others(u: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
            value, gradient, hessian = quadratic(u)
            hessian = np.where(crossed, _FIXED * np.eye(len(fixed)), hessian)
            return value, np.where(fixed, 0.0, gradient), hessian

        lower, upper = self._logs.lower, self._logs.upper
        begun = self._logs.to_scaled(self._plain.to_theta(self.warp.to_u(x)))
        reached, _ = leaders(ascend(of_others, np.clip(begun, lower, upper), lower, upper, tolerance=_ARRIVED))
        u = self._plain.to_scaled(self._logs.to_theta(reached))
        found, log_mass = list[Quadratic](), list[float]()
        for at, value, gradient, hessian in zip(u, *GaussNewton(self._problem, self._plain)(u), strict=True):
            one = self.warp.quadratic(Quadratic(at, -float(value), -gradient, hessian))
            slope = np.where(fixed, 0.0, one.gradient)
            precision = definite(np.where(crossed, np.diag(1.0 / width**2), one.hessian))
            found.append(Quadratic(one.position, one.log_prob, slope, precision))
            peak = one.log_prob + 0.5 * slope @ np.linalg.solve(precision, slope)
            log_mass.append(peak - 0.5 * np.linalg.slogdet(precision)[1])
        return _Components(found, np.array(log_mass))

    def highest_plateau(self, component: Quadratic, least: FloatArray) -> int:
        """Return the index of the parameter with the highest plateau of the density, or −1 if there is no plateau.

        Along each parameter, the density is compared with `component` at two points, two standard deviations to
        either side of the component's centre. There the other parameters have their means given the value of this
        parameter. A point outside the bounds is skipped. The size of the discrepancy is left out, and so is a
        parameter whose standard deviation in the component is below `least` (ndim,).
        """
        covariance = np.linalg.inv(component.hessian)
        sd = np.sqrt(np.diag(covariance))
        centre = component.position + covariance @ component.gradient
        excess = np.full(len(sd), -np.inf)
        for side in (-_FAR, _FAR):
            x = centre + side * covariance / sd[:, None]
            u = self.warp.to_u(x)
            within = np.all(np.abs(self.warp.to_x(u) - x) < _INSIDE, axis=1) & (sd >= least) & ~self._is_size
            log_prob = self._plain.log_prob(u) + self.warp.log_stretch(u)
            excess = np.maximum(excess, np.where(within, log_prob - component(x), -np.inf))
        k = int(np.argmax(excess))
        return k if excess[k] > _EXCESS else -1
