"""A parameter that scatters over the tests, expressed by scores in centred or non-centred form.

The value in test t is θ_t = F⁻¹(Φ(z_t)), where z_t is the test's score and Φ the standard normal distribution
function. F is the distribution function of a normal distribution truncated to the parameter's bounds; in
log-normal populations, all this applies to log θ_t. If F is the population's own distribution, N(μ, σ²), the
scores are a priori standard normal and independent of μ and σ. This is the non-centred form of a hierarchical
model. It is easy to sample if a test says little about its own value. If F is a fixed reference distribution,
N(μ₀, σ₀²), the scores are the values themselves in other units. This is the centred form. It is easy to sample if
a test determines its own value well. A weight w per test interpolates between the two forms: F has the mean
w μ₀ + (1 − w) μ and the standard deviation σ₀^w σ^(1−w) (Papaspiliopoulos, Roberts & Sköld 2007, *Statistical
Science* 22, 59–73; Gorinova, Moore & Hoffman 2020, *ICML*, PMLR 119). The weights do not change the posterior of
the values.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Self

import numpy as np

from fmu.posterior.joint.varies.autocorrelation import InTime
from fmu.posterior.joint.varies.base import Future, InTests, Reference, Slope
from fmu.posterior.joint.varies.truncated_normal import Normals, Slopes, TruncatedFamily
from fmu.types import BoolArray, FloatArray, IntArray

_ROUNDING = 1e-12
"""Smallest distance from a bound, relative to the bound, at which a value still has a finite score."""
_FAR = 4.0
"""Half-width of the range in which a reduced model is trained, in standard deviations of the population."""


@dataclass(eq=False)
class Drawn(InTests):
    """A structural parameter that scatters over the tests.

    Attributes
    ----------
    family : TruncatedFamily
        Family of the values' distributions.
    centre : int
        Index in theta of the population's mean or median.
    widths : ndarray of int, shape (n_tests,)
        For each test, the index in theta of the population's standard deviation.
    columns : ndarray of int, shape (n_tests,)
        For each test, the index in theta of the score.
    scored : ndarray of bool, shape (n_tests,)
        Whether the test has a score. If it has none, its value is known.
    centring : ndarray, shape (n_tests,)
        The weight w in the module docstring: 0 for standard normal scores, 1 for the values in other units.
    reference : tuple of float and ndarray, shape (n_tests,)
        The reference centre μ₀, and the reference width σ₀ of each test.
    in_time : InTime, optional
        The scores as a process in time, if they are correlated in time.
    batch : PopulationBatch
        The parameters that are computed together with this one: all that scatter in the layout, or this one alone.
    """

    family: TruncatedFamily
    centre: int
    widths: IntArray
    columns: IntArray
    scored: BoolArray
    centring: FloatArray
    reference: Reference
    in_time: InTime | None = None
    batch: PopulationBatch = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self.batch = PopulationBatch([self])

    def __call__(self, theta: FloatArray) -> tuple[FloatArray, list[Slope]]:
        """Return the value in each test, (n, n_tests), and its derivatives, at theta (n, n_parameters)."""
        value, *_, slopes = self._at(theta)
        return value, self._slopes(*slopes)

    def identity(self, test: int) -> Hashable:
        """Return a key. Tests with equal keys have equal parameter values at every theta."""
        return int(self.columns[test])

    def log_prior(self, theta: FloatArray) -> tuple[FloatArray, list[Slope]]:
        """Return the log-ratio of the scores' density to the standard normal, (n, n_tests), and its derivatives.

        It is zero where the centring is zero, because the scores are then standard normal, and where there is no
        score.
        """
        return self.batch.remember(("log ratio", self.centre), theta, self._log_ratio)

    def curvature(self, theta: FloatArray) -> FloatArray:
        """Return minus the second derivative of each score's log-density, (n, n_tests). Bounds are ignored."""
        value, (_, width), (_, blend), _ = self._at(theta)
        return np.broadcast_to((blend / width) ** 2, value.shape)

    def add_curvature_in_time(self, theta: FloatArray, curvature: FloatArray, scale: FloatArray) -> None:
        """Add the mixed entries of −∇² log p for successive scores in time, in units of `scale`, to `curvature`.

        `curvature` (n, ndim, ndim) is changed in place. Nothing is added if the scores are not correlated in time.
        """
        if self.in_time is None:
            return
        slopes, order = np.sqrt(self.curvature(theta)), self.in_time.order
        rows, columns = self.columns[order[1:]], self.columns[order[:-1]]
        of_both = self.in_time.precision(theta)[1] * slopes[:, order[1:]] * slopes[:, order[:-1]]
        for one, other in ((rows, columns), (columns, rows)):
            curvature[:, one, other] += of_both * scale[rows] * scale[columns]

    def population_scores(self, theta: FloatArray) -> tuple[FloatArray, Slopes]:
        """Return the parameter's values standardised by the population, (n, n_tests), and their derivatives.

        The derivatives are with respect to the score in theta, the centre and the width, shape (n, n_tests) each.
        """
        return self.batch.remember(("scores", self.centre), theta, self._computed_scores)

    def _computed_scores(self, theta: FloatArray) -> tuple[FloatArray, Slopes]:
        if not self._is_centred:
            z = theta[:, self.columns]
            return z, (np.ones_like(z), np.zeros_like(z), np.zeros_like(z))
        value, population, _, (by_z, by_centre, by_width) = self._at(theta)
        is_other = self.centring > 0.0
        z = np.where(is_other, self.family.scores(value, *population), theta[:, self.columns])
        of_z, of_centre, of_width = self.family.values(z, *population)[1]
        with np.errstate(divide="ignore", invalid="ignore"):
            slopes = by_z / of_z, (by_centre - of_centre) / of_z, (by_width - of_width) / of_z
        plain = np.ones_like(z), np.zeros_like(z), np.zeros_like(z)
        return z, tuple(np.where(is_other, *pair) for pair in zip(slopes, plain, strict=True))  # type: ignore[return-value]

    def restore_scores(self, theta: FloatArray) -> FloatArray:
        """Return a copy of theta (n, ndim) with this parameter's non-centred scores in the present centring."""
        theta = theta.copy()
        z, (centre, width), blend, _ = self.parts(theta)
        value = self.family.values(z, centre, width)[0]
        # far scores give the bounds themselves, to rounding
        low, high = self.family.lower, self.family.upper
        value = np.clip(value, low * (1.0 + _ROUNDING * np.sign(low)), high * (1.0 - _ROUNDING * np.sign(high)))
        scores = self.family.scores(value, *blend)
        theta[:, self.columns[self.scored]] = np.where(self.centring > 0.0, scores, z)[:, self.scored]
        return theta

    def _log_ratio(self, theta: FloatArray) -> tuple[FloatArray, list[Slope]]:
        value, (centre, width), blend, (by_z, by_centre, by_width) = self._at(theta)
        ratio, one, other = self.family.log_ratio(value, (centre, width), blend)
        of_value, off = one[0] - other[0], 1.0 - self.centring
        slopes = (
            of_value * by_z,
            of_value * by_centre + one[1] - other[1] * self._by_centre(centre, blend[0]),
            of_value * by_width + one[2] - other[2] * off * blend[1] / width,
        )
        is_score = self.scored & (self.centring > 0.0)
        return np.where(is_score, ratio, 0.0), self._slopes(*(np.where(is_score, s, 0.0) for s in slopes))

    def scores_at(self, value: FloatArray, theta: FloatArray) -> FloatArray:
        """Return the scores of values (n, n_tests) in the present centring, given the population at theta."""
        return self.family.scores(value, *self.parts(theta)[2])

    @cached_property
    def _is_centred(self) -> bool:
        return bool(np.any(self.centring > 0.0))

    @cached_property
    def has_one_width(self) -> bool:
        """Whether the population has the same standard deviation in all tests."""
        return bool(np.all(self.widths == self.widths[0]))

    def parts(self, theta: FloatArray) -> tuple[FloatArray, Normals, Normals, FloatArray]:
        """Return the scores, the population, the distribution F, and ∂(centre of F)/∂(population centre).

        The last three broadcast against the scores, (n, n_tests).
        """
        centre, width = theta[:, [self.centre]], theta[:, self.widths[: 1 if self.has_one_width else None]]
        if not self._is_centred:
            return theta[:, self.columns], (centre, width), (centre, width), np.ones((1, 1))
        w = self.centring
        if self.family.of_logarithm:
            of_centre = np.exp(w * np.log(self.reference[0]) + (1.0 - w) * np.log(centre))
        else:
            of_centre = w * self.reference[0] + (1.0 - w) * centre
        of_width = np.exp(w * np.log(self.reference[1]) + (1.0 - w) * np.log(width))
        return theta[:, self.columns], (centre, width), (of_centre, of_width), self._by_centre(centre, of_centre)

    def _by_centre(self, centre: FloatArray, blend: FloatArray) -> FloatArray:
        off = 1.0 - self.centring
        return np.asarray(off * blend / centre if self.family.of_logarithm else np.broadcast_to(off, blend.shape))

    def _at(self, theta: FloatArray) -> tuple[FloatArray, Normals, Normals, Slopes]:
        """Return the values (n, n_tests), the population, the distribution F, and the values' derivatives."""
        return self.batch.values(theta)[self.batch.drawn.index(self)]

    def with_values(
        self, values: Sequence[FloatArray], parts: tuple[FloatArray, Normals, Normals, FloatArray]
    ) -> tuple[FloatArray, Normals, Normals, Slopes]:
        """Return `_at`, from `parts`, and the values with their derivatives by score, centre and width of F."""
        (value, by_z, by_centre, by_width), (_, population, blend, by) = values, parts
        if self._is_centred:
            by_centre = by_centre * by
            by_width = by_width * ((1.0 - self.centring) * blend[1] / population[1])
        return value, population, blend, (by_z, by_centre, by_width)

    def _slopes(self, by_z: FloatArray, by_centre: FloatArray, by_width: FloatArray) -> list[Slope]:
        columns = (self.columns, np.full_like(self.columns, self.centre), self.widths)
        return [Slope(*pair) for pair in zip(columns, (by_z, by_centre, by_width), strict=True)]

    def box(self, lower: FloatArray, upper: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return limits that the parameter's values rarely exceed, (n_tests,) each, for given limits of theta."""
        pairs = ((-_FAR, lower[self.centre]), (_FAR, upper[self.centre]))
        low, high = (self.family.values(np.array(z), centre, upper[self.widths])[0] for z, centre in pairs)
        return low, high

    def next_test(self, theta: FloatArray, like: int, future: Future) -> FloatArray:
        """Return the parameter's values (n,) in a further test, drawn from the population."""
        ends = theta[:, self.centre], theta[:, self.widths[like]]
        return self.family.values(future.scores[self.centre], *ends)[0]

    def after(self, n: int) -> Self:
        """Return a copy that reads its scores from theta columns shifted by `n`."""
        return replace(self, columns=self.columns + n)

    def refer_to(self, references: Mapping[int, tuple[FloatArray, Reference]]) -> Self:
        """Return a copy whose scores use another centring and reference."""
        centring, reference = references[self.centre]
        return replace(self, centring=centring, reference=reference)


class PopulationBatch:
    """Parameters that scatter over the same tests, for which the formulas of a population are evaluated at once.

    The formulas treat each number separately, so that the results do not depend on the other populations. For a
    few chains, a call takes about as long for all populations as for one. What was computed at the last theta is
    remembered, because the likelihood and the prior need the same values.

    Parameters
    ----------
    drawn : sequence of Drawn
        The parameters; all must have values in the same tests.
    """

    def __init__(self, drawn: Sequence[Drawn]) -> None:
        self._theta: FloatArray | None = None
        self._known: dict[Hashable, Any] = {}
        self.drawn, self._kinds = tuple(drawn), list[tuple[list[int], TruncatedFamily]]()
        for of_logarithm in (False, True):
            members = [k for k, one in enumerate(drawn) if one.family.of_logarithm is of_logarithm]
            bounds = np.array([[drawn[k].family.lower, drawn[k].family.upper] for k in members]).T
            if members:
                self._kinds.append((members, TruncatedFamily(of_logarithm, *bounds[..., None, None])))

    def remember(self, what: Hashable, theta: FloatArray, compute: Callable[[FloatArray], Any]) -> Any:
        """Return ``compute(theta)``, cached under the name `what` until a different theta is passed."""
        if self._theta is None or not np.array_equal(self._theta, theta):
            self._theta, self._known = theta.copy(), {}
        if what not in self._known:
            self._known[what] = compute(theta)
        return self._known[what]

    def values(self, theta: FloatArray) -> list[tuple[FloatArray, Normals, Normals, Slopes]]:
        """Return the values in the tests, the population, F and the values' derivatives, of each parameter."""
        return self.remember("values", theta, self._compute_values)

    def _compute_values(self, theta: FloatArray) -> list[tuple[FloatArray, Normals, Normals, Slopes]]:
        parts = [one.parts(theta) for one in self.drawn]

        def of_values(family: TruncatedFamily, z: FloatArray, centre: FloatArray, sd: FloatArray) -> list[Any]:
            value, slopes = family.values(z, centre, sd)
            return list(zip(value, *slopes, strict=True))

        found = self._each(of_values, [z for z, *_ in parts], [blend for _, _, blend, _ in parts])
        return [one.with_values(own, its) for one, own, its in zip(self.drawn, found, parts, strict=True)]

    def scores(self, values: Sequence[FloatArray], theta: FloatArray) -> list[FloatArray]:
        """Return each parameter's scores of its `values`, (n, n_tests) each; see `Drawn.scores_at`."""
        blends = [one.parts(theta)[2] for one in self.drawn]
        return self._each(lambda family, *of: list(family.scores(*of)), values, blends)

    def log_pdf(self, values: Sequence[FloatArray], theta: FloatArray) -> list[FloatArray]:
        """Return the log-densities of each parameter's `values` in its population, (n, n_tests) each."""
        populations = [one.parts(theta)[1] for one in self.drawn]
        return self._each(lambda family, *of: list(family.log_pdf(*of)[0]), values, populations)

    def _each(
        self,
        compute: Callable[[TruncatedFamily, FloatArray, FloatArray, FloatArray], list[Any]],
        numbers: Sequence[FloatArray],
        normals: Sequence[Normals],
    ) -> list[Any]:
        """Return the results for all parameters, in their order, computed at once for each kind of population."""
        found = dict[int, Any]()
        for members, family in self._kinds:
            columns = [numbers, *zip(*normals, strict=True)]
            stacked = (_stack([column[k] for k in members]) for column in columns)
            found.update(zip(members, compute(family, *stacked), strict=True))
        return [found[k] for k in range(len(self.drawn))]


def _stack(arrays: Sequence[FloatArray]) -> FloatArray:
    """Stack arrays along a new first axis; they are broadcast against each other if their shapes differ."""
    if len({one.shape for one in arrays}) > 1:
        arrays = np.broadcast_arrays(*arrays)
    return np.stack(arrays)
