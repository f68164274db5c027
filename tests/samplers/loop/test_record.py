import numpy as np
import pytest

from fmu.samplers.loop.record import Record, Steps


def steps(first, n, chains=2, walkers=1, ndim=3, **more):
    """Steps whose numbers tell which chain, step, walker and coordinate they are of."""
    chain, step, walker, i = np.ogrid[:chains, first : first + n, :walkers, :ndim]
    position = 1000.0 * chain + step + 0.1 * walker + 0.01 * i
    return Steps(position, {"lp": position[..., 0], **more})


def test_what_is_written_is_there():
    record = Record(2, 1, 3)
    record.reserve(10)
    for first, n in ((0, 4), (4, 1), (5, 5)):
        record.write(first, 0, steps(first, n))
    np.testing.assert_array_equal(record.steps(0, 10).position, steps(0, 10).position)
    np.testing.assert_array_equal(record.steps(3, 7).stats["lp"], steps(3, 4).stats["lp"])
    assert len(record.steps(3, 7)) == 4


def test_groups_write_their_own_chains_in_any_order():
    record = Record(4, 1, 3)
    record.reserve(6)
    whole = steps(0, 6, chains=4)
    for first_chain, first, stop in ((2, 0, 6), (0, 0, 2), (0, 2, 6)):
        part = slice(first_chain, first_chain + 2), slice(first, stop)
        own = Steps(whole.position[part], {name: x[part] for name, x in whole.stats.items()})
        record.write(first, first_chain, own)
    np.testing.assert_array_equal(record.steps(0, 6).position, whole.position)
    np.testing.assert_array_equal(record.steps(1, 4, slice(2, 4)).stats["lp"], whole.stats["lp"][2:, 1:4])


def test_more_room_keeps_what_is_there_and_what_was_returned():
    record = Record(2, 1, 3)
    record.reserve(2)
    record.write(0, 0, steps(0, 2))
    before = record.draws(2)
    kept = before.position.copy()
    record.reserve(5)
    record.write(2, 0, steps(2, 3))
    np.testing.assert_array_equal(before.position, kept)
    np.testing.assert_array_equal(record.draws(5).position[:, :2], kept)
    np.testing.assert_array_equal(record.draws(5).position, steps(0, 5).position[:, :, 0])


def test_less_room_than_there_is_changes_nothing():
    record = Record(2, 1, 3)
    record.reserve(4)
    record.write(0, 0, steps(0, 4))
    record.reserve(1)
    np.testing.assert_array_equal(record.steps(0, 4).position, steps(0, 4).position)


def test_the_walkers_of_a_step_follow_one_another():
    record = Record(2, 4, 3)
    record.reserve(5)
    whole = steps(0, 5, walkers=4)
    record.write(0, 0, whole)
    draws = record.draws(5)
    assert draws.position.shape == (2, 20, 3)
    np.testing.assert_array_equal(draws.position[1, 6], whole.position[1, 1, 2])
    np.testing.assert_array_equal(draws.stats["lp"][1, 6], whole.stats["lp"][1, 1, 2])
    assert record.draws(3).position.shape == (2, 12, 3)


@pytest.mark.parametrize("kind", [bool, np.int64, np.float32])
def test_statistics_keep_their_kind(kind):
    record = Record(2, 1, 3)
    record.reserve(3)
    values = np.arange(6).reshape(2, 3, 1).astype(kind)
    record.write(0, 0, steps(0, 3, flag=values))
    assert record.draws(3).stats["flag"].dtype == kind
    np.testing.assert_array_equal(record.draws(3).stats["flag"], values[..., 0])


def test_a_statistic_may_be_a_vector():
    record = Record(2, 1, 3)
    record.reserve(3)
    values = np.arange(24.0).reshape(2, 3, 1, 4)
    record.write(0, 0, steps(0, 3, rungs=values))
    np.testing.assert_array_equal(record.draws(3).stats["rungs"], values[:, :, 0])


def test_a_statistic_that_comes_later_was_nought_before():
    record = Record(2, 1, 3)
    record.reserve(3)
    record.write(0, 0, steps(0, 1))
    record.write(1, 0, steps(1, 2, late=np.ones((2, 2, 1))))
    np.testing.assert_array_equal(record.draws(3).stats["late"], [[0, 1, 1]] * 2)


def test_nothing_is_nothing():
    draws = Record(2, 4, 3).draws(0)
    assert draws.position.shape == (2, 0, 3)
    assert draws.stats == {}
