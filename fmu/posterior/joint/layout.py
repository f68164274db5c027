"""From the parameters of all tests together to the parameters of the structure in each test."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from fmu.posterior.joint.correlation import Correlation, correlations
from fmu.posterior.joint.damage import Damage
from fmu.posterior.joint.modal_test import Test
from fmu.posterior.joint.population import Normals, Population, Slopes
from fmu.posterior.parameters import Parameter, box
from fmu.posterior.priors.base import Normal, Prior
from fmu.types import BoolArray, FloatArray, IntArray

SHARED, BY_TEST, BY_GROUP = "shared", "test", "group"
VARIES = (SHARED, BY_TEST, BY_GROUP)
_FAR = 4.0
"""Standard deviations of a population about its mean within which a reduced model is trained."""


class Role(NamedTuple):
    """What a parameter of theta is for.

    Attributes
    ----------
    kind : {"shared", "test", "group", "mean", "sd", "score", "loss", "slope", "correlation"}
        The value in all tests, in one, or in a group of them; mean or standard deviation of a population, or a
        test's score in it; a share that a group has lost; a slope by a covariate.
    of : int or None
        The parameter of the structure, by its number in ``layout.structural``; None for correlations.
    where : str
        The test, group or covariate that it is of; else empty.
    """

    kind: str
    of: int | None
    where: str = ""


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


@dataclass(frozen=True)
class Taken:
    """A parameter of the structure that is one of theta in each test.

    Attributes
    ----------
    columns : ndarray of int, shape (n_tests,)
    """

    columns: IntArray

    def __call__(self, theta: FloatArray) -> tuple[FloatArray, list[Slope]]:
        """Return the values in every test, shape (n, n_tests), and their derivatives."""
        return theta[:, self.columns], [Slope(self.columns, np.ones((len(theta), len(self.columns))))]

    def identity(self, test: int) -> Any:
        """Return an object that is equal in two tests if the value always is."""
        return int(self.columns[test])

    def box(self, lower: FloatArray, upper: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return limits of the values in every test, for limits of theta (n_parameters,)."""
        return lower[self.columns], upper[self.columns]


@dataclass(frozen=True)
class Drawn:
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
    _last: dict[str, Any] = field(default_factory=dict, init=False, repr=False)

    def __call__(self, theta: FloatArray) -> tuple[FloatArray, list[Slope]]:
        """Return the values in every test, shape (n, n_tests), and their derivatives."""
        return self._remember("evaluated", theta, self._compute)[0]

    def identity(self, test: int) -> Any:
        """Return an object that is equal in two tests if the value always is."""
        return int(self.columns[test])

    def log_prior(self, theta: FloatArray) -> tuple[FloatArray, list[Slope]]:
        """Return the log-density of the scores over the standard normal density, (n, n_tests), and derivatives.

        It is zero where the centring is: the scores are then standard normal.
        """
        return self._remember("evaluated", theta, self._compute)[1]

    def curvature(self, theta: FloatArray) -> FloatArray:
        """Return −∂² of the scores' log-density by each of them, shape (n, n_tests), where bounds are far away."""
        _, (_, width), (_, blend), _ = self._at(theta)
        return np.asarray((blend / width) ** 2)

    def population_scores(self, theta: FloatArray) -> tuple[FloatArray, Slopes]:
        """Return the scores in the population, (n, n_tests), and their derivatives by score, centre and width."""
        return self._remember("scores", theta, self._computed_scores)

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

    def _remember(self, what: str, theta: FloatArray, compute: Callable[[FloatArray], Any]) -> Any:
        """Return `compute` of theta, which is kept until there is another theta."""
        if not np.array_equal(self._last.get("theta", ()), theta):
            self._last.clear()
            self._last["theta"] = theta.copy()
        if what not in self._last:
            self._last[what] = compute(theta)
        return self._last[what]

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
        found: tuple[FloatArray, Normals, Normals, Slopes] = self._remember("values", theta, self._at_scores)
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


@dataclass(frozen=True)
class Lost:
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

    def identity(self, test: int) -> Any:
        """Return an object that is equal in two tests if the value always is."""
        return int(self.losses[test])

    def box(self, lower: FloatArray, upper: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return limits of the values in every test, for limits of theta (n_parameters,)."""
        ends = np.array([lower[self.column], upper[self.column]])
        kept = np.where(self.is_lost, 1.0 - np.stack([lower[self.losses], upper[self.losses]]), 1.0)
        corners = ends[:, None, None] * kept
        return corners.min(axis=(0, 1)), corners.max(axis=(0, 1))


@dataclass(frozen=True)
class Trend:
    """A parameter of the structure that depends on covariates too: θ = θ₀ Π (1 + b (x − x₀)).

    Attributes
    ----------
    base : Taken, Drawn or Lost
        θ₀, the value where every covariate is at its mean over the tests.
    columns : tuple of int
        Number in theta of the relative slope b of each covariate.
    covariates : ndarray, shape (n_covariates, n_tests)
        x − x₀.
    names : tuple of str
    means : tuple of float
        x₀ of each.
    """

    base: Taken | Drawn | Lost
    columns: tuple[int, ...]
    covariates: FloatArray
    names: tuple[str, ...]
    means: tuple[float, ...]

    def __call__(self, theta: FloatArray) -> tuple[FloatArray, list[Slope]]:
        """Return the values in every test, shape (n, n_tests), and their derivatives."""
        value, slopes = self.base(theta)
        factors = 1.0 + theta[:, self.columns, None] * self.covariates
        product = np.prod(factors, axis=1)
        found = [Slope(slope.columns, slope.values * product) for slope in slopes]
        for k, column in enumerate(self.columns):
            others = np.prod(np.delete(factors, k, axis=1), axis=1)
            columns = np.full(self.covariates.shape[1], column)
            found.append(Slope(columns, value * self.covariates[k] * others))
        return value * product, found

    def identity(self, test: int) -> Any:
        """Return an object that is equal in two tests if the value always is."""
        return self.base.identity(test), *self.covariates[:, test].tolist()

    def box(self, lower: FloatArray, upper: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return limits of the values in every test, for limits of theta (n_parameters,)."""
        low, high = self.base.box(lower, upper)
        for k, x in zip(self.columns, self.covariates, strict=True):
            factors = 1.0 + np.stack([lower[k] * x, upper[k] * x])
            corners = np.stack([end * factor for end in (low, high) for factor in factors])
            low, high = corners.min(axis=0), corners.max(axis=0)
        return low, high


@dataclass(frozen=True)
class Layout:
    """The parameters of all tests together, and their meaning for each test.

    Attributes
    ----------
    structural : tuple of Parameter
        Those of the structure, as in a single test.
    parameters : tuple of Parameter
        What is inferred: shared parameters, those of each test or group, means, standard deviations and slopes;
        then the scores.
    tests : tuple of str
        Names.
    values_of : tuple of Taken, Drawn, Lost or Trend
        One per parameter of the structure.
    populations : mapping of str to Population
        By the name of the parameter.
    by_test : tuple of str
        Parameters that have a value of their own in each test, without a population.
    by_state : tuple of str
        Parameters that have a value of their own in each group of tests.
    correlation : Correlation, optional
        Of the populations; they are independent without one.
    roles : tuple of Role
        What each of `parameters` is for.
    """

    structural: tuple[Parameter, ...]
    parameters: tuple[Parameter, ...]
    tests: tuple[str, ...]
    values_of: tuple[Taken | Drawn | Lost | Trend, ...]
    populations: Mapping[str, Population] = field(default_factory=dict)
    by_test: tuple[str, ...] = ()
    by_state: tuple[str, ...] = ()
    correlation: Correlation | None = None
    roles: tuple[Role, ...] = ()

    @classmethod
    def of(
        cls,
        structural: Sequence[Parameter],
        tests: Sequence[Test],
        varies: Mapping[str, str | Population | Damage],
        slopes: Mapping[str, Mapping[str, Prior]],
        reference: str = "",
        eta: float | None = None,
    ) -> Layout:
        """Return the layout; what the arguments mean is told in `fmu.JointProblem`, which has checked them."""
        main: list[Parameter] = []
        scores: list[Parameter] = []
        pending: list[Any] = []
        roles: list[Role] = []
        of_scores: list[Role] = []

        def add(parameter: Parameter, kind: str, of: int | None, where: str = "") -> int:
            main.append(parameter)
            roles.append(Role(kind, of, where))
            return len(main) - 1

        for j, p in enumerate(structural):
            how = varies.get(p.name, SHARED)
            here = [t for t, test in enumerate(tests) if p.name not in test.known]
            columns = np.zeros(len(tests), dtype=np.int64)
            base: Any
            if isinstance(how, Population):
                mean, sd = how.parameters(p)
                centre, width = add(mean, "mean", j), add(sd, "sd", j)
                columns[here] = len(scores) + np.arange(len(here))
                for t in here:
                    scores.append(Parameter(f"{p.name} score [{tests[t].name}]", 0.0, prior=Normal(1.0)))
                    of_scores.append(Role("score", j, tests[t].name))
                scored, start = np.isin(range(len(tests)), here), (main[centre].start, main[width].start)
                base = Drawn(how, centre, width, columns, scored, p.lower, p.upper, np.zeros(len(tests)), start)
            elif isinstance(how, Damage):
                base = _lose(p, how, tests, reference, partial(add, of=j))
            else:
                places = [_place_of(how, test) for test in tests]
                number = {
                    place: add(_rename(p, f"{p.name} [{place}]" if how != SHARED else p.name), how, j, place)
                    for place in dict.fromkeys(places[t] for t in here)
                }
                columns[here] = [number[places[t]] for t in here]
                base = Taken(columns)
            of_slopes, away, means = [], [], []
            for covariate, prior in slopes.get(p.name, {}).items():
                x = np.array([test.covariates[covariate] for test in tests])
                away.append(x - x.mean())
                means.append(float(x.mean()))
                at = float(np.clip(0.0, *prior.support))
                of_slope = Parameter(f"{p.name} per {covariate}", at, prior=prior)
                of_slopes.append(add(of_slope, "slope", j, covariate))
            trend = (tuple(of_slopes), np.array(away), tuple(slopes.get(p.name, {})), tuple(means))
            pending.append((base, trend))

        correlation = None
        if eta is not None:
            of_both = correlations([name for name, _ in find_populations(structural, varies)], eta)
            correlation = Correlation(
                tuple(add(parameter, "correlation", None) for parameter in of_both),
                np.stack([base.scored for base, _ in pending if isinstance(base, Drawn)], axis=1),
            )
        values_of = []
        for base, trend in pending:
            if isinstance(base, Drawn):  # the scores follow all others
                base = replace(base, columns=base.columns + len(main))
            values_of.append(Trend(base, *trend) if trend[0] else base)
        return cls(
            tuple(structural),
            (*main, *scores),
            tuple(test.name for test in tests),
            tuple(values_of),
            dict(find_populations(structural, varies)),
            tuple(name for name, how in varies.items() if how == BY_TEST),
            tuple(
                p.name
                for p in structural
                if varies.get(p.name) == BY_GROUP or isinstance(varies.get(p.name), Damage)
            ),
            correlation,
            (*roles, *of_scores),
        )

    def losses(self, theta: FloatArray, reference: IntArray, later: IntArray) -> FloatArray:
        """Return 1 − θ/θ_reference of the parameters of `by_state`, shape (n, n_later, n_by_state).

        Without what covariates do.

        Parameters
        ----------
        theta : ndarray, shape (n, n_parameters)
        reference, later : ndarray of int, shape (n_later,)
            A test of either state.
        """
        found = []
        for parameter, value_of in zip(self.structural, self.values_of, strict=True):
            if parameter.name in self.by_state:
                value = (value_of.base if isinstance(value_of, Trend) else value_of)(theta)[0]
                found.append(1.0 - value[:, later] / value[:, reference])
        return np.stack(found, axis=2)

    @property
    def drawn(self) -> list[Drawn]:
        """The parameters that scatter over the tests."""
        bases = (one.base if isinstance(one, Trend) else one for one in self.values_of)
        return [base for base in bases if isinstance(base, Drawn)]

    @property
    def scales(self) -> list[int]:
        """Numbers in theta of what tells how others scatter: of populations and their correlations."""
        found = [k for one in self.drawn for k in (one.centre, one.width)]
        return sorted([*found, *(self.correlation.columns if self.correlation else ())])

    @property
    def n_tests(self) -> int:
        """Number of tests."""
        return len(self.tests)

    def values(self, theta: FloatArray) -> FloatArray:
        """Return the parameters of the structure, shape (n, n_tests, n_structural), at theta (n, n_parameters).

        Without meaning where a parameter is known in a test.
        """
        return np.stack([value_of(theta)[0] for value_of in self.values_of], axis=2)

    def distinct(self, tests: Sequence[int], parameters: Sequence[int]) -> tuple[IntArray, IntArray]:
        """Return the first of the tests that always have the same values of these parameters of the structure.

        Parameters
        ----------
        tests, parameters : sequence of int
            No parameter is known in one of the tests.

        Returns
        -------
        first : ndarray of int, shape (n_distinct,)
            Tests with different values.
        row : ndarray of int, shape (len(tests),)
            The row of `first` with the values of each test.
        """
        numbers: dict[Any, int] = {}
        identities = (tuple(self.values_of[j].identity(t) for j in parameters) for t in tests)
        row = np.array([numbers.setdefault(one, len(numbers)) for one in identities])
        return np.array(tests)[np.unique(row, return_index=True)[1]], row

    def of_next_test(
        self, theta: FloatArray, rng: np.random.Generator, like: int, covariates: Mapping[str, float]
    ) -> FloatArray:
        """Return the structure's parameters in one more test, drawn from what varies, shape (n, n_structural).

        Parameters
        ----------
        theta : ndarray, shape (n, n_parameters)
        rng : Generator
        like : int
            The test whose group it belongs to.
        covariates : mapping of str to float
            Where they are not at their means over the tests.
        """
        found, scores = [], iter(np.moveaxis(self.draw_scores(theta, rng, 1), 2, 0)[:, :, 0])
        for parameter, value_of in zip(self.structural, self.values_of, strict=True):
            base = value_of.base if isinstance(value_of, Trend) else value_of
            if isinstance(base, Drawn):
                z = next(scores)
                ends = theta[:, base.centre], theta[:, base.width]
                value = base.population.values(z, *ends, base.lower, base.upper)[0]
            elif parameter.name in self.by_test:
                value = parameter.prior.draw(rng, len(theta), parameter.lower, parameter.upper)
            else:
                value = base(theta)[0][:, like]
            if isinstance(value_of, Trend):
                for name, mean, column in zip(value_of.names, value_of.means, value_of.columns, strict=True):
                    value = value * (1.0 + theta[:, column] * (covariates.get(name, mean) - mean))
            found.append(value)
        return np.stack(found, axis=1)

    def draw_scores(self, theta: FloatArray, rng: np.random.Generator, n_tests: int) -> FloatArray:
        """Return draws of the scores of every population, shape (n, n_tests, n_populations)."""
        z = rng.standard_normal((len(theta), n_tests, len(self.drawn)))
        return z if self.correlation is None else np.einsum("nij,ntj->nti", self.correlation.factor(theta), z)

    def box(self) -> tuple[FloatArray, FloatArray]:
        """Return limits within which the values lie as a rule, shape (n_tests, n_structural) each."""
        ends = [value_of.box(*box(self.parameters)) for value_of in self.values_of]
        return tuple(np.stack(end, axis=1) for end in zip(*ends, strict=True))  # type: ignore[return-value]

    def chain_slopes(self, theta: FloatArray, slopes: FloatArray, test: IntArray) -> FloatArray:
        """Return derivatives by theta of quantities that each belong to one test.

        Parameters
        ----------
        theta : ndarray, shape (n, n_parameters)
        slopes : ndarray, shape (n, m, n_structural)
            By the structure's parameters; zero for those known in the test.
        test : ndarray of int, shape (m,)

        Returns
        -------
        ndarray, shape (n, m, n_parameters)
        """
        found = np.zeros((*slopes.shape[:2], theta.shape[1]))
        rows = np.arange(slopes.shape[1])
        for j, value_of in enumerate(self.values_of):
            for columns, values in value_of(theta)[1]:
                # no parameter is twice in one row here, so that nothing is lost
                found[:, rows, columns[test]] += slopes[:, :, j] * values[:, test]
        return found

    def pull_slopes(self, theta: FloatArray, slopes: FloatArray) -> FloatArray:
        """Return derivatives by theta, (n, n_parameters), of a quantity that depends on all tests.

        Parameters
        ----------
        theta : ndarray, shape (n, n_parameters)
        slopes : ndarray, shape (n, n_tests, n_structural)
            By the structure's parameters in each test.
        """
        every = [(j, slope) for j, value_of in enumerate(self.values_of) for slope in value_of(theta)[1]]
        terms = np.concatenate([slopes[:, :, j] * slope.values for j, slope in every], axis=1)
        columns = np.concatenate([slope.columns for _, slope in every])
        order = np.argsort(columns, kind="stable")
        distinct, first = np.unique(columns[order], return_index=True)
        found = np.zeros_like(theta)
        found[:, distinct] = np.add.reduceat(terms[:, order], first, axis=1)
        return found


def find_populations(structural: Sequence[Parameter], varies: Mapping[str, Any]) -> list[tuple[str, Population]]:
    """Return the parameters that scatter over the tests, in the order of theta, with their populations."""
    every = ((p.name, varies.get(p.name)) for p in structural)
    return [(name, how) for name, how in every if isinstance(how, Population)]


def _lose(
    p: Parameter,
    how: Damage,
    tests: Sequence[Test],
    reference: str,
    add: Callable[..., int],
) -> Lost:
    """Return a parameter with losses, and add its parameters to the parameters of all tests."""
    column = add(p, "group", where=reference)
    states = dict.fromkeys(test.group for test in tests if test.group != reference)
    numbers = {reference: column} | {state: add(how.loss(p, state), "loss", where=state) for state in states}
    is_lost = np.array([test.group != reference for test in tests])
    return Lost(column, np.array([numbers[test.group] for test in tests]), is_lost)


def _place_of(how: str, test: Test) -> str:
    """Return the test or group that has a value of its own; empty where all share it."""
    return {SHARED: "", BY_TEST: test.name, BY_GROUP: test.group}[how]


def _rename(p: Parameter, name: str) -> Parameter:
    return p if name == p.name else Parameter(name, p.start, p.lower, p.upper, p.prior, p.unit, p.group)
