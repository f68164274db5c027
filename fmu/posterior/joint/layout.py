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
from fmu.posterior.joint.population import Population
from fmu.posterior.joint.values import Drawn, Future, InTests, Lost, Taken, Trend
from fmu.posterior.parameters import Parameter, box
from fmu.posterior.priors.base import Normal, Prior
from fmu.types import FloatArray, IntArray

SHARED, BY_TEST, BY_GROUP = "shared", "test", "group"
VARIES = (SHARED, BY_TEST, BY_GROUP)


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
    values_of : tuple of InTests
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
    values_of: tuple[InTests, ...]
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
                base = Taken(columns, p if how == BY_TEST else None)
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
                value = value_of.base(theta)[0]
                found.append(1.0 - value[:, later] / value[:, reference])
        return np.stack(found, axis=2)

    @property
    def drawn(self) -> list[Drawn]:
        """The parameters that scatter over the tests."""
        return [one.base for one in self.values_of if isinstance(one.base, Drawn)]

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
        scores = np.moveaxis(self.draw_scores(theta, rng, 1), 2, 0)[:, :, 0]
        future = Future(rng, {one.centre: z for one, z in zip(self.drawn, scores, strict=True)}, covariates)
        return np.stack([value_of.next_test(theta, like, future) for value_of in self.values_of], axis=1)

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
