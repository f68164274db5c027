"""The study of structures whose model is wrong: the model is right where it should be, and the gates can fail."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tests.validation.wrong_structures import MODES, Structure, problem, simulate
from tests.validation.wrong_structures_page import KINDS, Study, page


@pytest.mark.parametrize("kind", sorted(set(KINDS)))
def test_the_model_misses_the_structure_by_its_error_alone(kind):
    rng = np.random.default_rng(3)
    updating = problem(*simulate(rng, kind)[1:3], [])
    z = []
    for _ in range(40):
        theta, f, sd, size = simulate(rng, kind)
        z.append((updating.frequencies(theta) - f) / sd)
        assert (size == 0.0) == (kind == "right")
    assert np.shape(z) == (40, MODES)
    mean_square = np.mean(np.square(z))
    if kind == "right":
        assert_allclose(mean_square, 1.0, atol=5.0 * np.sqrt(2.0 / np.size(z)))
    assert np.all(np.abs(z) < 20.0)


def _structures(share, wider):
    """Return structures of all kinds, of whose intervals a share holds its quantity."""
    rng, found = np.random.default_rng(4), []
    for number in range(90):
        parameters, modes = (rng.random((2, n)) < share for n in (4, MODES))
        one = Structure(
            number, KINDS[number % len(KINDS)], 0.1, [True, True], ["contradicted"] * 2, [], [], [], [], []
        )
        widths = [[1.0] * 4, [wider] * 4]
        lists = {"parameters": parameters.tolist(), "modes": modes.tolist(), "widths": widths}
        found.append(replace(one, **lists, tau=[0.1, 0.01], processor_s=[1.0, 2.0]))
    return Study(found)


def test_gates_turn_with_coverage_and_width():
    assert not _structures(0.9, 1.1).failures
    assert len(_structures(0.8, 1.1).failures) == 2
    assert len(_structures(0.99, 1.1).failures) == 2
    assert len(_structures(0.9, 1.2).failures) == 1
    assert "1.20" in page(_structures(0.9, 1.2), 300)
