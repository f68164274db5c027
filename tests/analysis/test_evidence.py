"""Evidences from the log-likelihoods of a ladder: against closed forms, with errors worth their name."""

import numpy as np
import pytest
import xarray as xr
from scipy.special import logsumexp

import fmu
from fmu.analysis.evidence import GROUP, Evidence, evidence
from fmu.analysis.evidence_estimators import by_bridge
from fmu.analysis.maxima.search import find_map
from fmu.analysis.trace.conversion import load_trace, save_trace
from fmu.analysis.trace.reading import parameter_draws, with_group

SD, DIMENSIONS = 0.1, 3  # likelihood N(0, SD²) in each of the dimensions, standard normal prior


def exact_evidence():
    return -0.5 * DIMENSIONS * np.log(2 * np.pi * (1 + SD**2))


def ladder_of_draws(rng, chains=4, draws=500, rungs=12, shift=0.0):
    """A trace of independent draws at every rung; `shift` moves the log-likelihood of the second chain."""
    t = np.linspace(0, 1, rungs) ** 5
    sd = 1 / np.sqrt(1 + t / SD**2)
    x = sd[:, None] * rng.standard_normal((chains, draws, rungs, DIMENSIONS))
    log_likelihood = -0.5 * np.sum(x**2, axis=-1) / SD**2 - 0.5 * DIMENSIONS * np.log(2 * np.pi * SD**2)
    log_likelihood[1:2] += shift
    group = xr.Dataset(
        {"log_likelihood": (("chain", "draw", "rung"), log_likelihood), "inverse_temperature": ("rung", t)}
    )
    return xr.DataTree.from_dict({GROUP: group})


@pytest.mark.parametrize("method", ["stepping-stone", "thermodynamic"])
def test_both_methods_are_right_and_so_are_their_errors(method):
    rng = np.random.default_rng(1)
    found = [evidence(ladder_of_draws(rng), method) for _ in range(36)]
    away = np.array([f.log_evidence for f in found]) - exact_evidence()
    errors = np.array([f.within for f in found])
    assert errors.max() < 0.1
    assert abs(away.mean()) < 4 * errors.mean() / 6
    assert 0.6 < away.std() / errors.mean() < 1.5
    assert np.all([f.error >= max(f.within, f.between) for f in found])
    assert not any(f.warnings for f in found)


def test_the_methods_differ():
    trace = ladder_of_draws(np.random.default_rng(2))
    one, other = evidence(trace), evidence(trace, "thermodynamic")
    assert one.log_evidence != other.log_evidence
    assert one.method == "stepping-stone"
    assert other.method == "thermodynamic"


def test_chains_that_disagree_show_in_the_error_and_in_a_warning():
    found = evidence(ladder_of_draws(np.random.default_rng(3), shift=-3.0))
    assert found.between > 0.5
    assert found.error == found.between
    (warning,) = found.warnings
    assert warning.startswith("R-hat ")
    assert warning in str(found)


def test_one_chain_has_no_error_between_chains():
    found = evidence(ladder_of_draws(np.random.default_rng(3), chains=1))
    assert np.isnan(found.between)
    assert found.error == found.within
    assert "unknown" in found.warnings[0]


def test_the_table_has_a_row_a_rung():
    found = evidence(ladder_of_draws(np.random.default_rng(4), rungs=9))
    assert found.table["log_ratio"].sum() == pytest.approx(found.log_evidence)
    assert len(found.table) == 9
    assert np.all(np.diff(found.table["mean"])[2:] > 0)
    assert np.all((found.table["rejection"][:-1] > 0) & (found.table["rejection"][:-1] < 1))
    assert np.isnan(found.table["rejection"].iloc[-1])


def test_it_says_what_it_is():
    table = evidence(ladder_of_draws(np.random.default_rng(4))).table
    found = Evidence(-117.14159, 0.123, "stepping-stone", 0.1, 0.123, table)
    assert str(found) == (
        "log-evidence -117.14 ± 0.12 (stepping-stone, 12 rungs; standard error within chains 0.1, between 0.12)"
    )
    assert found._repr_html_().startswith("<p>log-evidence -117.14 ± 0.12 ")
    assert "<table" in found._repr_html_()
    assert str(Evidence(-5.5, np.nan, "stepping-stone", np.nan, np.nan, table)).startswith("log-evidence -5.5 ± –")


def test_bad_input_is_refused(make_trace):
    with pytest.raises(ValueError, match="method: must be one of stepping-stone, thermodynamic"):
        evidence(ladder_of_draws(np.random.default_rng(4)), "harmonic")
    with pytest.raises(ValueError, match=r"trace: must come from fmu\.sample"):
        evidence(make_trace(np.zeros((2, 10, 2))))


def test_a_run_on_a_problem(problem, tmp_path):
    """Against the maximum's importance-sampled mass, which is exact to a thousandth for one Gaussian mode."""
    trace = fmu.sample(problem, "tempering", draws=120, warmup=60, chains=8, seed=2)
    found = evidence(load_trace(save_trace(trace, tmp_path / "tempering.nc")))
    assert found.error < 0.1
    assert abs(found.log_evidence - find_map(problem).log_evidence) < 4 * found.error
    group = trace[GROUP]
    assert group["log_likelihood"].dims == ("chain", "draw", "rung")
    assert group["inverse_temperature"].to_numpy()[[0, -1]].tolist() == [0.0, 1.0]
    assert group.attrs["barrier"] == pytest.approx(float(group["rejection"].sum()))
    assert 0 < group.attrs["round_trip_rate"] < 1.5 * group.attrs["round_trip_limit"]
    assert group.attrs["round_trips"] == int(trace["sample_stats"]["round_trips"].sum())
    assert all(values.dims == ("chain", "draw") for values in trace["sample_stats"].values())


def weights(make_trace, away=0.0):
    """A trace with log-weights of draws, and of candidates from a Gaussian that is `away` from e³ times theirs."""
    rng = np.random.default_rng(1)

    def log_w(x):
        return 3.0 - 0.5 * x**2 + 0.5 * (x - away) ** 2

    trace = make_trace(rng.standard_normal((4, 2000, 2)))
    x = parameter_draws(trace)[..., 0]
    candidates = log_w(away + rng.standard_normal(x.shape))
    candidates[:, ::5] = np.nan  # local steps
    stats = {"log_weight": log_w(x), "candidate_log_weight": candidates}
    dataset = xr.Dataset({name: (("chain", "draw"), values) for name, values in stats.items()})
    return with_group(trace, "sample_stats", dataset), candidates


@pytest.mark.parametrize("method", ["importance", "bridge"])
def test_evidence_and_its_error(make_trace, method):
    trace, candidates = weights(make_trace, away=0.7)
    found = evidence(trace, method)
    assert found.log_evidence == pytest.approx(3.0, abs=4 * found.error)
    assert 0.002 < found.error < 0.02
    (only_visited,) = found.warnings
    assert only_visited.startswith("judged by its own draws only, as no maxima are known")
    assert " of the visited places alone (" in str(found).splitlines()[0]
    if method == "importance":
        known = candidates[np.isfinite(candidates)]
        assert found.log_evidence == pytest.approx(logsumexp(known) - np.log(len(known)), rel=1e-12)


def test_too_few_candidates_are_the_reason(make_trace):
    trace, candidates = weights(make_trace, away=0.7)
    finite = np.flatnonzero(np.isfinite(candidates[0]))
    candidates[:, finite[20:]] = -np.inf  # as where a function fails
    trace = with_group(trace, "sample_stats", trace["sample_stats"].to_dataset().assign(
        candidate_log_weight=(("chain", "draw"), candidates)))  # fmt: skip
    with pytest.raises(ValueError, match=r"must have 100 mixture candidates .* \(got 80\): draw more"):
        evidence(trace)
    with pytest.raises(ValueError, match=r"must come from fmu\.sample"):
        evidence(trace, "thermodynamic")
    candidates[np.isfinite(candidates)] = -np.inf
    trace = with_group(trace, "sample_stats", trace["sample_stats"].to_dataset().assign(
        candidate_log_weight=(("chain", "draw"), candidates)))  # fmt: skip
    with pytest.raises(ValueError, match=r"must have 100 mixture candidates .* \(got 0\): draw more"):
        evidence(trace)


def test_a_mixture_beside_the_posterior_is_doubted(make_trace):
    trace, _ = weights(make_trace, away=4.0)
    assert "Pareto k" in evidence(trace).warnings[1]


@pytest.mark.parametrize("ratio", [1 / 20, 1.0])
def test_the_error_of_a_bridge_knows_that_draws_hang_together(ratio):
    """Against the scatter of bridges from chains that repeat every draw, whatever `ratio` says of them."""
    rng, found = np.random.default_rng(5), []
    for _ in range(100):
        x, y = np.repeat(rng.standard_normal(100), 20), 2.0 * rng.standard_normal(2000)
        p, q = (-0.5 * z**2 + 0.5 * (z / 2.0) ** 2 for z in (x, y))
        found.append(by_bridge(q, p[None], ratio))
    value, error = np.array(found).T
    assert np.mean(error) == pytest.approx(np.std(value), rel=0.3)


@pytest.mark.parametrize("every", [1, 4])
def test_the_error_of_a_bridge_knows_that_draws_are_accepted_candidates(every):
    """Against the scatter of bridges in 300 replicates, whose standard deviation has a relative error of 1/√600.

    One chain of 500 Metropolis steps in five dimensions tries a candidate in every step, or in every fourth.
    """
    rng, scale, replicates, steps = np.random.default_rng(6), 1.1, 300, 500
    squares = np.sum((scale * rng.standard_normal((steps, replicates, 5))) ** 2, axis=2)
    candidates = 5 * np.log(scale) - 0.5 * squares * (1.0 - scale**-2)
    current = 5 * np.log(scale) - 0.5 * rng.chisquare(5, replicates) * (1.0 - scale**-2)
    draws = np.empty((steps, replicates))
    for i in range(steps):
        if i % every == 0:
            accepted = -rng.standard_exponential(replicates) < candidates[i] - current
            current = np.where(accepted, candidates[i], current)
        draws[i] = current
    candidates[np.arange(steps) % every > 0] = np.nan
    found = [by_bridge(q[None], p[None], 1.0) for q, p in zip(candidates.T, draws.T, strict=True)]
    value, error = np.array(found).T
    assert np.sqrt(np.mean(error**2)) == pytest.approx(np.std(value), rel=5 / np.sqrt(600))


def test_there_is_no_evidence_of_a_foreign_tree_or_of_the_modal_residual():
    with pytest.raises(ValueError, match="trace: must be a trace written by fmu"):
        fmu.evidence(xr.DataTree())
    residual = {"log_likelihood": xr.Dataset({"residual": (("chain", "draw"), np.zeros((2, 5)))})}
    with pytest.raises(ValueError, match="trace: the modal residual is a pseudo-likelihood, and has no evidence"):
        fmu.evidence(xr.DataTree.from_dict(residual))
