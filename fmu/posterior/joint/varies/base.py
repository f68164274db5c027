"""A parameter of the structure in every test, as a function of theta, and the choice how it varies.

A new way to vary is a module of this folder, with a `Varies` and the `InTests` that it gives, and a line in the
`__init__`.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from typing import ClassVar, NamedTuple

import numpy as np

from fmu.posterior.joint.modal_test import Test
from fmu.posterior.parameters import Parameter
from fmu.types import FloatArray, IntArray, Plain


class Role(NamedTuple):
    """What a parameter of theta is for.

    Attributes
    ----------
    kind : {"shared", "test", "group", "mean", "sd", "score", "loss", "slope", "correlation", "noise"}
        The value in all tests, in one, or in a group of them; mean or standard deviation of a population, or a
        test's score in it; a share that a group has lost; a slope by a covariate; an inferred standard deviation
        of the errors.
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


class InTests:
    """A parameter of the structure in every test, as a function of theta."""

    @property
    def base(self) -> InTests:
        """The parameter without trends: itself, unless it has some."""
        return self

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

    def after(self, n: int) -> InTests:
        """Return the parameter with its scores behind `n` parameters of theta; itself if it has none."""
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


class Theta:
    """The parameters of theta while a layout is built: scores come after all others.

    Parameters
    ----------
    tests : sequence of Test
    reference : str
        The group of tests that losses refer to.

    Attributes
    ----------
    main, scores : list of Parameter
    roles, roles_of_scores : list of Role
    """

    def __init__(self, tests: Sequence[Test], reference: str) -> None:
        self.tests, self.reference = tests, reference
        self.main: list[Parameter] = []
        self.scores: list[Parameter] = []
        self.roles: list[Role] = []
        self.roles_of_scores: list[Role] = []

    def add(self, parameter: Parameter, kind: str, of: int | None, where: str = "") -> int:
        """Add a parameter and its role, see `Role`; return its number in theta."""
        self.main.append(parameter)
        self.roles.append(Role(kind, of, where))
        return len(self.main) - 1

    def add_score(self, parameter: Parameter, of: int, where: str) -> int:
        """Add the score of a test; return its number among the scores."""
        self.scores.append(parameter)
        self.roles_of_scores.append(Role("score", of, where))
        return len(self.scores) - 1


class Varies:
    """How a parameter of the structure varies between tests.

    Attributes
    ----------
    scatters : bool
        Whether its values are draws from a population, which may be correlated with others.
    by_test : bool
        Whether its values differ from test to test, so that there must be two.
    by_group : bool
        Whether its values differ between groups of tests, so that later groups have losses.
    """

    scatters: ClassVar[bool] = False
    by_test: ClassVar[bool] = False
    by_group: ClassVar[bool] = False

    def find_mistakes(self, name: str, tests: Sequence[Test]) -> list[str]:
        """Return what these tests lack for a parameter of this name to vary so, each with its place."""
        here = [test for test in tests if name not in test.known]
        found = []
        if self.by_test and len(here) < 2:
            found.append(f"varies.{name}: varies by test, and needs two tests or more (got {len(here)})")
        if self.by_group:
            rule = f"must be given, as {name} varies by group (got none)"
            found += [f"tests.{t}.group: {rule}" for t, test in enumerate(tests) if not test.group]
            if len({test.group for test in here}) < 2:
                found.append(f"varies.{name}: varies by group, and needs two groups or more (got 1)")
        return found

    def in_tests(self, p: Parameter, of: int, theta: Theta, here: Sequence[int]) -> InTests:
        """Add the parameters of theta that stand for a parameter of the structure; return its values in tests.

        Parameters
        ----------
        p : Parameter
        of : int
            Its number in the structure.
        theta : Theta
        here : sequence of int
            The tests in which its value is not known.

        Raises
        ------
        ValueError
            If the parameter cannot vary so.
        """
        raise NotImplementedError

    def as_dict(self) -> dict[str, Plain]:
        """Return the settings in plain Python types."""
        return {}
