"""Adapter that lets the search for maxima use a plain log-density."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from fmu.analysis.maxima.results import NEGLIGIBLE, Maxima
from fmu.analysis.trace.densities import has_prior, names_of, start_of, units_of
from fmu.numbers import listed, names_in_words, whole
from fmu.posterior.scaled import ScaledDensity
from fmu.progress.phases import count_solves
from fmu.samplers.trajectory import CentralDifference
from fmu.types import FloatArray, LogDensity

if TYPE_CHECKING:
    from fmu.posterior.maxima import Maximum


def _numbers(method: str, got: object, shape: tuple[int, ...]) -> FloatArray:
    """Return a density's result as floats; raise ValueError unless it is real and has the given shape."""
    array = np.asarray(got)
    if array.shape != shape or array.dtype.kind not in "fiu":
        raise ValueError(
            f"problem: {method} must take theta of shape {(shape[0], 'ndim')} and return real numbers of shape "
            f"{shape}, one row a point (got {array.dtype} of shape {array.shape})"
        )
    return array.astype(float)


@contextmanager
def _tell_where(theta: FloatArray) -> Iterator[None]:
    """Add a note to any error raised in the block, except NotImplementedError.

    The note gives the point theta (1, ndim), or the number of points.
    """
    try:
        yield
    except NotImplementedError:
        raise
    except Exception as error:
        where = f"theta = {theta[0].tolist()}" if len(theta) == 1 else f"one of {len(theta)} theta"
        error.add_note(f"The log-density raised this at {where}. Let it return -inf where it cannot be computed.")
        raise


_STEP = 1e-5
"""Step of the finite differences that replace a missing gradient, in scaled coordinates."""
_DECADES = (-1.0, 2.0)
"""Log10 range of distances between starting points and the given one, scaled, if there are neither bounds nor a
prior."""
_DISPARATE = 1e4
"""Largest ratio of a density's width to its scale, either way, that causes no doubt."""


class PlainDensity:
    """Adapts a plain log-density to the search for maxima, which expects an updating problem.

    The search avoids points at which the log-density is not finite. Evaluations are counted as solves. There are
    no modes.

    Parameters
    ----------
    density : LogDensity
        Its ``log_prob_and_grad``, ``start`` and ``sample_prior`` are used if it has them. Central differences
        replace a missing gradient.

    Attributes
    ----------
    region : str
        Description of the region from which the starting points of the search are drawn.
    is_bounded : bool
        Whether bounds or a prior limit the region in which maxima can lie.
    """

    is_hierarchical = False
    likelihood = SimpleNamespace(of_modes=False)
    parameters = ()

    def __init__(self, density: LogDensity) -> None:
        scaled = ScaledDensity(density)
        self.density = density
        self.ndim, self.offset, self.scale = density.ndim, scaled.offset, scaled.scale
        self.lower, self.upper = scaled.theta_lower, scaled.theta_upper
        self.names, self.units = names_of(density), units_of(density)
        self.data = SimpleNamespace(labels=(), frequencies_hz=np.empty(0))
        boxed = np.isfinite(self.lower) & np.isfinite(self.upper)
        middle = np.clip(self.offset + 0.5 * self.scale * boxed, self.lower, self.upper)
        start = start_of(density)
        self.start = middle if start is None else start
        self._has_gradient = self._gives_gradients()
        self.solves_per_gradient = 1 if self._has_gradient else 2 * self.ndim + 1
        self.has_prior = has_prior(density)
        self._depth = 0.0
        self.is_bounded = self.has_prior or bool(boxed.all())
        self.region = (
            "from the prior" if self.has_prior else "within the bounds" if self.is_bounded else "around its start"
        )

    def starting_points(self, starts: int, seed: int) -> FloatArray:
        """Return starting points for the ascents, shape (starts, ndim).

        The first is the density's own starting point or, without one, the middle of its bounds. A coordinate
        without two finite bounds is then at the density's `offset`, by default 0, moved into the bounds. The
        others are drawn from the prior or, without a prior, within the bounds or around the first point.
        """
        from scipy.stats import qmc

        rng, more = np.random.default_rng(seed), starts - 1
        if has_prior(self.density):
            theta = np.asarray(self.density.sample_prior(rng, max(more, 1)), dtype=float)[:more]
        elif self.is_bounded:
            unit = qmc.Sobol(self.ndim, rng=rng).random_base2(int(np.ceil(np.log2(max(starts, 2)))))[:more]
            theta = self.lower + (self.upper - self.lower) * unit
        else:
            away = rng.standard_normal((more, self.ndim)) * 10.0 ** rng.uniform(*_DECADES, (more, 1))
            theta = self.start + self.scale * away
        return np.clip(np.concatenate([self.start[None], theta]), self.lower, self.upper)

    def frequencies(self, theta: FloatArray) -> FloatArray:
        """Return an empty array in place of frequencies, shape (..., 0)."""
        return np.empty((*np.shape(theta)[:-1], 0))

    def log_prob(self, theta: ArrayLike) -> Any:
        """Return the log-density at theta (ndim,) or (n, ndim); −inf if it is not finite.

        Raise ValueError unless the density returns one real number for each theta.
        """
        points = np.atleast_2d(theta)
        count_solves(len(points))
        with _tell_where(points):
            value = _numbers("log_prob", self.density.log_prob(points), (len(points),))
        return np.where(np.isfinite(value), value, -np.inf)[() if np.ndim(theta) > 1 else 0]

    def log_prob_and_grad(self, theta: ArrayLike) -> tuple[Any, Any]:
        """Return the log-density and its gradient, either exact or by central differences.

        If either is not finite, the log-density is set below all values seen so far, and the gradient to zero.
        Raise ValueError unless the density returns real numbers of the right shapes.
        """
        points = np.atleast_2d(theta)
        if self._has_gradient:
            count_solves(len(points), with_gradients=True)
            with _tell_where(points):
                found = self.density.log_prob_and_grad(points)
            value = _numbers("log_prob_and_grad", found[0], (len(points),))
            gradient = _numbers("log_prob_and_grad", found[1], points.shape)
        else:
            scaled = ScaledDensity(self)
            differences = CentralDifference(scaled, np.ones(self.ndim), _STEP)
            slope = differences.slope(scaled.to_scaled(points), with_log_prob=True)
            value, gradient = slope.log_prob, slope.gradient / self.scale
        one = () if np.ndim(theta) > 1 else 0
        known = np.isfinite(value) & np.isfinite(gradient).all(axis=1)
        self._depth = max(self._depth, float(np.max(np.abs(value[known]), initial=0.0)))
        # only moderately below all values seen so far: after a step to −inf the next step would be tiny
        value, gradient = np.where(known, value, -2.0 * self._depth - 1.0), np.where(known[:, None], gradient, 0.0)
        return value[one], gradient[one]

    def _gives_gradients(self) -> bool:
        """Return True if the density implements a gradient, which is computed at the start to find out."""
        if not hasattr(self.density, "log_prob_and_grad"):
            return False
        try:
            with _tell_where(self.start[None]):
                self.density.log_prob_and_grad(self.start[None])
        except NotImplementedError:
            return False
        return True

    def search_in_words(self, found: Sequence[Maximum]) -> str:
        """Return a clause with the number of starting points, their region, and the number of maxima found."""
        n = len(found)
        climbed = sum(m.starts for m in found)
        return f"{climbed} starts {self.region} led to {n} {'maximum' if n == 1 else 'maxima'}"

    def doubts(self, best: Maxima, found: Sequence[Maximum], is_spent: bool) -> tuple[str, ...]:
        """Return the reasons why there may be other maxima than those found, one sentence each.

        If every important maximum was reached from at least two starting points, further starting points would
        hardly find another one (Good 1953, Biometrika 40, 237-264). If one was reached only once, there may well
        be more. Other reasons are a region without bounds or a prior, a search that ended at its limit, and
        unreliable masses of several maxima, or, without two finite bounds, a width far from `scale`.

        Parameters
        ----------
        best : Maxima
            The maxima whose mass was computed.
        found : sequence of Maximum
            All maxima that were found.
        is_spent : bool
            Whether the search stopped at its limit of evaluations.
        """
        said = self.search_in_words(found)
        once = sum(m.starts == 1 for m in best if m.share > NEGLIGIBLE)
        doubts = []
        if not self.is_bounded:
            doubts.append(f"{said}, but without bounds or a prior nothing says where others can be")
        if is_spent:
            doubts.append(f"{said} before the evaluations of the search were spent")
        if once:
            doubts.append(f"{said}, {once} of them from one start alone, so that there may be more")
        if len(found) > 1 and not best.are_weighed:
            doubts.append(f"{said}, but not how much of the probability each holds")
        widths = np.where(np.isfinite(self.upper - self.lower), 1.0, best[0].sd / self.scale)
        if len(off := np.flatnonzero(~((widths > 1.0 / _DISPARATE) & (widths < _DISPARATE)))):
            doubts.append(
                f"{names_in_words([best.names[j] for j in off])}: the widths differ from the scales in use, "
                f"{listed(self.scale[off])}, more than {whole(_DISPARATE)} times: give the density right "
                "attributes offset and scale, a typical point and a typical width"
            )
        return tuple(doubts)
