"""The gates of the study of verdicts on the model, and the building that it simulates."""

import numpy as np
import pytest

from fmu.analysis.fit.check import PREDICTED
from fmu.analysis.fit.model_fit import CONTRADICTED, NOT_CONTRADICTED, NOT_TESTABLE
from tests.validation import fit_page
from tests.validation.fit import CURVES, FEW_ONES, RIGHT_ONES, Building, Outcome, Rate, Setting, Study, true_hz


def rate(setting, contradicted, otherwise=NOT_CONTRADICTED):
    verdicts = [CONTRADICTED] * contradicted + [otherwise] * (setting.n - contradicted)
    return Rate(setting, [Outcome(verdict, frozenset({PREDICTED}), True, 1.0) for verdict in verdicts])


def study(false=2, found=20, few=NOT_TESTABLE):
    right = [rate(setting, false if k == 0 else 0) for k, setting in enumerate(RIGHT_ONES)]
    few_ones = [rate(setting, 0, NOT_CONTRADICTED if setting.held_out else few) for setting in FEW_ONES]
    curves = {name: [rate(setting, found) for setting in curve] for name, curve in CURVES.items()}
    return Study(right, few_ones, curves)


def test_the_gates():
    assert study().failures == []
    assert study(false=30).failures[0].startswith("true values drawn from the priors: 30 of 300")
    assert len(study(found=10).failures) == len(CURVES)
    assert any("neither “not testable”" in failure for failure in study(few=NOT_CONTRADICTED).failures)


def test_the_interval_is_exact():
    found = study(false=0).right[0]
    low, high = found.interval
    assert low == 0.0
    assert (1.0 - high) ** found.n == pytest.approx(0.025)


def test_the_truth_is_what_the_model_can_be_where_it_is_right():
    theta = np.array([1.1, 0.9, 1.2])
    building = Building(6)
    right = true_hz(Setting("right", 1), theta)
    np.testing.assert_allclose(building.frequencies(theta[None])[0], right[:6], rtol=1e-10)
    assert true_hz(Setting("mass", 1, mass=0.2), theta)[0] < right[0]
    assert true_hz(Setting("soft", 1, soft=0.2), theta)[0] < right[0]
    step = 1e-6 * np.eye(3)
    by_differences = (building.frequencies(theta + step) - building.frequencies(theta - step)).T / 2e-6
    np.testing.assert_allclose(building.frequencies_and_gradient(theta[None])[1][0], by_differences, rtol=1e-6)


def test_page_and_figure(tmp_path):
    fit_page.write(study(), tmp_path)
    text = (tmp_path / "fit.md").read_text(encoding="utf-8")
    assert "**2 of 300 simulated problems with a correct model were contradicted." in text
    assert "All gates pass.**" in text
    assert (tmp_path / "fit" / "rates.png").stat().st_size > 10_000
