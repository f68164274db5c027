"""Checks of populations: whether the tests are independent draws from one distribution.

The score of a test is the distance of its value from the population mean, in population standard deviations. If
the model is correct, the scores are independent standard normal draws, whatever the order of the tests, their
groups and their covariates. The posterior mean m of a score then has the variance 1 − s², where s is the posterior
standard deviation of the score. The checks use m/√(1 − s²):

- Permutation tests with a common level (`fmu.analysis.permutation`) of four statistics: the correlation with the
  order of the tests, the correlation with each covariate on which the model does not let the parameter depend, the
  lag-1 autocorrelation, and the share of the variance between groups. With five tests or fewer nothing can be
  significant.
- A test of the score farthest from the mean (Grubbs 1950, *Ann. Math. Statist.* 21, 27–58; Bonferroni's bound).
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.special import stdtr

from fmu.analysis.fit.check import POPULATION, Check, probability
from fmu.analysis.permutation import (
    Statistics,
    adjusted_probabilities,
    between_groups,
    correlation_with,
    in_random_orders,
    lag_one,
)
from fmu.analysis.trace.reading import has, parameter_names, problem_of, roles_of, score_names
from fmu.numbers import fixed, share, significant
from fmu.types import BoolArray, FloatArray

if TYPE_CHECKING:
    import xarray as xr

    from fmu.posterior.problem import UpdatingProblem


GROUP = "populations"
_INFORMED = 0.05
"""A score is skipped if the data remove less than this share of its prior variance."""
_FEWEST = 6
_FEW_TESTS = f"fewer than {_FEWEST} tests tell their values, so that no order of them is improbable"


class Causes(NamedTuple):
    """Possible causes of differences between tests that the model does not include: order, covariates and groups.

    Attributes
    ----------
    statistics : ndarray, shape (1 + n_orders, n_populations, n_causes)
        The statistic of each cause, first in the actual order of the tests, then in random orders.
    two_sided : tuple of bool
        Whether the permutation test of each cause is two-sided.
    words : tuple of callable
        One function per cause, which returns the effect in words for a value of the statistic.
    """

    statistics: FloatArray
    two_sided: tuple[bool, ...]
    words: tuple[Callable[[float], str], ...]

    def probabilities(self) -> FloatArray:
        """Return the p-values of the causes, adjusted for their number, shape (n_populations, n_causes)."""
        n_orders, n, m = self.statistics.shape
        found = adjusted_probabilities(self.statistics.reshape(n_orders, n * m), np.tile(self.two_sided, n))
        return found.reshape(n, m)

    def effect(self, k: int, cause: int) -> str:
        """Return the sentence part that describes the effect of the cause with index `cause` on population `k`."""
        return self.words[cause](float(self.statistics[0, k, cause]))


def population_group(
    problem: UpdatingProblem, theta: FloatArray, shape: tuple[int, ...], coordinates: dict[str, Any]
) -> xr.Dataset:
    """Return the trace group with the posterior means and standard deviations of the scores, and the correlations.

    Parameters
    ----------
    problem : UpdatingProblem
        A problem with a population.
    theta : ndarray, shape (n, n_structural)
        Posterior draws; `shape` is (chains, draws), and `coordinates` has the coordinates of both.
    """
    import xarray as xr

    layout = problem.layout
    names = list(layout.populations)
    scores = np.full((2, len(names), len(problem.tests)), np.nan)
    for k, one in enumerate(layout.drawn):
        z = one.population_scores(theta)[0][:, one.scored]
        scores[:, k, one.scored] = z.mean(axis=0), z.std(axis=0)
    dims = ("population", "test")
    variables: dict[str, Any] = {"score": (dims, scores[0]), "score_sd": (dims, scores[1])}
    every = coordinates | {"population": names, "test": [test.name for test in problem.tests]}
    if layout.correlation is None:
        return xr.Dataset(variables, coords=every)
    matrices = layout.correlations(theta).reshape(*shape, len(names), -1)
    variables["correlation"] = (("chain", "draw", "population", "other"), matrices)
    return xr.Dataset(variables, coords=every | {"other": names})


def population_checks(trace: xr.DataTree, level: float) -> list[Check]:
    """Return a list with one check per population; empty if the trace has no population."""
    if not has(trace, GROUP, "score"):
        return []
    group, tests = trace[GROUP].to_dataset(), problem_of(trace)["tests"]
    names = [str(name) for name in group["population"].to_numpy()]
    explained = {(of, where) for kind, of, where in roles_of(trace).values() if kind == "slope"}
    return checks_of_scores(standard_scores(group), names, tests, explained, level)


def checks_of_scores(
    scores: FloatArray,
    names: Sequence[str],
    tests: Sequence[Mapping[str, Any]],
    explained: Collection[tuple[str, str]],
    level: float,
) -> list[Check]:
    """Return a list with one check per population.

    Parameters
    ----------
    scores : ndarray, shape (n_tests, n_populations)
        Scores that are standard normal if the model is correct; NaN where a test has no value.
    names : sequence of str
        Names of the populations.
    tests : sequence of mapping
        Name, group and covariates of each test (`fmu.posterior.joint.modal_test.Test.as_dict`).
    explained : collection of (str, str)
        Pairs of a population and a covariate on which it depends in the model.
    level : float
        Largest probability of a false alarm, of all populations together.
    """
    causes = _causes(scores, names, tests, explained)
    of_order, checks = causes.probabilities(), []
    for k, name in enumerate(names):
        far = _farthest(scores[:, k])
        of_far = min(1.0, len(names) * far.p)
        said = [causes.effect(k, j) for j in np.argsort(of_order[k], kind="stable") if of_order[k, j] < level / 2]
        distance = f"{significant(far.distance, 2)} standard deviations from the mean"
        if of_far < level / 2:
            said.append(f"test {tests[far.test]['name']} lies {distance}")
        enough = bool(np.sum(~np.isnan(scores[:, k])) >= _FEWEST)
        p = min(1.0, 2.0 * min(float(of_order[k].min()), of_far))
        checks.append(
            Check(
                POPULATION,
                f"population of {name}",
                f"{causes.effect(k, int(np.argmin(of_order[k])))}; the farthest test lies {distance}",
                f"p {significant(level, 2)}",
                p,
                bool(said),
                "values that depend on order, group or covariate, or one test far from the others",
                f"population of {name}: the tests are not independent draws from one distribution: "
                f"{'; '.join(said)} ({probability(p)})",
                "" if enough else _FEW_TESTS,
            )
        )
    return checks


def standard_scores(group: xr.Dataset) -> FloatArray:
    """Return scores, standard normal if the model is correct, (n_tests, n_populations); NaN where unknown."""
    mean, sd = (group[name].transpose("test", "population").to_numpy() for name in ("score", "score_sd"))
    informed = 1.0 - sd**2
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(informed > _INFORMED, mean / np.sqrt(informed), np.nan)


def effective_parameters(trace: xr.DataTree) -> int:
    """Return the effective number of parameters of a trace, rounded to an integer.

    A score counts as the share of its prior variance that the data remove; every other parameter counts as one.
    """
    n = len(parameter_names(trace))
    if not has(trace, GROUP, "score_sd"):
        return n
    return (
        n
        - len(score_names(trace))
        + round(float(np.nansum(np.clip(1.0 - trace[GROUP]["score_sd"].to_numpy() ** 2, 0.0, 1.0))))
    )


class _Farthest(NamedTuple):
    """Index of the test farthest from the mean, its distance in standard deviations, and its p-value."""

    test: int
    distance: float
    p: float


def _farthest(scores: FloatArray) -> _Farthest:
    n = int(np.sum(~np.isnan(scores)))
    if n < _FEWEST:
        return _Farthest(0, np.nan, 1.0)
    away = np.abs(scores - np.nanmean(scores)) / np.nanstd(scores, ddof=1)
    test = int(np.nanargmax(away))
    g = float(away[test])
    left = (n - 1) ** 2 - n * g**2
    t = np.sqrt(n * (n - 2) * g**2 / left) if left > 0.0 else np.inf
    return _Farthest(test, g, float(min(1.0, 2.0 * n * stdtr(n - 2, -t))))


def _causes(
    scores: FloatArray,
    names: Sequence[str],
    tests: Sequence[Mapping[str, Any]],
    explained: Collection[tuple[str, str]],
) -> Causes:
    """Return the possible causes of differences between scores: order, previous test, covariates and groups."""
    present = ~np.isnan(scores)
    n = np.maximum(present.sum(axis=0), 1)
    z = np.where(present, scores - np.nansum(scores, axis=0) / n, 0.0)
    order = np.arange(float(len(z)))
    found: list[tuple[bool, Callable[[float], str], Statistics]] = [
        (True, partial(_in_words, "the order of the tests"), partial(correlation_with, order)),
        (False, _resemblance, lag_one),
    ]
    for name in tests[0]["covariates"]:
        x = np.array([test["covariates"].get(name, np.nan) for test in tests])
        if np.ptp(x) > 0.0:  # skipped for a covariate that does not vary
            free = np.array([(of, name) not in explained for of in names], dtype=float)
            found.append((True, partial(_in_words, name), partial(_correlation, x, free)))
    groups = [test["group"] for test in tests]
    of_group = np.array([[group == one for one in dict.fromkeys(groups)] for group in groups], dtype=float)
    if 1 < of_group.shape[1] < len(z):
        found.append((False, _between, partial(between_groups, of_group)))
    two_sided, words, statistics = zip(*found, strict=True)

    def of_all(z: FloatArray, present: BoolArray) -> FloatArray:
        return np.stack([statistic(z, present) for statistic in statistics], axis=2)

    with np.errstate(invalid="ignore", divide="ignore"):
        return Causes(np.nan_to_num(in_random_orders(z, present, of_all)), two_sided, words)


def _correlation(x: FloatArray, free: FloatArray, z: FloatArray, present: BoolArray) -> FloatArray:
    """Return the correlations with a covariate; zero for populations that depend on it in the model."""
    return free * correlation_with(x, z, present)


def _in_words(cause: str, r: float) -> str:
    return f"values {'rise' if r > 0.0 else 'fall'} with {cause} (correlation {fixed(r, 2)})"


def _resemblance(r: float) -> str:
    return f"consecutive tests have a lag-1 autocorrelation of {fixed(r, 2)}"


def _between(ratio: float) -> str:
    return f"{share(ratio)} of the variance lies between the groups"
