"""Mixtures of truncated Gaussians, fitted to evaluations of a log-density."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import logsumexp

from fmu.samplers.kernel import Tree
from fmu.samplers.mixture.importance import cut_largest, even_out
from fmu.samplers.mixture.quadratic import (
    Quadratic,
    coefficients,
    fit_quadratic,
    n_coefficients,
    of_moments,
    standardise,
)
from fmu.samplers.mixture.warp import Warp
from fmu.types import FloatArray

MOST = 8
"""Largest number of components of a mixture."""
GOOD, POOR = 0.9, 0.6
"""ESS per draw above which no component is split, and below which components are fitted by moments."""
WIDE, LESS_WIDE = 0.1, 0.05
"""Share of the weight of a component that goes to its wider copies, which keep the weights P/q bounded: the usual
share, and the share for a `GOOD` mixture. Hesterberg (1995), Technometrics 37, 185-194."""
_POINTS = 3
"""Number of points per coefficient needed to fit a quadratic."""
_LEAST = 1e-3
"""Fraction of the probability below which a component with too few points is dropped."""
_FAIR = 0.2
"""ESS per draw above which components of known shapes stay as they are while there are few points."""
_SURE = 6.0
"""Effective number of points per coefficient above which a fit needs no cross-validation."""
_MILDER = 0.7
"""Exponent applied to weights if a few points have nearly all the weight."""
_SWEEPS = 3
_GAIN = 0.02
_STRAIGHTER = 0.7
_FIELDS = ("position", "log_prob", "gradient", "hessian")


class Mixture:
    """A normalised mixture of Gaussians truncated at the bounds.

    Each component is one Gaussian with wider copies of itself, which share the component's weight.

    Parameters
    ----------
    quadratics : sequence of Quadratic
        Log-densities of the components, in the coordinates of `warp`.
    weights : array_like, shape (components,)
        Positive weights; they are normalised here.
    warp : Warp
    wide : float
        Fraction of each component's weight that goes to its wider copies.
    """

    def __init__(
        self, quadratics: Sequence[Quadratic], weights: FloatArray, warp: Warp, wide: float = WIDE
    ) -> None:
        self.quadratics, self.warp, self.wide = tuple(quadratics), warp, wide
        self._given = np.asarray(weights, dtype=float)
        self.weights = self._given / np.sum(self._given)
        lower, upper = warp.to_x(warp.lower), warp.to_x(warp.upper)
        proposals = [q.proposals(lower, upper) for q in self.quadratics]
        self._parts = [part for parts in proposals for part in parts]
        self._of = np.repeat(np.arange(len(proposals)), [len(parts) for parts in proposals])
        self._shares = np.concatenate(
            [
                w * np.array([1.0 - wide, *[wide / (len(parts) - 1)] * (len(parts) - 1)])
                for w, parts in zip(self.weights, proposals, strict=True)
            ]
        )

    @classmethod
    def of_arrays(cls, arrays: Tree, lower: FloatArray, upper: FloatArray) -> Mixture:
        """Restore a mixture from the result of `arrays`, truncated at `lower` and `upper`."""
        quadratics = [Quadratic(*one) for one in zip(*(arrays[name] for name in _FIELDS), strict=True)]
        covariances = [None if np.isnan(c).any() else c for c in arrays["covariance"]]
        quadratics = [replace(q, covariance=c) for q, c in zip(quadratics, covariances, strict=True)]
        warp = Warp(lower, upper, np.asarray(arrays["bent"], dtype=bool))
        return cls(quadratics, arrays["weights"], warp, float(arrays["wide"]))

    def arrays(self) -> dict[str, FloatArray]:
        """Return the arrays that define the mixture, keyed by name, most of them with one row per component.

        A component without a fitted covariance has NaN.
        """
        found = {name: np.array([vars(q)[name] for q in self.quadratics]) for name in _FIELDS}
        none = np.full(self.quadratics[0].hessian.shape, np.nan)
        found["covariance"] = np.array([none if q.covariance is None else q.covariance for q in self.quadratics])
        # weights normalised a second time would differ in their last bits
        return found | {"weights": self._given, "bent": self.warp.bent.astype(float), "wide": np.array(self.wide)}

    def settings(self) -> Tree:
        """Return the `MixtureSampler` settings that specify this mixture, keyed by name."""
        weights, bent = tuple(self.weights.tolist()), tuple(self.warp.bent.tolist())
        return {"components": self.quadratics, "weights": weights, "bent": bent, "wide": self.wide}

    @property
    def gaussians(self) -> Mixture:
        """The mixture itself, because further fits can refine it; None for a `CurvedMixture`."""
        return self

    def with_wide(self, wide: float) -> Mixture:
        """Return a copy whose wider copies take the fraction `wide` of each component's weight."""
        return Mixture(self.quadratics, self._given, self.warp, wide)

    def draw(self, rng: np.random.Generator, n: int) -> FloatArray:
        """Return `n` independent draws within the bounds, shape (n, ndim)."""
        part = rng.choice(len(self._parts), size=n, p=self._shares)
        x = np.empty((n, len(self.warp.lower)))
        for k in np.unique(part):
            x[part == k] = self._parts[k].draw(rng, int(np.sum(part == k)))
        return self.warp.to_u(x)

    def covariance_within(self, rng: np.random.Generator, n: int, warp: Warp | None = None) -> FloatArray:
        """Return the weighted mean of the components' covariances, each estimated from `n` draws.

        They are covariances of u or, if `warp` is given, of the coordinates of the warp.
        """
        total = 1e-12 * np.eye(ndim := len(self.warp.lower))
        for k, weight in enumerate(self.weights):
            u = self.warp.to_u(self._parts[int(np.argmax(self._of == k))].draw(rng, n))
            total += weight * np.cov((u if warp is None else warp.to_x(u)).T).reshape(ndim, ndim)
        return total

    def log_density(self, u: FloatArray) -> FloatArray:
        """Return the normalised log-density, shape (n,), at points u (n, ndim) within the bounds."""
        return np.asarray(logsumexp(self._by_part(self.warp.to_x(u)), axis=0)) - self.warp.log_stretch(u)

    def responsibilities(self, u: FloatArray) -> FloatArray:
        """Return the probability that each component produced each point, shape (components, n)."""
        by_part = self._by_part(self.warp.to_x(u))
        by_component = [logsumexp(by_part[self._of == k], axis=0) for k in range(len(self.quadratics))]
        return np.asarray(np.exp(by_component - logsumexp(by_part, axis=0)))

    def _by_part(self, x: FloatArray) -> FloatArray:
        shares = np.log(self._shares)
        return np.stack([s + part.log_density(x) for s, part in zip(shares, self._parts, strict=True)])


@dataclass(frozen=True, eq=False)
class Points:
    """Weighted evaluations of a log-density.

    Attributes
    ----------
    position : ndarray, shape (n, ndim)
    log_prob, weight : ndarray, shape (n,)
        Finite log-densities, and the weights with which the points represent the density.
    gradient : ndarray, shape (n, ndim), optional
        Gradients of the log-density.
    """

    position: FloatArray
    log_prob: FloatArray
    weight: FloatArray
    gradient: FloatArray | None = None

    @classmethod
    def weigh_draws(cls, position: FloatArray, log_prob: FloatArray, log_density: FloatArray) -> Points:
        """Return draws from a density q as points with importance weights P/q, the largest of them truncated.

        Draws without a finite weight are left out. If a few draws have nearly all the weight, the weights are
        raised to a power below 1. A fit to the points is then wider than P, so that the next draws cover P better.
        """
        log_w = log_prob - log_density
        ok = np.isfinite(log_w)
        log_w = cut_largest(log_w[ok])
        log_w = even_out(log_w, min(_POINTS * (position.shape[1] + 1), 0.5 * len(log_w)), _MILDER)
        return cls(position[ok], log_prob[ok], np.exp(log_w - log_w.max()))

    @property
    def effective_size(self) -> float:
        """Kish's effective number of points."""
        return float(_effective_size(self.weight))

    def every_other(self, first: int) -> Points:
        """Return every second point, starting at index `first`."""
        half = slice(first, None, 2)
        gradient = None if self.gradient is None else self.gradient[half]
        return Points(self.position[half], self.log_prob[half], self.weight[half], gradient)

    def under(self, warp: Warp) -> tuple[FloatArray, FloatArray, FloatArray | None]:
        """Return warped points x (n, ndim), log-densities in x, and gradients in x or None if there are none."""
        log_prob = self.log_prob + warp.log_stretch(self.position)
        slope = None if self.gradient is None else self.gradient * warp.stretch(self.position) + warp.bent
        return warp.to_x(self.position), log_prob, slope

    def effective_share(self, log_density: FloatArray) -> float:
        """Estimate the effective sample size per draw (Kish) of importance sampling from a density q.

        `log_density` is log q at these points, shape (n,). With r = log P − log q, the estimate is 1/(E[eʳ]
        E[e⁻ʳ]), where the expectations are over P.
        """
        r = self.log_prob - log_density
        w = np.log(np.maximum(self.weight, 1e-300) / self.weight.sum())
        return float(np.exp(-logsumexp(w + r) - logsumexp(w - r)))


def fit_mixture(points: Points, start: Mixture) -> Mixture:
    """Fit a mixture to a log-density, starting from the mixture `start`, which must already be close to it.

    1. Coordinates become logarithmic, or linear again, if this makes the log-density more nearly quadratic.
    2. In a few EM sweeps, each component's quadratic is fitted to the points, weighted by its responsibilities,
       that is the probabilities that it produced each point. Their sum is the component's weight. A component with
       too few points is kept unchanged, or is dropped if its weight is negligible.
    3. Components are split while the fit is not good and there are enough points.
    4. If the fit is still poor, as along a curved ridge, the points are divided into up to 8 groups. Gaussians
       with the groups' means and covariances become the components if they fit better.
    """
    responsibility = start.responsibilities(points.position)
    warp, wide = _choose_warp(points, responsibility, start.warp), start.wide
    before: Sequence[Quadratic] = start.quadratics
    if not np.array_equal(warp.bent, start.warp.bent):  # components use the coordinates of the warp
        before = [warp.quadratic(start.warp.straighten(one)) for one in before]
    best, share = _settle_components(points, responsibility, warp, wide, before)
    while share < GOOD and len(best.quadratics) < MOST:
        split = _split_component(points, best)
        if split is None:
            break
        candidate, reached = _settle_components(points, split[0], warp, wide, split[1])
        if reached < share + _GAIN:
            break
        best, share = candidate, reached
    if share < POOR:
        for responsibility in _halve_points(points, warp):
            candidate, reached = _settle_components(points, responsibility, warp, wide, by_moments=True)
            if reached > share + _GAIN:
                best, share = candidate, reached
    return best


def _effective_size(weight: FloatArray) -> FloatArray:
    """Return Kish's effective number of points, shape (...), for weights (..., n)."""
    of_largest = weight / np.maximum(weight.max(axis=-1, keepdims=True), 1e-300)
    return np.asarray(of_largest.sum(axis=-1) ** 2 / np.maximum(np.sum(of_largest**2, axis=-1), 1e-300))


def refit_mixture(points: Points, start: Mixture, *, is_known: bool = False) -> Mixture:
    """Fit a mixture to a log-density, or return `start` if the points are too few to trust the fit.

    A quadratic fitted to hardly more points than it has coefficients can be far off between them. If points are
    few, fits to each half must therefore suit the other half better, on average, than `start` does. If `is_known`,
    a fair `start` is kept until there are `_SURE` effective points per coefficient of all components.
    """
    n = n_coefficients(points.position.shape[1])
    is_enough = points.effective_size >= _SURE * n * len(start.quadratics)
    if is_known and not is_enough and points.effective_share(start.log_density(points.position)) > _FAIR:
        return start
    if points.effective_size < _SURE * n and _gain_elsewhere(points, start) <= 0.0:
        return start
    fit = fit_mixture(points, start)
    return start if np.isnan(fit.log_density(points.position)).any() else fit


def _gain_elsewhere(points: Points, start: Mixture) -> float:
    """Fit each half of the points; return the mean gain over `start` in ESS per draw on the other half."""
    halves = points.every_other(0), points.every_other(1)
    gain = 0.0
    for one, other in (halves, halves[::-1]):
        for mixture, sign in ((fit_mixture(one, start), 0.5), (start, -0.5)):
            gain += sign * other.effective_share(mixture.log_density(other.position))
    return gain


def _choose_warp(points: Points, responsibility: FloatArray, warp: Warp) -> Warp:
    """Return the warp with which the log-density is most nearly quadratic.

    A coordinate with a lower bound becomes logarithmic, or linear again, if this reduces the misfit by 30 %.
    With fewer than `_POINTS` points per coefficient, `warp` is returned unchanged.
    """
    weights = responsibility * points.weight
    weights = weights[_effective_size(weights) > len(warp.lower) + 1]
    if len(points.log_prob) < _POINTS * n_coefficients(len(warp.lower)):
        return warp
    least = _measure_misfit(*points.under(warp), weights)
    for k in np.flatnonzero(np.isfinite(warp.lower)):
        bent = warp.bent.copy()
        bent[k] = not bent[k]
        tried = Warp(warp.lower, warp.upper, bent)
        left = _measure_misfit(*points.under(tried), weights)
        if left < _STRAIGHTER * least:
            warp, least = tried, left
    return warp


def _measure_misfit(
    x: FloatArray, value: FloatArray, slope: FloatArray | None, weights: Iterable[FloatArray]
) -> float:
    """Return the weighted sum of squared residuals after fitting one quadratic per set of weights."""
    total = 0.0
    for w in weights:
        if w.sum() > 0:
            z, _, L = standardise(x, w)
            total += w.sum() * coefficients(z, value, w, None if slope is None else slope @ L)[1]
    return total


def _settle_components(
    points: Points,
    responsibility: FloatArray,
    warp: Warp,
    wide: float,
    before: Sequence[Quadratic | None] = (),
    *,
    by_moments: bool = False,
) -> tuple[Mixture, float]:
    """Run a few EM sweeps from responsibilities (components, n); return the best mixture and its ESS per draw.

    A component with too few points keeps its quadratic from `before`, or is dropped if its weight is negligible.
    If `by_moments` is True, components take the mean and covariance of their points instead of a fitted quadratic.
    """
    found: tuple[Mixture, float] | None = None
    x, value, slope = points.under(warp)
    needed = _POINTS * n_coefficients(x.shape[1])
    for _ in range(_SWEEPS):
        weight = responsibility * points.weight
        size = _effective_size(weight)
        before = before or [None] * len(weight)
        spanning = (size > x.shape[1] + 1) | [one is None for one in before]  # otherwise singular
        enough = spanning & (size >= min(needed, 0.5 * size.max()))
        quadratics, shares = list[Quadratic](), list[float]()
        for w, is_enough, one in zip(weight, enough, before, strict=True):
            if is_enough:
                quadratics.append(of_moments(x, w) if by_moments else fit_quadratic(x, value, w, slope))
            elif one is not None and w.sum() >= _LEAST * weight.sum():
                quadratics.append(one)
            else:
                continue
            shares.append(w.sum())
        mixture = Mixture(quadratics, np.array(shares), warp, wide)
        share = float(np.nan_to_num(points.effective_share(mixture.log_density(points.position))))
        if found is None or share > found[1]:
            found = mixture, share
        before, responsibility = quadratics, mixture.responsibilities(points.position)
        if len(quadratics) == 1 or np.isnan(responsibility).any():  # NaN where a fit has no mass within the box
            break
    assert found is not None
    return found


def _halve_points(points: Points, warp: Warp) -> list[FloatArray]:
    """Divide the points into 2, 4 and 8 groups by repeatedly halving each group across its longest axis.

    Return one array of 0/1 responsibilities, shape (groups, n), for each division. The list is shorter if there
    are too few points.
    """
    x, found = warp.to_x(points.position), list[FloatArray]()
    groups = [np.ones(len(points.weight), dtype=bool)]
    needed = 2 * _POINTS * x.shape[1]
    while len(groups) < MOST:
        halves = []
        for group in groups:
            w = np.where(group, points.weight, 0.0)
            if w.sum() ** 2 < 2 * needed * np.sum(w**2):
                return found
            mean = w @ x / w.sum()
            axis = np.linalg.eigh((w * (x - mean).T) @ (x - mean))[1][:, -1]
            side = (x - mean) @ axis > 0
            halves += [group & side, group & ~side]
        groups = halves
        found.append(np.array(groups, dtype=float))
    return found


def _split_component(points: Points, mixture: Mixture) -> tuple[FloatArray, list[Quadratic | None]] | None:
    """Split the worst component in two; return responsibilities (components + 1, n) and the list of components.

    The component is split across the principal axis for which two quadratics leave the smallest residuals. Both
    halves are None in the list, because they have no quadratic yet. Return None if the component has too few
    points.
    """
    responsibility = mixture.responsibilities(points.position)
    r = points.log_prob - mixture.log_density(points.position)
    r = r - np.average(r, weights=points.weight)
    worst = int(np.argmax(responsibility @ (points.weight * np.minimum(r**2, 25.0))))
    w = responsibility[worst] * points.weight
    needed = 2 * _POINTS * n_coefficients(points.position.shape[1])
    if w.sum() ** 2 < needed * np.sum(w**2):
        return None
    x, value, slope = points.under(mixture.warp)
    z, _, L = standardise(x, w)
    _, _, axes = np.linalg.svd(L)  # L = U S Vᵀ: the columns of V are the principal axes of x, expressed in z
    best, least = None, np.inf
    for axis in axes:
        side = 1.0 / (1.0 + np.exp(-4.0 * np.clip(z @ axis, -50, 50)))
        left = _measure_misfit(x, value, slope, (w * side, w * (1.0 - side)))
        if left < least:
            parts = [responsibility[worst] * side, responsibility[worst] * (1.0 - side)]
            best, least = np.concatenate([np.delete(responsibility, worst, axis=0), parts]), left
    if best is None:
        return None
    return best, [*(q for k, q in enumerate(mixture.quadratics) if k != worst), None, None]
