"""Checks of each parameter's law, which relates its values in different tests.

A test's score in a population is the distance of its value from the population mean, in population standard
deviations. If the model is correct, the scores are independent standard normal draws, whatever the order of the
tests, their groups and their covariates. The posterior mean m of a score then has the variance 1 − s², where s is
the score's posterior standard deviation. The checks use m/√(1 − s²).

If values are correlated in time, the checks use the innovations at one posterior draw, which are standard normal
and independent if the model is correct. Their posterior means would not be independent. A parameter that does not
scatter has scores from the residuals (`fmu.analysis.fit.residual_scores`). The checks are

- permutation tests of the causes in `fmu.analysis.fit.causes`;
- for a population, a test of the score farthest from the mean (Grubbs 1950, *Ann. Math. Statist.* 21, 27–58;
  Bonferroni's bound).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.special import stdtr

from fmu.analysis.fit.causes import find_effects
from fmu.analysis.fit.check import LAW, POPULATION, Check, probability
from fmu.analysis.fit.residual_scores import GROUP as RESIDUALS
from fmu.analysis.trace.distinct_draws import evaluate_in_parts
from fmu.analysis.trace.reading import has, parameter_names, problem_of, roles_of, score_names
from fmu.numbers import significant
from fmu.types import FloatArray

if TYPE_CHECKING:
    import xarray as xr

    from fmu.posterior.joint.varies.drawn import Drawn
    from fmu.posterior.problem import UpdatingProblem


GROUP = "populations"
_INFORMED = 0.05
"""A score is ignored if the data remove less than this fraction of its prior variance."""
_FEWEST = 6
_OUTLIER = 0.5
_TO_CAUSES = 0.6
"""Fraction of the level that goes to the causes; the rest goes to the test farthest from the mean."""
_POPULATION = (
    "population of",
    "the tests are not independent draws from one distribution",
    "values that depend on order, group or covariate, or one test far from the others",
)
_LAW = (
    "residuals of",
    "the tests contradict its law in the model",
    "values that depend on order, group or covariate otherwise than in the model",
)
"""The checked quantity, the evidence against the model, and the errors that the check would have revealed."""
_FEW_TESTS = f"fewer than {_FEWEST} tests tell their values, so that no order of them is improbable"


def population_group(
    problem: UpdatingProblem, theta: FloatArray, shape: tuple[int, ...], coordinates: dict[str, Any]
) -> xr.Dataset:
    """Return the trace group ``populations``.

    It has the posterior means ``score`` and standard deviations ``score_sd`` of the test scores, which are NaN for
    a test without a score. If the populations are correlated, ``correlation`` has their correlations at every
    draw. If a population is correlated in time, ``innovation`` has its innovations at the last draw
    (`fmu.posterior.joint.varies.autocorrelation`). If tests may be outliers, ``outlier`` is the probability that a
    test is an outlier, and ``outlier_of`` is the probability that it is an outlier of one population.

    Parameters
    ----------
    problem : UpdatingProblem
        A problem with a population.
    theta : ndarray, shape (n, n_structural)
        Posterior draws.
    shape : tuple of int
        Numbers of chains and of draws per chain.
    coordinates : dict
        Coordinates of the chains and draws.
    """
    import xarray as xr

    layout = problem.layout
    names = list(layout.populations)
    scores = np.full((2, len(names), len(problem.tests)), np.nan)
    for k, one in enumerate(layout.drawn):
        z = evaluate_in_parts(partial(_scores_of, one), theta)
        scores[:, k, one.scored] = z.mean(axis=0), z.std(axis=0)
    dims = ("population", "test")
    variables: dict[str, Any] = {"score": (dims, scores[0]), "score_sd": (dims, scores[1])}
    if layout.in_time is not None:
        last = theta[-1:]
        e = layout.in_time.innovations(last, layout.population_scores(last))[0].T
        is_in_time = np.array([[one.in_time is not None] for one in layout.drawn])
        variables["innovation"] = dims, np.where(is_in_time & ~np.isnan(scores[0]), e, np.nan)
    if layout.outliers is not None:
        z = np.stack([one.population_scores(theta)[0] for one in layout.drawn], axis=2)
        outlier, of_each = layout.outliers.outlying(theta, z)
        variables["outlier"] = "test", outlier.mean(axis=0)
        variables["outlier_of"] = dims, of_each.mean(axis=0).T
    every = coordinates | {"population": names, "test": [test.name for test in problem.tests]}
    if layout.correlation is None:
        return xr.Dataset(variables, coords=every)
    matrices = layout.correlations(theta).reshape(*shape, len(names), -1)
    variables["correlation"] = (("chain", "draw", "population", "other"), matrices)
    return xr.Dataset(variables, coords=every | {"other": names})


def _scores_of(one: Drawn, theta: FloatArray) -> FloatArray:
    """Return the standard normal scores at `theta`, shape (n, n_scored), of the tests that have a score."""
    return one.population_scores(theta)[0][:, one.scored]


def population_checks(trace: xr.DataTree, level: float) -> list[Check]:
    """Check the law of each parameter; return one `Check` per parameter.

    A parameter is checked if it scatters, or if the model's law gives its value in every test. The trace must
    store scores of several tests.
    """
    tests, columns, names = problem_of(trace)["tests"], [], []
    populations: list[str] = []
    if has(trace, GROUP, "score"):
        group = trace[GROUP].to_dataset()
        populations = [str(name) for name in group["population"].to_numpy()]
        columns.append(standard_scores(group))
    if has(trace, RESIDUALS, "score"):
        others = trace[RESIDUALS].to_dataset()
        names = [str(name) for name in others["parameter"].to_numpy()]
        columns.append(others["score"].transpose("test", "parameter").to_numpy())
    explained = {(of, where) for kind, of, where in roles_of(trace).values() if kind == "slope"}
    explained |= {(name, where) for name, by in problem_of(trace).get("slopes", {}).items() for where in by}
    return checks_of_scores(np.concatenate(columns, axis=1), populations, tests, explained, level, names)


def checks_of_scores(
    scores: FloatArray,
    populations: Sequence[str],
    tests: Sequence[Mapping[str, Any]],
    explained: Collection[tuple[str, str]],
    level: float,
    others: Sequence[str] = (),
) -> list[Check]:
    """Check the scores of each parameter for the causes in `find_effects`, and of each population for an outlier.

    Parameters
    ----------
    scores : ndarray, shape (n_tests, n_populations + n_others)
        Scores that are independent of the tests' order, covariates and groups if the model is correct, and
        standard normal for populations; NaN where a test has no value.
    populations, others : sequence of str
        Names of the parameters that scatter, and of those that do not.
    tests : sequence of mapping
        Name, group and covariates of each test (`fmu.posterior.joint.modal_test.Test.as_dict`).
    explained : collection of (str, str)
        Pairs of a parameter and a covariate on which it depends in the model.
    level : float
        Largest probability of a false alarm for all parameters together.
    """
    names, n = [*populations, *others], len(populations)
    to_causes = _TO_CAUSES if n else 1.0
    effects = find_effects(scores, names, tests, explained)
    of_causes = effects.p.min(axis=1)
    found = [effects.in_words(k, to_causes * level) for k in range(len(names))]
    nearest = [effects.strongest_in_words(k) for k in range(len(names))]
    concerned = [k for k in range(n, len(names)) if found[k]]
    for k in _explained_by_others(scores, names, tests, explained, to_causes * level, concerned):
        found[k], of_causes[k] = [], 1.0
        nearest[k] = "what its residuals show is explained by another parameter"
    checks = []
    for k, name in enumerate(names):
        depends, shown, p = "; ".join(found[k]), nearest[k], of_causes[k] / to_causes
        said = found[k]
        if k < n:
            far = _farthest(scores[:, k])
            of_far = min(1.0, n * far.p)
            distance = f"{significant(far.distance, 2)} standard deviations from the mean"
            shown += f"; the farthest test lies {distance}"
            p = min(p, of_far / (1.0 - _TO_CAUSES))
            if of_far < (1.0 - _TO_CAUSES) * level:
                said = [*said, f"test {tests[far.test]['name']} lies {distance}"]
        p = min(1.0, float(p))
        enough = bool(np.sum(~np.isnan(scores[:, k])) >= _FEWEST)
        of, against, shows = _POPULATION if k < n else _LAW
        checks.append(
            Check(
                POPULATION if k < n else LAW,
                f"{of} {name}",
                shown,
                f"p {significant(level, 2)}",
                p,
                bool(said),
                shows,
                f"{of} {name}: {against}: {'; '.join(said)} ({probability(p)})",
                "" if enough else _FEW_TESTS,
                dependence=f"{name}: {depends}" if depends else "",
            )
        )
    return checks


def _explained_by_others(
    scores: FloatArray,
    names: Sequence[str],
    tests: Sequence[Mapping[str, Any]],
    explained: Collection[tuple[str, str]],
    limit: float,
    concerned: Sequence[int],
) -> list[int]:
    """Return the indices in `concerned` of parameters whose apparent effects are explained by other parameters.

    A change in one parameter also shifts the scores of every other parameter that affects the same modes. So the
    parameter with the strongest effect is removed, its scores are regressed out of the rest, and this is repeated
    until no effect has p < `limit`.
    """
    left, z = list(concerned), scores
    while left:
        effects = find_effects(z[:, left], [names[k] for k in left], tests, explained)
        best = int(np.argmax(effects.sizes.max(axis=1)))
        if effects.p[best].min() >= limit:
            break
        z = _regress_out(z, left.pop(best))
    return left


def _regress_out(scores: FloatArray, k: int) -> FloatArray:
    """Return the scores (n_tests, n_parameters), with parameter `k`'s scores regressed out of the others."""
    z = scores - np.nanmean(scores, axis=0)
    by = np.nan_to_num(z[:, k])
    slopes = np.nansum(z * by[:, None], axis=0) / np.sum(by**2)
    slopes[k] = 0.0
    return np.asarray(z - by[:, None] * slopes)


def standard_scores(group: xr.Dataset) -> FloatArray:
    """Return scores that are standard normal if the model is correct, (n_tests, n_populations).

    Scores of probable outliers, and scores that the data hardly inform, are NaN. For populations that are
    correlated in time, innovations replace the scores.
    """
    mean, sd = (group[name].transpose("test", "population").to_numpy() for name in ("score", "score_sd"))
    informed = 1.0 - sd**2
    if "outlier" in group:
        informed = np.where(group["outlier"].to_numpy()[:, None] > _OUTLIER, 0.0, informed)
    with np.errstate(invalid="ignore", divide="ignore"):
        found = np.where(informed > _INFORMED, mean / np.sqrt(informed), np.nan)
    if "innovation" not in group:
        return found
    e = group["innovation"].transpose("test", "population").to_numpy()
    return np.where(np.isnan(e), found, e)


def effective_parameters(trace: xr.DataTree) -> int:
    """Return the effective number of parameters in a trace, rounded to an integer.

    A test score counts as the fraction of its prior variance that the data remove; any other parameter counts as
    one.
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
    """The test whose score is farthest from the scores' mean.

    `test` is its index, `distance` is in standard deviations of the scores, and `p` is the p-value of Grubbs's
    test.
    """

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
