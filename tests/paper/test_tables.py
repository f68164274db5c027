"""The tables of an experiment hold what its traces and the paper hold."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.linalg as sl

from fmu.paper.convergence import starts_in_the_posterior
from fmu.paper.experiment import agreement, comparison_table
from fmu.paper.page import experiment_page
from fmu.paper.plan import PAPER_SAMPLERS, SAMPLERS, long_start
from tests import cantilever

MEASURED = np.array([31.9, 197.9, 553.0, 1082.2, 1781.5])


def weak_plane(theta):
    """First five weak-plane frequencies from dense matrices, all planes solved together and picked by "
    "motion."""
    updates = {"I1": [("Iy", "1")], "I2": [("Iy", "2")], "A1": [("A", "1")], "A2": [("A", "2")]}
    model = cantilever.beam(2).separable(updates)
    here = [i for i, (_, direction) in enumerate(model.dofs) if direction in ("z", "ry")]
    K, M = (matrix(theta).toarray()[np.ix_(here, here)] for matrix in (model.K, model.M))
    return np.sqrt(sl.eigh(K, M, eigvals_only=True)[:5]) / (2 * np.pi)


def draws_of(trace):
    names = ("Ix1", "Ix2", "Ax1", "Ax2")
    return np.stack([trace["posterior"][name].to_numpy().ravel() for name in names], axis=-1)


def test_published_parameters(findings):
    table = findings.parameters
    np.testing.assert_array_equal(table["published_initial"], [5e-9, 5e-9, 8e-4, 8e-4])
    np.testing.assert_array_equal(table["published_slice"], [7.88e-9, 3.67e-9, 5.62e-4, 8.09e-4])
    assert list(table.index) == ["Ix1", "Ix2", "Ax1", "Ax2"]
    assert list(table["unit"]) == ["m⁴", "m⁴", "m²", "m²"]


@pytest.mark.parametrize("name", SAMPLERS)
def test_means_and_intervals_of_the_long_runs(result, findings, name):
    draws = draws_of(result.long[name])
    table = findings.parameters
    np.testing.assert_allclose(table[f"long_{name}_mean"], draws.mean(axis=0), rtol=1e-12)
    np.testing.assert_allclose(table[f"long_{name}_sd"], draws.std(axis=0, ddof=1), rtol=1e-9)
    np.testing.assert_allclose(table[f"long_{name}_eti90_lb"], np.quantile(draws, 0.05, axis=0), rtol=1e-12)
    np.testing.assert_allclose(table[f"long_{name}_eti90_ub"], np.quantile(draws, 0.95, axis=0), rtol=1e-12)


@pytest.mark.parametrize("name", PAPER_SAMPLERS)
def test_the_papers_protocol_keeps_every_sample_of_one_chain_from_the_start(result, findings, plan, name):
    trace = result.paper[name]
    assert draws_of(trace).shape == (plan.paper.draws, 4)
    assert trace.attrs["init"] == "start"
    assert trace.attrs["warmup"] == 0
    np.testing.assert_allclose(findings.parameters[f"paper_{name}"], draws_of(trace).mean(axis=0), rtol=1e-12)
    assert findings.comparison.loc[name, "paper_solves"] == int(trace["sample_stats"]["n_solves"].sum())


def test_hmc_takes_central_differences_under_the_papers_protocol(result):
    trace = result.paper["hmc"]
    gradients = int(trace["sample_stats"]["n_gradients"].sum())
    # one gradient is 2 ndim solves; the log-probability is asked for at the start and at the end of a trajectory
    assert int(trace["sample_stats"]["n_solves"].sum()) == 8 * gradients + len(trace["sample_stats"]["draw"]) + 1


@pytest.mark.parametrize("source", ["paper_mh", "paper_hmc", "long_slice", "long_emcee"])
def test_frequencies_are_those_at_the_mean(result, findings, source):
    kind, name = source.split("_")
    mean = draws_of(getattr(result, kind)[name]).mean(axis=0)
    expected = weak_plane(mean)
    np.testing.assert_allclose(findings.frequencies[f"{source}_hz"], expected, rtol=2e-6)
    error = 100 * np.abs(expected - MEASURED) / MEASURED
    np.testing.assert_allclose(findings.frequencies[f"{source}_error"], error, atol=2e-4)


def test_published_and_recomputed_frequencies(findings):
    table = findings.frequencies
    np.testing.assert_array_equal(table["published_mh_hz"], [31.3, 195.2, 552.0, 1087.6, 1811.2])
    np.testing.assert_array_equal(table["published_mh_error"], [1.97, 1.34, 0.19, 0.5, 1.67])
    np.testing.assert_allclose(table["recomputed_initial_hz"], weak_plane([7e-9, 7e-9, 8e-4, 8e-4]), rtol=2e-6)
    expected = weak_plane([7.05e-9, 6.36e-9, 8.28e-4, 8.46e-4])
    np.testing.assert_allclose(table["recomputed_mh_hz"], expected, rtol=2e-6)
    error = 100 * np.abs(expected - MEASURED) / MEASURED
    np.testing.assert_allclose(table["recomputed_mh_error"], error, atol=2e-4)


def test_the_maximum_is_the_answer_of_deterministic_updating(result, findings):
    theta = findings.parameters["maximum"].to_numpy()
    around = theta + result.problem.scale * 0.01 * np.random.default_rng(1).uniform(-1, 1, (200, 4))
    around = np.clip(around, result.problem.lower, result.problem.upper)
    assert np.all(result.problem.log_prob(around) <= result.problem.log_prob(theta) + 1e-6)
    np.testing.assert_allclose(findings.frequencies["maximum_hz"], weak_plane(theta), rtol=2e-6)
    np.testing.assert_allclose(findings.maxima.loc[1, ["Ix1", "Ix2", "Ax1", "Ax2"]].astype(float), theta)
    assert findings.maxima.loc[1, "modes"] == "W1 W2 W3 W4 W5"


def test_predictive_distribution(result, findings):
    predictive = result.long["hmc"]["posterior_predictive"]
    noisy = predictive["frequency"].to_numpy().reshape(-1, 5)
    table = findings.frequencies
    expected = predictive["model_frequency"].to_numpy().reshape(-1, 5).mean(axis=0)
    np.testing.assert_allclose(table["long_hmc_predictive"], expected, rtol=1e-9)
    np.testing.assert_allclose(table["long_hmc_predictive_eti90_ub"], np.quantile(noisy, 0.95, axis=0), rtol=1e-9)


def test_without_a_converged_run_nobody_knows_the_papers_pace(result, findings):
    assert result.pace == {}
    assert findings.comparison["paper_needed_solves"].isna().all()


def test_the_papers_pace_comes_from_draws_of_a_converged_run(result):
    """The trace of HMC, and only if it is converged; without it that of emcee."""

    def starts(*converged):
        verdicts = {s: SimpleNamespace(converged=s in converged) for s in SAMPLERS}
        return starts_in_the_posterior(result.long, verdicts, 3)

    for name in ("hmc", "emcee"):
        every = draws_of(result.long[name])
        np.testing.assert_array_equal(starts(name, "mh"), every[[0, (len(every) - 1) // 2, -1]])
    assert starts("mh", "slice") is None
    pace = replace(result, pace={"slice": result.paper["slice"]})
    for column in ("paper_needed_solves", "paper_pace_ess"):
        assert list(comparison_table(pace)[column].notna()) == [name == "slice" for name in SAMPLERS]


def test_runs_are_of_one_algorithm_each(result, jumps):
    """None jumps; those that cannot cross between maxima start around them if there are several."""
    assert len(jumps) > len(SAMPLERS)
    assert set(jumps.values()) == {False}
    for name in PAPER_SAMPLERS:
        assert (long_start(name, 1), long_start(name, 3)) == ("prior", "maxima")
        assert result.long[name].attrs["init"] == "prior"
    assert long_start("mixture", 3) == "prior"
    assert long_start("emcee", 1) == "maxima"


def test_published_results_are_measured_by_the_papers_tables(findings):
    row = findings.comparison.loc["slice"]
    assert row["published_percent"] == pytest.approx(np.mean([3.14, 7.1, 0.62, 0.16, 1.0]))
    meant = np.array([32.9, 183.85, 556.4, 1084.0, 1799.4])
    assert row["published_rms_hz"] == pytest.approx(np.sqrt(np.mean((meant - MEASURED) ** 2)))
    assert findings.comparison.loc["emcee", ["published_percent", "published_rms_hz"]].isna().all()


def test_costs_count_the_warmup(result, findings):
    for name, trace in result.long.items():
        solves = sum(int(trace[group]["n_solves"].sum()) for group in ("warmup_sample_stats", "sample_stats"))
        assert findings.comparison.loc[name, "n_solves"] == solves
    assert str(findings.comparison.loc["emcee", "paper_solves"]) == "<NA>"


def test_distances_from_the_reference(result, findings):
    reference = result.reference
    mean = draws_of(result.paper["mh"]).mean(axis=0)
    expected = np.max(np.abs(mean - reference.mean) / reference.sd)
    assert findings.comparison.loc["mh", "paper_error"] == pytest.approx(expected)
    published = np.array([7.05e-9, 6.36e-9, 8.28e-4, 8.46e-4])
    expected = np.max(np.abs(published - reference.mean) / reference.sd)
    assert findings.comparison.loc["mh", "published_error"] == pytest.approx(expected)


def test_runs_of_a_few_draws_are_not_called_converged(result, findings):
    assert not any(findings.is_converged(name) for name in SAMPLERS)
    assert findings.comparison["needed_solves"].isna().all()
    assert "importance sampling" in findings.origin
    assert agreement(result)[2] == ()
    page = experiment_page(findings)
    assert page.count("**no**") == page.count("has not converged:\n") == len(SAMPLERS)
    assert "| yes |" not in page
    assert "No run has converged." in page
    assert "No sampler converged" in page


def test_the_page_shows_the_numbers_in_the_papers_units(result, findings):
    page = experiment_page(findings)
    mean = draws_of(result.paper["mh"]).mean(axis=0)
    assert f"| Ix1 | 1e-9 m⁴ | 7.05 | {mean[0] / 1e-9:.3f} |" in page
    assert f"| Ax2 | 1e-4 m² | 8.46 | {mean[3] / 1e-4:.3f} |" in page
    assert "Ix1 = 5e-9 (must be 7e-9)" in page
    assert "| 1 | 31.9 | 31.3 | 1.97 |" in page


def test_efficiency_without_the_warmup(result, findings):
    row = findings.comparison.loc["hmc"]
    gradients = int(result.long["hmc"]["sample_stats"]["n_gradients"].sum())
    assert row["gradient_cost"] == result.long["hmc"].attrs["gradient_cost"] > 1.0
    assert row["sampling_gradients"] == gradients
    assert row["sampling_solves"] == round(row["gradient_cost"] * gradients)
    assert row["ess_per_sampling_solve"] == pytest.approx(row["ess_bulk_min"] / row["sampling_solves"])
    assert row["sampling_solves"] < row["gradient_cost"] * row["n_solves"]
    assert "gradient_cost" not in result.paper["hmc"].attrs  # differences are made of solves that are counted


def test_what_was_learnt_is_shown_in_brief(findings):
    learnt = {**findings.learnt, "hmc, long": '{"step_size": 0.61234, "inverse_mass": [[1, 2], [3, 4]]}'}
    page = experiment_page(replace(findings, learnt=learnt))
    assert "| step_size 0.612; inverse_mass: 2 × 2 numbers |" in page


def test_progress_is_one_phase_that_ends(result, messages):
    phases = {phase for phase, *_ in messages}
    assert phases == {"section-shape"}
    done = [message[1] for message in messages]
    assert done == sorted(done)
    assert messages[-1][1] == messages[-1][2]
    assert all(message[1] < message[2] for message in messages[:-1])
    assert any("hmc" in message[3]["run"] for message in messages)
