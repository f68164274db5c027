"""Pages on traces that lack groups, have a few draws, or do not move."""

import pytest

import fmu
from fmu.report.pages import file_names, render, sampler_page, write_pages
from fmu.report.run import runs_of
from tests.report.parsed import Parsed

pytestmark = pytest.mark.usefixtures("quick_figures")


def test_older_traces_lack_groups(hostile_traces, tmp_path):
    trace = hostile_traces["hmc"].copy()
    for group in ("modes", "identifiability", "maxima", "prior", "log_likelihood"):
        del trace[group]
    trace["sample_stats"] = trace["sample_stats"].to_dataset().drop_vars("diverging")
    index = write_pages({"hmc": trace}, tmp_path)
    page = Parsed(index.read_text())
    assert "The trace has no frequencies before updating" in page.text
    assert (
        "Identifiability: the trace has no linearised model, and there are no draws from the prior." in page.text
    )
    assert "Posterior and prior cannot be compared: there are no draws from the prior." in page.text
    assert [path.name for path in tmp_path.iterdir()] == ["index.html"]


@pytest.mark.parametrize(
    "lengths",
    [{"hmc": 3, "emcee": 2}, pytest.param({"mh": 2, "hmc": 3, "emcee": 2}, marks=pytest.mark.validate)],
    ids=str,
)
def test_runs_of_a_few_draws_have_a_page(lengths, problem, tmp_path):
    traces = {name: fmu.sample(problem, name, draws=n, warmup=0, chains=2) for name, n in lengths.items()}
    write_pages(traces, tmp_path)
    for name in lengths:
        assert "✗ Not converged" in Parsed((tmp_path / f"{name}.html").read_text()).text


def test_chains_that_stand_still_have_a_page(hostile_traces):
    trace = hostile_traces["hmc"].copy()
    for group in ("posterior", "posterior_predictive", "log_likelihood"):
        one = trace[group].to_dataset()
        still = one.isel(chain=[0, 0], draw=[0] * one.sizes["draw"])
        trace[group] = still.assign_coords(chain=one["chain"], draw=one["draw"])
    runs = runs_of({"hmc": trace})
    page = Parsed(render(sampler_page(runs["hmc"], file_names(runs), runs)))
    assert "chain 0 does not move for 40 of its 40 draws" in page.text
    assert "Prior and posterior: all posterior draws are the same." in page.text
    assert "Posterior and prior cannot be compared: all posterior draws are the same." in page.text
    assert "draws from the prior" not in page.text
    assert "Leave-one-mode-out check: there are too few draws, or they do not move." in page.text
