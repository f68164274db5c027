"""Possible causes of differences between tests that a model does not include: order, covariates and groups.

A test's score is the distance of a parameter's value in this test from its expected value, in standard deviations.
A permutation test compares statistics of the scores with those of the same scores in random orders
(`fmu.analysis.permutation`). The statistics of each parameter are:

- correlation with the order of the tests, the fraction of the variance in two slow waves, and the lag-1
  autocorrelation;
- correlation with each covariate on which the parameter does not depend in the model;
- for each covariate, the largest fraction of the variance about a straight line that a bend at any place explains.
  It reveals a nonlinear law, even if the model has a slope with respect to the covariate;
- the fraction of the variance between groups.

All statistics share one significance level, and the search for the bend is part of the test. There are n! orders
of n tests, so no p-value can be much smaller than 1/n!: 0.04 for four tests, 0.008 for five.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from fmu.analysis.permutation import (
    Bends,
    Statistics,
    between_groups,
    correlation_with,
    improbability,
    improbability_of_lag_one,
    in_random_orders,
    lag_one,
    probabilities_of_largest,
    share_along,
    slow_waves,
)
from fmu.numbers import fixed, share, significant
from fmu.types import BoolArray, FloatArray

ORDER, GROUPS = "the order of the tests", "the groups"
_SEARCHED = np.log(6.0)
"""Logarithm of the approximate number of independent positions of a bend. It is subtracted to put the best
position on the common scale."""
_HARDLY = 0.2
"""A change on one side of a bend is called small below this fraction of the change on the other side."""


class Cause(NamedTuple):
    """A possible cause of differences between tests.

    Attributes
    ----------
    of : str
        `ORDER`, `GROUPS` or the name of a covariate.
    statistic : Statistics
        Function that computes the statistic for sequences of scores.
    improbability : callable
        Function that returns −log of the tail probability of a statistic under Gaussian scores, given the
        statistic and the number of tests.
    words : callable
        Function that describes the effect in words, given a parameter's index and its statistic.
    free : ndarray of bool, shape (n_parameters,)
        Mask of the parameters for which the model does not include this cause.
    covers : bool
        Whether the description also covers the other causes with the same `of`.
    """

    of: str
    statistic: Statistics
    improbability: Callable[[FloatArray, FloatArray], FloatArray]
    words: Callable[[int, float], str]
    free: BoolArray
    covers: bool = False


class Effects(NamedTuple):
    """The causes, with their statistics and p-values.

    Attributes
    ----------
    causes : tuple of Cause
    values, p : ndarray, shape (n_parameters, n_causes)
        Statistics, and p-values adjusted for the numbers of parameters and causes.
    sizes : ndarray, shape (n_parameters, n_causes)
        −log of the probability that Gaussian scores give a statistic at least this large, a common effect-size
        scale.
    """

    causes: tuple[Cause, ...]
    values: FloatArray
    p: FloatArray
    sizes: FloatArray

    def in_words(self, k: int, limit: float) -> list[str]:
        """Return descriptions of the effects on parameter `k` with p below `limit`, the largest effect size first.

        At most one effect per `Cause.of` is described. Effects of order are omitted if a covariate or group also
        has an effect, because covariates and groups often change with the order.
        """
        best: dict[str, int] = {}
        for j in np.argsort(-self.sizes[k], kind="stable").tolist():
            cause = self.causes[j]
            if self.p[k, j] < limit and (cause.of not in best or cause.covers):
                best[cause.of] = j
        if len(best) > 1:
            best.pop(ORDER, None)  # covariates and groups often change with the order
        return [self.causes[j].words(k, float(self.values[k, j])) for j in best.values()]

    def strongest_in_words(self, k: int) -> str:
        """Return a description of the effect on parameter `k` with the largest effect size."""
        j = int(np.argmax(self.sizes[k]))
        return self.causes[j].words(k, float(self.values[k, j]))


def find_effects(
    scores: FloatArray,
    names: Sequence[str],
    tests: Sequence[Mapping[str, Any]],
    explained: Collection[tuple[str, str]],
) -> Effects:
    """Return the effects of order, covariates and groups on the scores of the tests.

    Covariates that do not vary are skipped, and so are groups if there is only one, or one for each test.

    Parameters
    ----------
    scores : ndarray, shape (n_tests, n_parameters)
        NaN where a test has no score.
    names : sequence of str
        Parameter names.
    tests : sequence of mapping
        Name, group and covariates of each test (`fmu.posterior.joint.modal_test.Test.as_dict`).
    explained : collection of (str, str)
        Pairs of a parameter and a covariate on which it depends in the model.
    """
    present = ~np.isnan(scores)
    n = np.maximum(present.sum(axis=0), 1)
    z = np.where(present, scores - np.nansum(scores, axis=0) / n, 0.0)
    causes = [*_of_order(z, [str(test["name"]) for test in tests])]
    for name in dict.fromkeys(name for test in tests for name in test["covariates"]):
        x = np.array([test["covariates"].get(name, np.nan) for test in tests], dtype=float)
        if np.nanmax(x) > np.nanmin(x):  # skipped for a covariate that does not vary
            causes += _of_covariate(z, name, x, np.array([(of, name) not in explained for of in names]))
    groups = [test["group"] for test in tests]
    of_group = np.array([[group == one for one in dict.fromkeys(groups)] for group in groups], dtype=float)
    k = of_group.shape[1]
    if 1 < k < len(z):
        causes.append(
            Cause(
                GROUPS,
                partial(between_groups, of_group),
                lambda ratio, n: improbability(ratio, n, k - 1),
                lambda _, ratio: f"{share(ratio)} of the variance lies between the groups",
                np.ones(len(names), dtype=bool),
            )
        )

    def of_all(z: FloatArray, present: BoolArray) -> FloatArray:
        return np.stack([cause.statistic(z, present) for cause in causes], axis=2)

    with np.errstate(invalid="ignore", divide="ignore"):
        values = np.nan_to_num(in_random_orders(z, present, of_all))
    each = [np.where(cause.free, cause.improbability(values[..., j], n), 0.0) for j, cause in enumerate(causes)]
    sizes = np.stack(each, axis=2)
    p = probabilities_of_largest(sizes.reshape(len(values), -1))
    return Effects(tuple(causes), values[0], p.reshape(len(names), -1), sizes[0])


def _of_order(z: FloatArray, tests: Sequence[str]) -> list[Cause]:
    """Return the possible causes related to the order of the tests: trend, slow waves, lag-1 autocorrelation.

    `z` contains the scores, (n_tests, n_parameters).
    """

    def most(k: int) -> str:
        step = np.cumsum(z[:, k])[:-1] ** 2 / (np.arange(1.0, len(z)) * np.arange(len(z) - 1.0, 0.0, -1.0))
        return f"most after test {tests[int(np.argmax(step))]}"

    def slowly(k: int, ratio: float) -> str:
        return f"values change slowly over the tests ({share(ratio)} of the variance in two waves), {most(k)}"

    free = np.ones(z.shape[1], dtype=bool)
    order, waves = np.arange(float(len(z))), slow_waves(len(z))
    return [
        Cause(ORDER, partial(correlation_with, order), lambda r, n: improbability(r**2, n),
              lambda k, r: f"{_linear(ORDER, r)}, {most(k)}", free),
        Cause(ORDER, partial(share_along, waves), lambda ratio, n: improbability(ratio, n, 2), slowly, free),
        Cause(ORDER, lag_one, improbability_of_lag_one,
              lambda _, r: f"consecutive tests have a lag-1 autocorrelation of {fixed(r, 2)}", free),
    ]  # fmt: skip


def _of_covariate(z: FloatArray, name: str, x: FloatArray, free: BoolArray) -> list[Cause]:
    """Return the possible causes related to a covariate x (n_tests,): a slope, and a bend if x has enough values.

    `free` (n_parameters,) marks the parameters that do not depend on x in the model.
    """
    known = np.where(np.isnan(x), np.nanmean(x), x)
    line = Cause(
        name,
        partial(correlation_with, known),
        lambda r, n: improbability(r**2, n),
        lambda _, r: f"{_linear(name, r)}: add a slope with {name}",
        free,
    )
    bends = Bends(x)
    if not len(bends.places):
        return [line]

    def words(k: int, _: float) -> str:
        place = float(bends.places[np.argmax(bends.shares(z)[k])])
        return _bent(name, x, z[:, k], place, bool(free[k]))

    def of_best(ratio: FloatArray, n: FloatArray) -> FloatArray:
        return np.maximum(improbability(ratio, n - 1.0) - _SEARCHED, 0.0)

    return [line, Cause(name, bends.largest, of_best, words, np.ones(len(free), dtype=bool), covers=True)]


def _linear(cause: str, r: float) -> str:
    return f"values {'rise' if r > 0.0 else 'fall'} with {cause} (correlation {fixed(r, 2)})"


def _bent(name: str, x: FloatArray, z: FloatArray, place: float, free: bool) -> str:
    """Describe in words how a parameter's scores z (n_tests,) depend on a covariate x, with a bend at `place`.

    `free` is False if the parameter depends on x in the model.
    """
    known = ~np.isnan(x)
    columns = np.stack(
        [np.ones(known.sum()), np.minimum(x[known] - place, 0.0), np.maximum(x[known] - place, 0.0)]
    )
    _, *slopes = np.linalg.lstsq(columns.T, z[known], rcond=None)[0].tolist()
    below, above = slopes[0] * (place - np.nanmin(x)), slopes[1] * (np.nanmax(x) - place)
    at = significant(place, 2)
    beyond = "" if free else "beyond the slope in the model, "

    def verb(change: float, other: float) -> str:
        return "hardly change" if abs(change) < _HARDLY * abs(other) else "rise" if change > 0.0 else "fall"

    return (
        f"{beyond}values {verb(below, above)} with {name} below {at} and {verb(above, below)} above: add a slope "
        f"with a kink near {at}"
    )
