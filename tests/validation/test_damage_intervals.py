"""The study of damage intervals counts misses, and fails if intervals contain the true loss too rarely."""

import pytest

from tests.validation.damage_intervals import DAMAGES, DataSet, page


@pytest.mark.parametrize(("missed", "passed"), [(12, True), (40, False)])
def test_misses_are_counted(missed, passed):
    """The interval of storey 1 misses in the first data sets, and the interval of storey 3 in the very first."""
    found, alarm = [], [False, True, False, False]
    for seed in range(100):
        inside = [seed >= missed, True, seed > 0, True]
        found.append(DataSet(seed, dict.fromkeys(DAMAGES, inside), dict.fromkeys(DAMAGES, alarm)))
    text, is_good = page(found)
    assert is_good == passed
    assert f"| interval of storey 1 contains the true loss | {100 - missed} | {100 - missed} |" in text
    assert f"| 1 of the four intervals misses the true loss | {missed - 1} | {missed - 1} |" in text
    assert "| 2 of the four intervals miss the true loss | 1 | 1 |" in text
    assert "in storey 2 and no other | 100 | 100 |" in text
