"""The study of structures whose model is wrong: the model is right where it should be, and the gates can fail."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tests.validation.wrong_beam import HELD, MODES, SIZES, frequencies, problem, simulate, told
from tests.validation.wrong_structures import Structure
from tests.validation.wrong_structures_page import KINDS, Study, page


@pytest.fixture(scope="module")
def updating():
    f = np.sort(frequencies(np.ones(2)))
    return problem(f, 0.01 * f)


@pytest.mark.parametrize("kind", sorted(set(KINDS)))
def test_the_model_misses_the_structure_by_its_error_alone(updating, kind):
    rng = np.random.default_rng(3)
    order, z = np.argsort(frequencies(np.ones(2))), []
    for _ in range(25):
        made = simulate(rng, kind)
        z.append((updating.frequencies(made.moduli) - made.measured[order]) / made.sd[order])
        assert (made.size == 0.0) == (kind == "right")
    assert np.shape(z) == (25, MODES)
    if kind == "right":
        assert_allclose(np.mean(np.square(z)), 1.0, atol=5.0 * np.sqrt(2.0 / np.size(z)))
    else:
        assert np.mean(np.square(z)) > 1.2


def test_a_group_can_be_told_by_its_change_of_the_frequencies():
    sd = 0.01 * frequencies(np.ones(2))
    signals = [told("thickness", size, sd)[0] for size in (0.03, 0.06)]
    assert_allclose(signals[1], 2.0 * signals[0])
    assert_allclose(told("thickness", 0.03, 2.0 * sd)[0], 0.5 * signals[0], rtol=0.05)
    assert all(told(kind, 0.03, sd)[1] < 0.9 for kind in HELD)


def _structures(share=0.9, wider=1.1, found=0.9, signal=4.0, contradicted="not contradicted"):
    """Return structures of all kinds, of whose intervals a share holds its quantity."""
    rng, structures = np.random.default_rng(4), []
    for number in range(270):
        kind = KINDS[number % len(KINDS)]
        parameters, modes = (rng.random((2, n)) < share for n in (2, MODES))
        largest = kind if rng.random() < found else HELD[0]
        one = Structure(
            number, kind, 0.1, signal, 0.5, [True, True], [contradicted] * 2, [], [], [[1.0] * 2, [wider] * 2],
            [1.0, 2.0], [SIZES[group] * (0.5 + (group == largest)) for group in HELD], [0.3] * 3, [0.5] * 3,
        )  # fmt: skip
        structures.append(replace(one, parameters=parameters.tolist(), modes=modes.tolist()))
    return Study(structures)


def test_gates_turn_with_coverage_width_groups_and_false_alarms():
    assert not _structures().failures
    assert len(_structures(share=0.8).failures) == 2
    assert len(_structures(share=0.99).failures) == 2
    assert len(_structures(wider=1.2).failures) == 1
    assert len(_structures(found=0.3).failures) == 1
    assert len(_structures(signal=2.0).failures) == 1
    assert len(_structures(contradicted="contradicted by 3 of 19 checks").failures) == 1
    assert "1.20" in page(_structures(wider=1.2), 300)
