"""A parameter of the structure in every test: taken from theta, drawn from a population, lost, or with a trend."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, Self

import numpy as np

from fmu.posterior.joint.population import Normals, Population, Slopes
from fmu.posterior.parameters import Parameter
from fmu.types import BoolArray, FloatArray, IntArray

_FAR = 4.0
"""Standard deviations of a population about its mean within which a reduced model is trained."""


class Slope(NamedTuple):
    """The derivative of a value in every test by one parameter of each.

    Attributes
    ----------
    columns : ndarray of int, shape (n_tests,)
        The parameter, by its number in theta.
    values : ndarray, shape (n, n_tests)
    """

    columns: IntArray
    values: FloatArray


class InTests:
    """A parameter of the structure in every test, as a function of theta."""

    @property
    def base(self) -> InTests:
        """The parameter without trends: itself, unless it has some."""
        return self

    @property
    def populations(self) -> tuple[Drawn, ...]:
        """The population that the values scatter about, if there is one."""
        return ()

    def __call__(self, theta: FloatArray) -> tuple[FloatArray, list[Slope]]:
        """Return the values in every test, shape (n, n_tests), and their derivatives."""
        raise NotImplementedError

    def identity(self, test: int) -> Hashable:
        """Return an object that is equal in two tests if the value always is."""
        raise NotImplementedError

    def box(self, lower: FloatArray, upper: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return limits of the values in every test, for limits of theta (n_parameters,)."""
        raise NotImplementedError

    def next_test(self, theta: FloatArray, like: int, future: Future) -> FloatArray:
        """Return the values (n,) in one more test that resembles test `like`."""
        return self(theta)[0][:, like]

    def refer_to(self, references: Mapping[int, tuple[FloatArray, tuple[float, float]]]) -> InTests:
        """Return the parameter with scores that refer to others; itself if it has no scores.

        `references` has centring and reference, see `Drawn`, by the number of the centre.
        """
        return self


class Future(NamedTuple):
    """The conditions of one more test.

    Attributes
    ----------
    rng : Generator
    scores : mapping of int to ndarray, shape (n,)
        Standard normal scores of each population, by the number of its centre in theta.
    covariates : mapping of str to float
        Where they are not at their means over the tests.
    """

    rng: np.random.Generator
    scores: Mapping[int, FloatArray]
    covariates: Mapping[str, float]


@dataclass(frozen=True)
class Taken(InTests):
    """A parameter of the structure that is one of theta in each test.

    Attributes
    ----------
    columns : ndarray of int, shape (n_tests,)
    own : Parameter or None
        Where each test has a value of its own: the parameter, whose prior a further test draws from.
    """

    columns: IntArray
    own: Parameter | None = None

    def __call__(self, theta: FloatArray) -> tuple[FloatArray, list[Slope]]:
        """Return the values in every test, shape (n, n_tests), and their derivatives."""
        return theta[:, self.columns], [Slope(self.columns, np.ones((len(theta), len(self.columns))))]

    def identity(self, test: int) -> Hashable:
        """Return an object that is equal in two tests if the value always is."""
        return int(self.columns[test])

    def box(self, lower: FloatArray, upper: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return limits of the values in every test, for limits of theta (n_parameters,)."""
        return lower[self.columns], upper[self.columns]

    def next_test(self, theta: FloatArray, like: int, future: Future) -> FloatArray:
        """Return the values (n,) in one more test."""
        if self.own is None:
            return super().next_test(theta, like, future)
        return self.own.prior.draw(future.rng, len(theta), self.own.lower, self.own.upper)


class LastTheta:
    """Quantities at the last theta that they were computed at, which several callers need."""

    def __init__(self) -> None:
        self._theta: FloatArray | None = None
        self._known: dict[str, Any] = {}

    def remember(self, what: str, theta: FloatArray, compute: Callable[[FloatArray], Any]) -> Any:
        """Return ``compute(theta)``, which is kept until there is another theta."""
        if self._theta is None or not np.array_equal(self._theta, theta):
            self._theta, self._known = theta.copy(), {}
        if what not in self._known:
            self._known[what] = compute(theta)
        return self._known[what]


@dataclass(eq=False)
class Drawn(InTests):
    """A parameter of the structure that scatters over the tests.

    Attributes
    ----------
    population : Population
    centre, width : int
        Numbers in theta of mean and standard deviation.
    columns : ndarray of int, shape (n_tests,)
        The scores.
    scored : ndarray of bool, shape (n_tests,)
        Which tests have one; in the others the value is known.
    lower, upper : float
        Bounds of the values.
    centring : ndarray, shape (n_tests,)
        w of `fmu.posterior.joint.population`: 0 for standard normal scores, 1 for the values in other units.
    reference : tuple of float
        Centre and width, μ₀ and σ₀.
    last : LastTheta
        Remembers the values at the last theta: likelihood and prior both need them.
    """

    population: Population
    centre: int
    width: int
    columns: IntArray
    scored: BoolArray
    lower: float
    upper: float
    centring: FloatArray
    reference: tuple[float, float]
    last: LastTheta = field(default_factory=LastTheta, init=False, repr=False)

    @property
    def populations(self) -> tuple[Drawn, ...]:
        """The population itself."""
        return (self,)

    def __call__(self, theta: FloatArray) -> tuple[FloatArray, list[Slope]]:
        """Return the values in every test, shape (n, n_tests), and their derivatives."""
        return self.last.remember("evaluated", theta, self._compute)[0]

    def identity(self, test: int) -> Hashable:
        """Return an object that is equal in two tests if the value always is."""
        return int(self.columns[test])

    def log_prior(self, theta: FloatArray) -> tuple[FloatArray, list[Slope]]:
        """Return the log-density of the scores over the standard normal density, (n, n_tests), and derivatives.

        It is zero where the centring is: the scores are then standard normal.
        """
        return self.last.remember("evaluated", theta, self._compute)[1]

    def curvature(self, theta: FloatArray) -> FloatArray:
        """Return −∂² of the scores' log-density by each of them, shape (n, n_tests), where bounds are far away."""
        _, (_, width), (_, blend), _ = self._at(theta)
        return np.asarray((blend / width) ** 2)

    def population_scores(self, theta: FloatArray) -> tuple[FloatArray, Slopes]:
        """Return the scores in the population, (n, n_tests), and their derivatives by score, centre and width."""
        return self.last.remember("scores", theta, self._computed_scores)

    def _computed_scores(self, theta: FloatArray) -> tuple[FloatArray, Slopes]:
        value, population, _, (by_z, by_centre, by_width) = self._at(theta)
        bounds, is_other = (self.lower, self.upper), self.centring > 0.0
        z = np.where(is_other, self.population.scores(value, *population, *bounds), theta[:, self.columns])
        of_z, of_centre, of_width = self.population.values(z, *population, *bounds)[1]
        with np.errstate(divide="ignore", invalid="ignore"):
            slopes = by_z / of_z, (by_centre - of_centre) / of_z, (by_width - of_width) / of_z
        plain = np.ones_like(z), np.zeros_like(z), np.zeros_like(z)
        return z, tuple(np.where(is_other, *pair) for pair in zip(slopes, plain, strict=True))  # type: ignore[return-value]

    def drawn(self, theta: FloatArray) -> FloatArray:
        """Return theta with its standard normal scores replaced by the scores of draws from the population."""
        theta = theta.copy()
        z, (centre, width), blend, _ = self._parts(theta)
        value = self.population.values(z, centre, width, self.lower, self.upper)[0]
        scores = self.population.scores(value, *blend, self.lower, self.upper)
        theta[:, self.columns[self.scored]] = np.where(self.centring > 0.0, scores, z)[:, self.scored]
        return theta

    def _compute(self, theta: FloatArray) -> Any:
        value, (centre, width), blend, (by_z, by_centre, by_width) = self._at(theta)
        bounds = self.lower, self.upper
        ratio, one, other = self.population.log_ratio(value, (centre, width), blend, *bounds)
        of_value, off = one[0] - other[0], 1.0 - self.centring
        slopes = (
            of_value * by_z,
            of_value * by_centre + one[1] - other[1] * self._by_centre(centre, blend[0]),
            of_value * by_width + one[2] - other[2] * off * blend[1] / width,
        )
        is_score = self.scored & (self.centring > 0.0)
        prior = np.where(is_score, ratio, 0.0), self._slopes(*(np.where(is_score, s, 0.0) for s in slopes))
        return (value, self._slopes(by_z, by_centre, by_width)), prior

    def scores_of(self, value: FloatArray, theta: FloatArray) -> FloatArray:
        """Return the scores that give these values in the tests that have any, at one theta (ndim,)."""
        centre, width = (part[0, self.scored] for part in self._parts(theta[None])[2])
        return self.population.scores(value, centre, width, self.lower, self.upper)

    def _parts(self, theta: FloatArray) -> tuple[FloatArray, Normals, Normals, FloatArray]:
        """Return the scores, the population, their reference, and ∂ of its centre by the population's."""
        n_tests = len(self.columns)
        centre, width = (theta[:, [k] * n_tests] for k in (self.centre, self.width))
        w = self.centring
        if self.population.of_logarithm:
            of_centre = np.exp(w * np.log(self.reference[0]) + (1.0 - w) * np.log(centre))
        else:
            of_centre = w * self.reference[0] + (1.0 - w) * centre
        of_width = np.exp(w * np.log(self.reference[1]) + (1.0 - w) * np.log(width))
        return theta[:, self.columns], (centre, width), (of_centre, of_width), self._by_centre(centre, of_centre)

    def _by_centre(self, centre: FloatArray, blend: FloatArray) -> FloatArray:
        off = 1.0 - self.centring
        return np.asarray(
            off * blend / centre if self.population.of_logarithm else np.broadcast_to(off, blend.shape)
        )

    def _at(self, theta: FloatArray) -> tuple[FloatArray, Normals, Normals, Slopes]:
        """Return the values, the population, what the scores refer to, and the values' derivatives."""
        found: tuple[FloatArray, Normals, Normals, Slopes] = self.last.remember("values", theta, self._at_scores)
        return found

    def _at_scores(self, theta: FloatArray) -> tuple[FloatArray, Normals, Normals, Slopes]:
        z, population, blend, by = self._parts(theta)
        value, (by_z, by_centre, by_width) = self.population.values(z, *blend, self.lower, self.upper)
        by_sd = (1.0 - self.centring) * blend[1] / population[1]
        return value, population, blend, (by_z, by_centre * by, by_width * by_sd)

    def _slopes(self, by_z: FloatArray, by_centre: FloatArray, by_width: FloatArray) -> list[Slope]:
        columns = (self.columns, np.full_like(self.columns, self.centre), np.full_like(self.columns, self.width))
        return [Slope(*pair) for pair in zip(columns, (by_z, by_centre, by_width), strict=True)]

    def box(self, lower: FloatArray, upper: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return limits of the values in every test, for limits of theta (n_parameters,)."""
        z, width, ends = np.array([-_FAR, _FAR]), upper[self.width], [lower[self.centre], upper[self.centre]]
        found = self.population.values(z, np.array(ends), width, self.lower, self.upper)[0]
        return tuple(np.full(len(self.columns), value) for value in found)  # type: ignore[return-value]

    def next_test(self, theta: FloatArray, like: int, future: Future) -> FloatArray:
        """Return the values (n,) in one more test, drawn from the population."""
        ends = theta[:, self.centre], theta[:, self.width]
        return self.population.values(future.scores[self.centre], *ends, self.lower, self.upper)[0]

    def refer_to(self, references: Mapping[int, tuple[FloatArray, tuple[float, float]]]) -> Self:
        """Return the parameter with scores that refer to others."""
        centring, reference = references[self.centre]
        return replace(self, centring=centring, reference=reference)


@dataclass(frozen=True)
class Lost(InTests):
    """A parameter of the structure that later states have lost a share of: θ = θ₀ (1 − d).

    Attributes
    ----------
    column : int
        Number in theta of θ₀, the value in the reference.
    losses : ndarray of int, shape (n_tests,)
        Numbers in theta of d in every test.
    is_lost : ndarray of bool, shape (n_tests,)
        False in the reference.
    """

    column: int
    losses: IntArray
    is_lost: BoolArray

    def __call__(self, theta: FloatArray) -> tuple[FloatArray, list[Slope]]:
        """Return the values in every test, shape (n, n_tests), and their derivatives."""
        loss = np.where(self.is_lost, theta[:, self.losses], 0.0)
        columns = np.full_like(self.losses, self.column)
        base = theta[:, columns]
        by_loss = np.where(self.is_lost, -base, 0.0)
        return base * (1.0 - loss), [Slope(columns, 1.0 - loss), Slope(self.losses, by_loss)]

    def identity(self, test: int) -> Hashable:
        """Return an object that is equal in two tests if the value always is."""
        return int(self.losses[test])

    def box(self, lower: FloatArray, upper: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return limits of the values in every test, for limits of theta (n_parameters,)."""
        ends = np.array([lower[self.column], upper[self.column]])
        kept = np.where(self.is_lost, 1.0 - np.stack([lower[self.losses], upper[self.losses]]), 1.0)
        corners = ends[:, None, None] * kept
        return corners.min(axis=(0, 1)), corners.max(axis=(0, 1))


@dataclass(frozen=True)
class Trend(InTests):
    """A parameter of the structure that depends on covariates too: θ = θ₀ Π (1 + b (x − x₀)).

    Attributes
    ----------
    of : Taken, Drawn or Lost
        θ₀, the value where every covariate is at its mean over the tests.
    columns : tuple of int
        Number in theta of the relative slope b of each covariate.
    covariates : ndarray, shape (n_covariates, n_tests)
        x − x₀.
    names : tuple of str
    means : tuple of float
        x₀ of each.
    """

    of: InTests
    columns: tuple[int, ...]
    covariates: FloatArray
    names: tuple[str, ...]
    means: tuple[float, ...]

    @property
    def base(self) -> InTests:
        """The parameter where every covariate is at its mean over the tests."""
        return self.of

    @property
    def populations(self) -> tuple[Drawn, ...]:
        """The population of the parameter without its trends."""
        return self.of.populations

    def __call__(self, theta: FloatArray) -> tuple[FloatArray, list[Slope]]:
        """Return the values in every test, shape (n, n_tests), and their derivatives."""
        value, slopes = self.of(theta)
        factors = 1.0 + theta[:, self.columns, None] * self.covariates
        product = np.prod(factors, axis=1)
        found = [Slope(slope.columns, slope.values * product) for slope in slopes]
        for k, column in enumerate(self.columns):
            others = np.prod(np.delete(factors, k, axis=1), axis=1)
            columns = np.full(self.covariates.shape[1], column)
            found.append(Slope(columns, value * self.covariates[k] * others))
        return value * product, found

    def identity(self, test: int) -> Hashable:
        """Return an object that is equal in two tests if the value always is."""
        return self.of.identity(test), *self.covariates[:, test].tolist()

    def box(self, lower: FloatArray, upper: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return limits of the values in every test, for limits of theta (n_parameters,)."""
        low, high = self.of.box(lower, upper)
        for k, x in zip(self.columns, self.covariates, strict=True):
            factors = 1.0 + np.stack([lower[k] * x, upper[k] * x])
            corners = np.stack([end * factor for end in (low, high) for factor in factors])
            low, high = corners.min(axis=0), corners.max(axis=0)
        return low, high

    def next_test(self, theta: FloatArray, like: int, future: Future) -> FloatArray:
        """Return the values (n,) in one more test."""
        value = self.of.next_test(theta, like, future)
        for name, mean, column in zip(self.names, self.means, self.columns, strict=True):
            value = value * (1.0 + theta[:, column] * (future.covariates.get(name, mean) - mean))
        return value

    def refer_to(self, references: Mapping[int, tuple[FloatArray, tuple[float, float]]]) -> Self:
        """Return the parameter with scores that refer to others."""
        return replace(self, of=self.of.refer_to(references))
