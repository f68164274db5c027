"""The calibration of τ, σ and ρ: the simulated building is that of the model, and a wrong density is rejected."""

import dataclasses

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import stats

from tests.shear_building import frequencies_hz, shear_building
from tests.validation import hyper_parameters as study

SETS = 12
"""Sets of data. The p-values of the Kolmogorov–Smirnov test are exact for so few."""


def test_the_closed_form_is_the_model():
    model = shear_building(["k"] * study.STOREYS)
    assert_allclose(study.frequencies(1.3), frequencies_hz(model, np.array([1.3]))[0], rtol=1e-12)


@pytest.mark.parametrize("kind", study.KINDS)
def test_probabilities_are_uniform_and_those_of_another_prior_are_not(kind, monkeypatch):
    def values():
        rng = np.random.default_rng(5)
        return np.array([study.probabilities_below(kind, *study.simulate(rng, kind)) for _ in range(SETS)])

    coarse = {"embedded": (24, 20), "correlated": (16, 16, 6), "modes": (16, 16, 6)}
    monkeypatch.setattr(study, "GRID", coarse)
    assert all(stats.kstest(one, "uniform").pvalue > 1e-4 for one in values().T)
    too_small = dataclasses.replace(study.KINDS[kind], prior_sd=study.PRIOR_SD / 5.0)
    monkeypatch.setitem(study.KINDS, kind, too_small)
    assert stats.kstest(values()[:, 1], "uniform").pvalue < 1e-4
