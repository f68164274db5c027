"""Base classes: `Varies` says how a parameter varies between tests; `InTests` computes its values from theta.

To add a kind of variation, write a module in this folder with a subclass of `Varies`. The method `in_tests` of
this class returns an instance of `InTests`, usually of a new subclass. Then add the class to `VARIES` or
`Variation` in ``__init__.py``.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple, Self

import numpy as np

from fmu.posterior.joint.modal_test import Test
from fmu.posterior.joint.varies.covariates import Covariate
from fmu.posterior.parameters import Parameter
from fmu.types import FloatArray, IntArray, Plain

Reference = tuple[float, FloatArray]
"""Reference for a population's scores: its centre, and its width in each test, (n_tests,); see `Drawn`."""


class Role(NamedTuple):
    """Meaning of one parameter in theta.

    Attributes
    ----------
    kind : str
        ``"shared"``, ``"test"`` or ``"group"``: the value in all tests, in one test or in a group of tests;
        ``"mean"`` or ``"sd"``: a population's mean or standard deviation; ``"score"``: a test's score in a
        population; ``"effect"``: a group's effect on a population; ``"loss"``: the relative loss in a group, or
        since an event; ``"correlation time"``: a population's correlation time; ``"date"``: the date of an event;
        ``"slope"`` or ``"kink"``: the slope with a covariate, or the covariate value where it changes;
        ``"covariate"``: the value of a covariate in a test; ``"correlation"``: a partial correlation between two
        populations; ``"share"``: the probability that a test is an outlier; ``"noise"``: an inferred parameter of
        the errors, such as a standard deviation.
    of : int or None
        Index of the structural parameter in ``layout.structural``; None for correlations, covariates, dates,
        the outlier share and the parameters of the errors.
    where : str
        Name of the test, group, covariate (for a correlation time, the time covariate) or event that the role
        refers to; otherwise empty.
    """

    kind: str
    of: int | None
    where: str = ""


class Slope(NamedTuple):
    """Derivative of the value in each test with respect to a parameter of theta, which may differ between tests.

    Attributes
    ----------
    columns : ndarray of int, shape (n_tests,)
        For each test, the index of that parameter in theta.
    values : ndarray, shape (n, n_tests)
        The derivative of the value in each test.
    """

    columns: IntArray
    values: FloatArray


def add_by_column(gradient: FloatArray, slope: Slope) -> None:
    """Add a slope's derivatives to `gradient` (n, ndim) in place. Several tests may share a column."""
    for column in np.unique(slope.columns):
        gradient[:, column] += np.einsum("nt->n", slope.values[:, slope.columns == column])


def sum_by_test(terms: FloatArray, test: IntArray, n_tests: int) -> FloatArray:
    """Sum terms (n, m, …) over each test's entries; return shape (n, n_tests, …).

    `test`, shape (m,), is the index of each term's test.
    """
    found = np.zeros((len(terms), n_tests, *terms.shape[2:]))
    order = np.argsort(test, kind="stable")
    first = np.flatnonzero(np.diff(test[order], prepend=-1))
    found[:, test[order][first]] = np.add.reduceat(terms[:, order], first, axis=1)
    return found


class Factor(NamedTuple):
    """A factor on the values in the tests, and its derivatives.

    Attributes
    ----------
    values : ndarray, shape (n, n_tests)
        The factor in each test.
    slopes : list of Slope
        Derivatives of the factor with respect to parameters of theta.
    """

    values: FloatArray
    slopes: list[Slope]


class SuddenLoss(NamedTuple):
    """A sudden loss at an unknown date.

    Attributes
    ----------
    date, loss : int
        Indices in theta of the date and the loss.
    times : ndarray, shape (n_tests,)
        The time of each test.
    """

    date: int
    loss: int
    times: FloatArray


class InTests:
    """Values of a structural parameter in all tests, as a function of theta."""

    @property
    def base(self) -> InTests:
        """The parameter without trends, losses and group effects, or the parameter itself if it has none."""
        return self

    @property
    def sudden_loss(self) -> SuddenLoss | None:
        """The parameter's sudden loss at an unknown date, or None if it has none."""
        return None

    def __call__(self, theta: FloatArray) -> tuple[FloatArray, list[Slope]]:
        """Return the value in each test, (n, n_tests), and its derivatives, at theta (n, n_parameters)."""
        raise NotImplementedError

    def identity(self, test: int) -> Hashable:
        """Return a key. Tests with equal keys have equal parameter values at every theta."""
        raise NotImplementedError

    def box(self, lower: FloatArray, upper: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return limits that the values exceed rarely or never, (n_tests,) each, for given limits of theta."""
        raise NotImplementedError

    def next_test(self, theta: FloatArray, like: int, future: Future) -> FloatArray:
        """Return the parameter's values (n,) at each theta in a further test like the test with index `like`."""
        return self(theta)[0][:, like]

    def losses(self, theta: FloatArray, reference: int) -> FloatArray:
        """Return the relative losses (n, n_tests) compared with test `reference`, without trends and scatter.

        A subclass must define this method if the parameter can vary by group or have an undated loss.
        """
        raise NotImplementedError

    def refer_to(self, references: Mapping[int, tuple[FloatArray, Reference]]) -> InTests:
        """Return a copy whose scores use another centring and reference, or `self` if it has no scores.

        `references` contains the new centring and reference (see `Drawn`) of each population, keyed by the index
        in theta of the population's centre.
        """
        return self

    def after(self, n: int) -> InTests:
        """Return a copy that reads its scores from theta columns shifted by `n`, or `self` if it has no scores."""
        return self

    def factors(self, theta: FloatArray) -> list[Factor]:
        """Return the factors that multiply the values of `base` at theta (n, n_parameters); empty if none do."""
        return []


@dataclass(frozen=True)
class Multiplied(InTests):
    """A structural parameter whose values are another `InTests` multiplied by a factor in each test.

    Attributes
    ----------
    of : InTests
        The values without the factor.
    """

    of: InTests

    def factor(self, theta: FloatArray) -> Factor:
        """Return the factor in each test at theta (n, n_parameters). It does not depend on the scores."""
        raise NotImplementedError

    def __call__(self, theta: FloatArray) -> tuple[FloatArray, list[Slope]]:
        """Return the value in each test, (n, n_tests), and its derivatives, at theta (n, n_parameters)."""
        value, slopes = self.of(theta)
        factor, own = self.factor(theta)
        return value * factor, [
            *(Slope(one.columns, one.values * factor) for one in slopes),
            *(Slope(one.columns, value * one.values) for one in own),
        ]

    def factors(self, theta: FloatArray) -> list[Factor]:
        """Return the factors that multiply the values of `base` at theta (n, n_parameters)."""
        return [*self.of.factors(theta), self.factor(theta)]

    @property
    def base(self) -> InTests:
        """The parameter without any factor."""
        return self.of.base

    @property
    def sudden_loss(self) -> SuddenLoss | None:
        """The parameter's sudden loss at an unknown date, or None if it has none."""
        return self.of.sudden_loss

    def after(self, n: int) -> Self:
        """Return a copy that reads its scores from theta columns shifted by `n`."""
        return replace(self, of=self.of.after(n))

    def refer_to(self, references: Mapping[int, tuple[FloatArray, Reference]]) -> Self:
        """Return a copy whose scores use another centring and reference."""
        return replace(self, of=self.of.refer_to(references))


class Future(NamedTuple):
    """Conditions in a further test that has not been measured.

    Attributes
    ----------
    rng : Generator
    scores : mapping of int to ndarray, shape (n,)
        Standardised values in each population, keyed by the index of the population's centre in theta.
    covariates : mapping of str to float
        Values of the covariates. In a trend, a covariate without an entry is set to its mean over the tests. If
        the time of an undated loss has no entry, the time of the last test is used.
    """

    rng: np.random.Generator
    scores: Mapping[int, FloatArray]
    covariates: Mapping[str, float]


class Theta:
    """Collects the parameters of theta while a layout is built. Scores follow all other parameters.

    Parameters
    ----------
    tests : sequence of Test
    reference : str
        The group of tests that losses refer to.

    Attributes
    ----------
    main, scores : list of Parameter
        The parameters other than scores, and the scores.
    roles, roles_of_scores : list of Role
        The role of each parameter in `main`, and in `scores`.
    """

    def __init__(self, tests: Sequence[Test], reference: str) -> None:
        self.tests, self.reference = tests, reference
        self.main: list[Parameter] = []
        self.scores: list[Parameter] = []
        self.roles: list[Role] = []
        self.roles_of_scores: list[Role] = []
        self._covariates: dict[str, Covariate] = {}

    def covariate(self, name: str) -> Covariate:
        """Return a covariate of the tests. The first call adds the covariate's unknown values to theta."""
        if name not in self._covariates:
            self._covariates[name] = Covariate.of_tests(
                name, self.tests, lambda parameter, test: self.add(parameter, "covariate", None, test)
            )
        return self._covariates[name]

    def add(self, parameter: Parameter, kind: str, of: int | None, where: str = "") -> int:
        """Add a parameter and its role (see `Role`); return the index of the parameter in theta."""
        self.main.append(parameter)
        self.roles.append(Role(kind, of, where))
        return len(self.main) - 1

    def add_common(self, parameter: Parameter, kind: str, where: str) -> int:
        """Add a parameter that several structural parameters may share; return its index in theta.

        Raises
        ------
        ValueError
            If theta already has another parameter with this name or in this role, or the same parameter in another
            role.
        """
        role = Role(kind, None, where)
        has_name = [other.name == parameter.name for other in self.main]
        same = [k for k, other in enumerate(self.roles) if has_name[k] or other == role]
        if not same:
            return self.add(parameter, kind, None, where)
        first = self.main[same[0]]
        if first.name != parameter.name:
            rule = f"must have the same by for all parameters with the event {where}, or another event"
            raise ValueError(f"varies: {parameter.name} {rule} (got {first.name} too)")
        if first != parameter or self.roles[same[0]] != role:
            rule = "must have the same prior and growth for all parameters, or another event (got two)"
            raise ValueError(f"varies: {parameter.name} {rule}")
        return same[0]

    def add_score(self, parameter: Parameter, of: int, where: str) -> int:
        """Add the score of a test; return its index among the scores."""
        self.scores.append(parameter)
        self.roles_of_scores.append(Role("score", of, where))
        return len(self.scores) - 1


class Varies:
    """How a structural parameter varies between tests. Each subclass is one kind of variation.

    Attributes
    ----------
    by_test : bool
        Whether the values differ from test to test, so that at least two tests are needed.
    by_group : bool
        Whether the values differ between groups of tests, so that groups other than the reference have losses.
    """

    by_test: ClassVar[bool] = False
    by_group: ClassVar[bool] = False

    @property
    def by_date(self) -> str | None:
        """Time covariate of an undated loss: empty if test numbers serve as time, None if no loss is undated."""
        return None

    @property
    def is_in_time(self) -> bool:
        """Whether the population's values are correlated in time."""
        return self.population is not None and self.population is not self and self.population.is_in_time

    @property
    def population(self) -> Varies | None:
        """Population from which the values are drawn, or None if there is none."""
        return None

    def find_mistakes(self, name: str, tests: Sequence[Test]) -> list[str]:
        """Return error messages if the tests do not allow the parameter `name` to vary as this class describes."""
        here = [test for test in tests if name not in test.known]
        found = []
        if self.by_test and len(here) < 2:
            found.append(f"varies.{name}: varies by test, and needs two tests or more (got {len(here)})")
        if self.by_group:
            rule = f"must be given, as {name} varies by group (got none)"
            found += [f"tests.{t}.group: {rule}" for t, test in enumerate(tests) if not test.group]
            groups = {test.group for test in here}
            if len(groups) < 2:
                found.append(f"varies.{name}: varies by group, and needs two groups or more (got {len(groups)})")
        return found

    def in_tests(self, p: Parameter, of: int, theta: Theta, here: Sequence[int]) -> InTests:
        """Add the parameters that a structural parameter needs to theta; return its values in the tests.

        Parameters
        ----------
        p : Parameter
            The structural parameter.
        of : int
            Index of `p` among the structural parameters.
        theta : Theta
            Collects the new parameters.
        here : sequence of int
            Indices of the tests in which the value of `p` is not known.

        Raises
        ------
        ValueError
            If the parameter cannot vary as this class describes.
        """
        raise NotImplementedError

    def as_dict(self) -> dict[str, Plain]:
        """Return the settings as a dict of plain Python types."""
        return {}
