"""The experiments with a model that may be wrong: what is compared, and what the page says."""

from dataclasses import replace

import numpy as np
import pytest

from fmu.analysis.held_out.modes import kept_table
from fmu.paper.run import file_names
from fmu.paper.studies.wrong_model import (
    WITH,
    WITHOUT,
    allow_for_scatter,
    modes_table,
    plot_wrong_model,
    summary_table,
    wrong_model_page,
)
from fmu.paper.summary import summary_page


@pytest.fixture
def study(wrong_model):
    return wrong_model[1]


def test_only_the_scatter_is_added(result):
    """With a scatter of nothing, the density is the paper's."""
    plain, wrong = result.problem, allow_for_scatter(result.problem)
    assert wrong.names == (*plain.names, "tau")
    theta = plain.sample_prior(np.random.default_rng(1), 5)
    none = np.column_stack([theta, np.zeros(5)])
    np.testing.assert_allclose(wrong.log_likelihood(none), plain.log_likelihood(theta), rtol=1e-10)


def test_predictions_are_those_of_modes_left_out(result, wrong_model, study, left_out):
    """The model is updated again without each mode, as long as it takes."""
    sampled = {WITHOUT: result.long["mixture"], WITH: wrong_model[0]}
    assert len(left_out) == 2
    for model, ((trace, problem, seconds), known) in zip((WITHOUT, WITH), left_out, strict=True):
        assert trace is sampled[model]
        assert ("tau" in problem.names) == (model == WITH)
        assert seconds == np.inf
        table = kept_table(known)
        assert set(table["method"]) == {"refit"}
        np.testing.assert_array_equal(study.modes[f"{model}_mean"], table["mean"])
        off = (table["measured"] - study.modes[f"{model}_mean"]) / study.modes[f"{model}_sd"]
        np.testing.assert_allclose(study.modes[f"{model}_off"], off)
    # the paper's model misses all modes by shape; with the scatter they are within their intervals
    assert study.runs.loc[WITHOUT, "inside"] == 0
    assert study.runs.loc[WITH, "inside"] == 5
    assert np.isnan(study.parameters.loc["tau", "without_mean"])
    assert 0.01 < study.parameters.loc["tau", "with_mean"] < 0.12


def test_pages_and_figure(study, findings, plan):
    page = wrong_model_page([study, study])
    assert page.startswith("# A model that may be wrong")
    assert page.count("## Section 5.2, paired by shape") == 2
    assert "With scatter: **not converged**" in page
    assert "| section 5.2, paired by shape | 0 of 5 | 5 of 5 |" in summary_table([study])
    first = modes_table(study).splitlines()[2]
    assert first.startswith("| 1 | 31.9 | 2")
    assert len(plot_wrong_model([study, study, study]).axes) == 4
    summary = summary_page([replace(findings, wrong=study)], "", 1, {})
    assert "[model-error.md](model-error.md)" in summary
    assert summary_table([study]) in summary
    assert "model-error.md)" not in summary_page([findings], "", 1, {})
    assert {"model-error.md", "model-error.csv", "model-error.png"} < set(file_names(plan))
