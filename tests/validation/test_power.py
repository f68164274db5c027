from tests.validation.bands import UniformRanks
from tests.validation.power import detection_rate

UNIFORM = UniformRanks(replicates=80, largest=15)


def test_a_correct_posterior_raises_an_alarm_at_the_level():
    assert 0.02 < detection_rate(UNIFORM, 0.05) <= 0.08


def test_what_is_more_wrong_is_found_more_often():
    by_shift = [detection_rate(UNIFORM, 1e-4, shift=x) for x in (0.0, 0.4, 0.8)]
    by_factor = [detection_rate(UNIFORM, 1e-4, factor=x) for x in (1.0, 1.5, 3.0)]
    assert by_shift == sorted(by_shift)
    assert by_factor == sorted(by_factor)
    assert min(by_shift[-1], by_factor[-1]) > 0.9
