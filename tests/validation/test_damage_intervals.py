"""The study of intervals of losses: it counts what it was given, and is red where intervals hold too little."""

import pytest

from tests.validation.damage_intervals import DAMAGES, DataSet, page


@pytest.mark.parametrize(("missed", "passed"), [(12, True), (40, False)])
def test_misses_are_counted(missed, passed):
    """Of 100 data sets the interval of k1 misses in some; in the first of them that of k3, too."""
    found, alarm = [], [False, True, False, False]
    for seed in range(100):
        inside = [seed >= missed, True, seed > 0, True]
        found.append(DataSet(seed, dict.fromkeys(DAMAGES, inside), dict.fromkeys(DAMAGES, alarm)))
    text, is_good = page(found)
    assert is_good == passed
    assert f"| 90 % interval of k1 holds the truth | {100 - missed} | {100 - missed} |" in text
    assert f"| 1 of the four intervals misses the truth | {missed - 1} | {missed - 1} |" in text
    assert "| 2 of the four intervals miss the truth | 1 | 1 |" in text
    assert "in storey 2 and no other | 100 | 100 |" in text
