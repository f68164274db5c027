"""R-hat, ESS and the tail of weights are ArviZ's numbers, to rounding."""

import warnings

import numpy as np
import pytest
from arviz_stats.base import array_stats

from fmu.analysis.convergence import effective
from fmu.analysis.convergence.pareto import pareto_k, smoothed_weights
from fmu.analysis.convergence.rank_statistics import (
    chain_ess,
    normal_scores,
    potential_scale_reduction,
    quantile_ess,
    rank_ess,
    rank_rhat,
    split_chains,
)

AXES = {"chain_axis": 0, "draw_axis": 1}
SHAPES = [
    (1, 4),
    (2, 4),
    (1, 5),
    (4, 5),
    (4, 6),
    (3, 7),
    (2, 11),
    (4, 99),
    (1, 100),
    (4, 1000),
    (8, 333),
    (20, 50),
]


def chains(rng, shape, kind):
    x = rng.standard_normal(shape)
    if kind == "correlated":
        for k in range(1, shape[1]):
            x[:, k] += 0.95 * x[:, k - 1]
    if kind == "alternating":
        for k in range(1, shape[1]):
            x[:, k] -= 0.9 * x[:, k - 1]
    if kind == "heavy":
        x = np.exp(3.0 * x)
    if kind == "apart":
        x += 10.0 * np.arange(shape[0])[:, None]
    if kind == "ties":
        x = np.round(x)
    if kind == "standing":
        x[:, shape[1] // 2 :] = x[:, shape[1] // 2, None]
    if kind == "one chain stands":
        x[0] = 0.3
    return x


KINDS = ("independent", "correlated", "alternating", "heavy", "apart", "ties", "standing", "one chain stands")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("shape", SHAPES)
def test_formulas_are_those_of_arviz(shape, kind):
    rng = np.random.default_rng([*shape, KINDS.index(kind)])
    for _ in range(5):
        x = chains(rng, shape, kind)
        if np.ptp(x) == 0:
            continue
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            expected = [
                array_stats.rhat(x, method="rank", **AXES) if shape[0] > 1 else np.nan,
                array_stats.rhat(x, method="identity", **AXES) if shape[0] > 1 else np.nan,
                array_stats.ess(x, method="bulk", **AXES),
                array_stats.ess(x, method="mean", **AXES),
                array_stats.ess(x, method="identity", **AXES),
                array_stats.ess(x, method="quantile", prob=0.05, **AXES),
                array_stats.ess(x, method="quantile", prob=0.95, **AXES),
            ]
            found = [
                rank_rhat(x) if shape[0] > 1 else np.nan,
                potential_scale_reduction(x) if shape[0] > 1 else np.nan,
                rank_ess(x),
                chain_ess(split_chains(x)),
                chain_ess(x),
                quantile_ess(x, 0.05),
                quantile_ess(x, 0.95),
            ]
        np.testing.assert_allclose(found, np.array(expected, dtype=float), rtol=1e-11)


def test_scores_of_ties_are_those_of_their_mean_rank():
    x = np.array([[3.0, 1.0, 3.0], [7.0, 1.0, 3.0]])
    scores = normal_scores(x)
    assert np.ptp(scores[x == 3.0]) == 0
    np.testing.assert_allclose(scores[x == 3.0], normal_scores(np.arange(6.0))[3], atol=1e-15)
    assert scores[1, 0] == scores.max()


def test_energies_are_measured_as_arviz_measures_them():
    energy = np.cumsum(np.random.default_rng(2).standard_normal((4, 301)), axis=1)
    np.testing.assert_allclose(effective.energy_fraction(energy), array_stats.bfmi(energy, **AXES), rtol=1e-13)


@pytest.mark.parametrize("efficiency", [1.0, 0.37, 0.02])
@pytest.mark.parametrize("n", [26, 227, 230, 1000, 4001])
def test_tails_are_those_of_arviz(n, efficiency):
    rng = np.random.default_rng(n)
    for heaviness in (0.0, 0.1, 1.0, 3.0):
        log_w = heaviness * rng.exponential(size=n) + 1e-3 * rng.standard_normal(n) - 700.0
        log_w[rng.integers(n, size=n // 10)] = -np.inf
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                weights, k = array_stats.psislw(-log_w, r_eff=efficiency)
            except (ValueError, IndexError):
                with pytest.raises(ValueError, match="log_w"):
                    smoothed_weights(log_w, efficiency)
                continue
            found, shape = smoothed_weights(log_w, efficiency)
        np.testing.assert_allclose(shape, float(k), rtol=1e-11)
        np.testing.assert_allclose(found, weights, rtol=1e-11)
        np.testing.assert_allclose(pareto_k(log_w), array_stats.psislw(-log_w)[1], rtol=1e-11)


def test_tails_without_a_shape():
    assert pareto_k(np.zeros(1000)) == -np.inf
    assert pareto_k(np.append(np.full(500, -1.0), np.zeros(500))) == np.inf
    assert pareto_k(np.array([0.0, 1.0, 2.0])) == np.inf  # too few for a tail
    far = np.append(np.linspace(-2.0, -1.0, 800), np.append(np.full(100, -0.5), np.zeros(1)))
    with pytest.raises(ValueError, match="at least 5 weights"):
        smoothed_weights(np.array([0.0, 1.0, 2.0]))
    assert np.isnan(pareto_k(far)) == np.isnan(float(array_stats.psislw(-far)[1]))
