"""The study with a β for every mode: its weights, its tables, and what is said of mode 1."""

import json
from dataclasses import replace

import numpy as np
import pytest

from fmu.analysis.convergence.diagnosis import maxima_of
from fmu.analysis.trace.reading import parameter_draws
from fmu.paper.run import file_names
from fmu.paper.studies.vector_beta import (
    outcome,
    plot_vector_beta,
    relative_weights,
    sample_weighted,
    side_by_side,
    vector_beta_page,
)
from fmu.paper.summary import summary_page

MEASURED = np.array([31.9, 197.9, 553.0, 1082.2, 1781.5])


@pytest.fixture(scope="module")
def told():
    return []


@pytest.fixture(scope="module")
def weighted(result, plan, told):
    return sample_weighted(result, plan, lambda *message: told.append(message))


@pytest.fixture(scope="module")
def study(result, weighted):
    return side_by_side(result, weighted)


@pytest.fixture
def judged(study):
    """The study with the given errors of mode 1, and both runs converged unless said otherwise."""

    def make(scalar, vector, converged=(True, True)):
        modes = study.modes.copy()
        modes.loc["1", ["scalar_error", "vector_error"]] = scalar, vector
        return replace(study, modes=modes, runs=study.runs.assign(converged=converged))

    return make


def test_weights_by_hand():
    # 1 % of 200 Hz is 2 Hz, and 1/(2·2²) = 1/8
    np.testing.assert_allclose(relative_weights(np.array([200.0, 50.0])), [0.125, 2.0])


def test_only_the_weights_differ_from_the_long_run(result, weighted):
    mine, long = (json.loads(trace.attrs["configuration"]) for trace in (weighted, result.long["hmc"]))
    assert mine["problem"]["likelihood"] != long["problem"]["likelihood"]
    np.testing.assert_allclose(mine["problem"]["likelihood"]["beta"], 0.5 / (0.01 * MEASURED) ** 2)
    for configuration in (mine, long):
        del configuration["problem"]["likelihood"]
    assert mine == long


def test_verdicts_know_the_maxima_of_the_weighted_posterior(result, weighted):
    assert maxima_of(weighted)[0].log_prob != pytest.approx(result.maxima[0].log_prob, abs=1.0)


def test_frequencies_are_those_at_the_means(result, weighted, study):
    for name, trace in (("scalar", result.long["hmc"]), ("vector", weighted)):
        mean = parameter_draws(trace).mean(axis=(0, 1))
        np.testing.assert_allclose(study.parameters[f"{name}_mean"], mean)
        expected = result.problem.frequencies(mean)
        np.testing.assert_allclose(study.modes[f"{name}_hz"], expected)
        np.testing.assert_allclose(study.modes[f"{name}_error"], 100 * np.abs(expected / MEASURED - 1))
    np.testing.assert_allclose(study.modes["scalar_sigma_hz"], np.sqrt(0.5))
    np.testing.assert_allclose(study.modes["vector_sigma_hz"], 0.01 * MEASURED)


def test_published_and_initial_columns(study):
    np.testing.assert_array_equal(study.modes["published_error"], [1.08, 2.06, 1.4, 0.48, 0.51])
    np.testing.assert_allclose(study.modes["initial_hz"].iloc[0], 32.0, atol=0.01)


def test_short_runs_are_not_judged(study):
    assert not study.runs["converged"].any()
    assert study.outcome == "cannot be judged"
    assert "**no**" in vector_beta_page([study])
    assert all(study.reasons.values())


def test_mode_1_decides(judged):
    assert judged(5.5, 0.1).outcome == "confirmed"
    assert judged(0.1, 0.2).outcome == "not confirmed"
    assert judged(5.5, 0.1, converged=(True, False)).outcome == "cannot be judged"
    words = outcome(judged(5.5, 0.1))
    assert words.startswith(
        "section 5.2, paired by shape: confirmed. Mode 1 is off by 0.32 % before updating, 5.50 %"
    )
    assert "and 0.10 % with the vector" in words


def test_page_and_figure(judged, findings):
    study = judged(5.5, 0.1)
    page = vector_beta_page([study, study])
    assert page.startswith("# A β for every mode")
    assert "Choosing β as a vector, to weight the natural frequencies, would improve" in page
    assert page.count("## Section 5.2, paired by shape") == 2
    assert f"{study.modes.loc['2', 'vector_hz']:.2f} | {study.modes.loc['2', 'vector_error']:.2f} |" in page
    assert "| Ix1 / mm⁴ |" in page
    assert len(plot_vector_beta([study, study]).axes) == 2
    summary = summary_page([replace(findings, weighted=study)], (40, 40), 1, {})
    assert "([vector-beta.md](vector-beta.md))" in summary
    assert outcome(study) in summary
    assert "vector-beta.md)" not in summary_page([findings], (40, 40), 1, {})


def test_files_only_where_there_is_a_study(plan):
    assert {"vector-beta.md", "vector-beta.csv", "vector-beta.png"} < set(file_names(plan))
    assert not any("vector-beta" in name for name in file_names(replace(plan, weighted=())))


def test_progress_is_a_phase_of_its_own_that_ends(weighted, plan, told):
    assert {phase for phase, *_ in told} == {"section-shape, vector β"}
    steps = plan.long["hmc"].steps
    # the last step of a run is reported again, with the numbers of the verdict
    assert [done for _, done, *_ in told] == [*range(1, steps), steps - 1, steps - 1, steps]
    assert {total for _, _, total, _ in told} == {plan.long["hmc"].steps}
