"""Expected information of sensors against direct formulas, and choices against exhaustive search."""

from itertools import combinations

import numpy as np
import pytest

from fmu.analysis.plan.sensors.bound import relax
from fmu.analysis.plan.sensors.choice import Limits, choose, exchange, greedy, near_pairs
from fmu.analysis.plan.sensors.information import Readings

N, Q, M, P = 3, 12, 4, 3


@pytest.fixture
def rng():
    return np.random.default_rng(1)


def readings(rng, groups=None, target=None):
    """Return readings of Q rows, of which the last is the empty one."""
    shapes, slopes = rng.standard_normal((N, Q + 1, M)) * 30.0, rng.standard_normal((N, Q + 1, M, P)) * 20.0
    shapes[:, -1], slopes[:, -1] = 0.0, 0.0
    prior = np.eye(P) + np.einsum("npi,nqi->npq", (a := rng.standard_normal((N, P, 2))), a)
    groups = np.arange(Q)[:, None] if groups is None else np.array(groups)
    return Readings(prior, shapes, slopes, groups, target)


def marginal(found, rows):
    """Return the information about the parameters by inverting the joint covariance with the scales of modes."""
    matrices = []
    for i in range(N):
        joint = np.zeros((P + M, P + M))
        joint[:P, :P] = found.prior[i]
        for row in rows:
            for m in range(M):
                line = np.zeros(P + M)
                line[:P], line[P + m] = found.slopes[i, row, m], found.shapes[i, row, m]
                joint += np.outer(line, line)
        matrices.append(np.linalg.inv(np.linalg.inv(joint)[:P, :P]))
    return np.array(matrices)


def test_rank_one_updates_give_the_information_without_the_scales(rng):
    found, rows = readings(rng), [3, 7, 1, 8, 11]
    np.testing.assert_allclose(found.with_sensors(rows).matrix, marginal(found, rows), rtol=1e-9)


@pytest.mark.parametrize("t", [None, 1, 2])
@pytest.mark.parametrize("groups", [None, [[0, 1, 2], [3, 4, -1], [5, -1, -1], [6, 7, 8], [9, 10, 11]]])
def test_gains_are_differences_of_values(rng, t, groups):
    found = readings(rng, groups, None if t is None else rng.standard_normal((N, t, P)))
    state = found.with_sensors([0, 2])
    expected = [found.value(found.with_sensors([k], state)) - found.value(state) for k in range(len(found.groups))]
    np.testing.assert_allclose(found.gains(state), expected, rtol=1e-9, atol=1e-10)


def test_value_of_a_target_is_the_information_about_it(rng):
    target = rng.standard_normal((N, 1, P))
    found = readings(rng, target=target)
    state = found.with_sensors([1, 4, 6])
    covariance = np.linalg.inv(marginal(found, [1, 4, 6]))
    left = [float(t[0] @ c @ t[0]) for t, c in zip(target, covariance, strict=True)]
    before = np.sum(target[:, 0] ** 2, axis=1)
    assert found.value(state) == pytest.approx(0.5 * np.mean(np.log(before / left)), rel=1e-9)


def test_one_sensor_tells_nothing_of_shapes_of_unknown_scale(rng):
    found = readings(rng)
    np.testing.assert_allclose(found.with_sensors([5]).matrix, found.prior, rtol=1e-12)


@pytest.mark.parametrize("t", [None, 1])
def test_no_choice_exceeds_the_bound_and_exchanges_find_the_best(rng, t):
    missed = []
    for _ in range(6):
        found = readings(rng, target=None if t is None else rng.standard_normal((N, t, P)))
        limits = Limits(4, (), np.ones(Q))
        best = max(found.value_of(one) for one in combinations(range(Q), 4))
        relaxed = relax(found, limits)
        assert best <= relaxed.bound + 1e-9
        chosen = choose(found, limits, [np.argsort(-relaxed.weights).tolist()])
        missed.append(best - found.value_of(chosen))
        assert relaxed.bound < 1.2 * best
    assert np.sum(np.array(missed) > 1e-9) <= 1
    assert max(missed) < 0.05 * best


def test_mounted_sensors_stay_and_count(rng):
    found, limits = readings(rng), Limits(3, (2, 5), np.ones(Q))
    chosen = choose(found, limits)
    assert len(chosen) == 3
    assert not set(chosen) & {2, 5}
    best = max(found.value_of([2, 5, *one]) for one in combinations([k for k in range(Q) if k not in (2, 5)], 3))
    assert found.value_of([2, 5, *chosen]) == pytest.approx(best, rel=0.02)
    assert best <= relax(found, limits).bound + 1e-9


def test_costs_keep_to_the_budget_and_the_bound(rng):
    found, cost = readings(rng), rng.uniform(0.5, 3.0, Q)
    limits = Limits(Q, (), cost, budget=5.0)
    chosen = choose(found, limits)
    assert np.sum(cost[list(chosen)]) <= 5.0
    every = [c for k in range(2, 8) for c in combinations(range(Q), k) if np.sum(cost[list(c)]) <= 5.0]
    best = max(found.value_of(one) for one in every)
    assert found.value_of(chosen) > 0.9 * best
    assert best <= relax(found, limits).bound + 1e-9


def test_sensors_keep_their_distance(rng):
    found = readings(rng)
    near = near_pairs(np.stack([np.arange(Q), np.zeros(Q), np.zeros(Q)], axis=1).astype(float), 3.0)
    chosen = choose(found, Limits(4, (), np.ones(Q), near=near))
    assert np.min(np.diff(sorted(chosen))) >= 3
    assert len(chosen) == 4


def test_only_accepted_choices_are_returned(rng):
    found, limits = readings(rng), Limits(4, (), np.ones(Q))
    chosen = choose(found, limits, [[0, 1, 2, 3]], lambda one: 0 in one)
    assert 0 in chosen
    assert choose(found, limits, (), lambda one: False) is None
    assert found.value_of(exchange(found, limits, greedy(found, limits))) >= found.value_of(greedy(found, limits))
