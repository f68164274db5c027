import numpy as np
import pytest

from fmu.analysis.trace.distinct_draws import DistinctDraws, evaluate_in_parts


def walk(rng, chains, steps, walkers):
    """Walkers that stay where they are in two steps of three."""
    x = rng.standard_normal((chains, steps, walkers, 2))
    stays = rng.uniform(size=(chains, steps, walkers)) < 2 / 3
    for t in range(1, steps):
        x[:, t] = np.where(stays[:, t, :, None], x[:, t - 1], x[:, t])
    stays[:, 0] = False
    return x.reshape(chains, steps * walkers, 2), int(np.sum(~stays))


@pytest.mark.parametrize("walkers", [1, 5])
def test_each_distinct_draw_is_evaluated_once_and_in_bounded_batches(walkers):
    position, n_distinct = walk(np.random.default_rng(1), 3, 50, walkers)
    asked = []

    def function(theta):
        asked.append(theta)
        return np.stack([theta.sum(axis=1), theta[:, 0]], axis=1)

    values = DistinctDraws.of(position, walkers).evaluate(function, batch=16)
    np.testing.assert_array_equal(values, np.stack([position.sum(axis=-1), position[..., 0]], axis=-1))
    assert sum(map(len, asked)) == n_distinct
    assert max(map(len, asked)) == 16


def test_draws_that_share_a_coordinate_are_distinct():
    position = np.array([[[1.0, 2.0], [1.0, 3.0], [0.0, 3.0]]])
    np.testing.assert_array_equal(DistinctDraws.of(position).theta, position[0])


def test_a_chain_is_not_joined_to_its_neighbour():
    position = np.ones((2, 3, 2))  # both chains stand still at the same point
    distinct = DistinctDraws.of(position)
    assert len(distinct.theta) == 2
    np.testing.assert_array_equal(distinct.inverse, [[0, 0, 0], [1, 1, 1]])


def test_draws_of_many_parameters_are_evaluated_few_at_a_time():
    """Memory: a thousand tests have thousands of parameters, and each draw is a thousand solves."""
    sizes, theta = [], np.random.default_rng(0).standard_normal((150, 4000))

    def total(theta, other):
        sizes.append(len(theta))
        return theta.sum(axis=1) + other

    np.testing.assert_array_equal(evaluate_in_parts(total, theta, theta[:, 0]), theta.sum(axis=1) + theta[:, 0])
    assert len(sizes) > 1
    assert 4000 * max(sizes) <= 2**18
