"""Pages on repeated tests and on parameters that the data did not update: each is told for what it is."""

import numpy as np
import pytest
import xarray as xr

import fmu
from fmu.analysis.prediction import predict_frequencies
from fmu.cli.tables import echo_summary
from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.parameters import Parameter
from fmu.posterior.priors.base import Normal
from fmu.posterior.problem import UpdatingProblem
from fmu.report import plots
from fmu.report.check_page import check_page
from fmu.report.document import Items, PageTable, breaking_at_commas
from fmu.report.pages import write_pages
from fmu.report.plots.style import GREY
from fmu.report.run import runs_of
from fmu.report.sections import origin, prediction, updating
from fmu.report.sections.fit import model_fit
from fmu.report.sections.verdicts import judge_data
from tests.linear import LinearModel

N = 40


class Deaf(LinearModel):
    """A third parameter that no frequency depends on."""

    n_parameters = 3

    def frequencies(self, theta):
        return super().frequencies(theta[:, :2])

    def frequencies_and_gradient(self, theta):
        f, slopes = super().frequencies_and_gradient(theta[:, :2])
        return f, np.concatenate([slopes, np.zeros((len(theta), 3, 1))], axis=2)


@pytest.fixture(scope="module")
def problem():
    rng = np.random.default_rng(1)
    tests = np.array([101.0, 99.5, 102.0]) + 0.5 * rng.standard_normal((N, 3))
    tests[:, 1] += 0.05 * np.arange(N)
    tests[3, 0] = np.nan
    parameters = [Parameter(name, start=0.0, lower=-8.0, upper=8.0, prior=Normal(1.0)) for name in ("a", "b", "c")]
    data = ModalData.from_tests(tests, labels=("W1", "W2", "T1"))
    return UpdatingProblem.reduced(Deaf(), data, parameters, name="tests")


@pytest.fixture(scope="module")
def traces(problem, refits):
    return {"hmc": fmu.sample(problem, "hmc", draws=250, warmup=100, chains=4)}


@pytest.fixture(scope="module")
def run(traces):
    return runs_of(traces)["hmc"]


def test_both_intervals_are_predicted(run, problem):
    """s/√n about the model's frequency for the mean of the tests, s for one more."""
    table = predict_frequencies(run.trace)
    single = (table["test_eti90_ub"] - table["test_eti90_lb"]).to_numpy() / (2 * 1.645)
    s = np.nanstd(problem.data.tests.frequencies_hz, axis=0, ddof=1)
    np.testing.assert_allclose(single, np.hypot(s, table["sd"]), rtol=0.15)
    np.testing.assert_allclose(table["noisy_sd"], np.hypot(problem.data.sd_hz, table["sd"]), rtol=0.1)
    made = problem.data.tests.frequencies_hz[:, 2]
    inside = (made > table["test_eti90_lb"]["T1"]) & (made < table["test_eti90_ub"]["T1"])
    assert inside.mean() > 0.8
    assert fmu.expectation(run.trace, "one_more_test").value == pytest.approx(table["mean"], abs=0.1)


def test_the_trace_keeps_the_tests(run, problem, tmp_path):
    kept = fmu.load_trace(fmu.save_trace(run.trace, tmp_path / "trace.nc"))
    np.testing.assert_array_equal(kept["observed_data"]["tests"], problem.data.tests.frequencies_hz)


def test_tables_say_which_is_which(run, problem):
    (table,) = (part for part in updating.frequencies(run).parts if isinstance(part, PageTable))
    assert table.header[-2:] == ("90 %, mean of tests, Hz", "90 %, one more test, Hz")
    assert f"of a new measurement, the mean of {N - 1} to {N} tests; and of one more test" in table.caption
    section = prediction.predictive(run)
    _, singles = (part for part in section.parts if isinstance(part, PageTable))
    rows = [dict(zip(singles.header, row, strict=True)) for row in singles.rows]
    assert [row["tests"] for row in rows] == [str(N - 1), str(N), str(N)]
    tests = problem.data.tests.frequencies_hz
    low, high = (run.prediction[f"test_eti90_{end}"].to_numpy() for end in ("lb", "ub"))
    inside = np.sum((tests >= low) & (tests <= high), axis=0)
    assert [row["tests inside that"] for row in rows] == [
        f"{inside[0]} of {N - 1}",
        *(f"{k} of {N}" for k in inside[1:]),
    ]
    assert inside[2] > 0.8 * N
    (items,) = (part for part in section.parts if isinstance(part, Items))
    assert items.items[0].startswith("Mode W2: ")
    assert not any("W1" in item for item in items.items)


def test_figures_say_which_is_which(run):
    words = [text.get_text() for text in plots.plot_predictive_check(run.trace).figure.legends[0].get_texts()]
    assert f"99 % for the mean of {N - 1} to {N} tests" in words
    assert {"90 % of one more test", "the tests"} <= set(words)
    legend = plots.plot_frequency_updates(run.trace).figure.legends[0]
    words = [text.get_text().replace("\n", " ") for text in legend.get_texts()]
    assert f"after: mean, 90 % interval for the mean of {N - 1} to {N} tests" in words
    assert "the same for one more test" in words


def test_where_the_frequencies_are_no_data_no_noise_is_shown(run):
    """As with FRFs alone: the intervals are of the model's frequencies, and there is none of one more test."""
    trace = run.trace.copy()
    observed = trace["observed_data"].to_dataset()
    trace["observed_data"] = xr.DataTree(observed.assign(used=("mode", np.zeros(observed.sizes["mode"], bool))))
    (other,) = runs_of({"hmc": trace}).values()
    legend = plots.plot_frequency_updates(trace).figure.legends[0]
    words = [text.get_text().replace("\n", " ") for text in legend.get_texts()]
    assert words[-1] == "after: mean, 90 % interval without measurement noise"
    (table,) = (part for part in updating.frequencies(other).parts if isinstance(part, PageTable))
    assert table.header[-1] == "90 %, without noise, Hz"
    assert table.caption.startswith("After: posterior mean of the model's frequency, and its 90 % interval.")


def test_what_was_not_updated_is_not_among_what_was(run):
    (table,) = (part for part in updating.parameters(run).parts if isinstance(part, PageTable))
    rows = [dict(zip(table.header, row, strict=True)) for row in table.rows]
    assert [row["determined by"] for row in rows] == ["data", "data", "prior"]
    assert rows[2]["change"] == "prior"
    assert {row["prior"] for row in rows} == {breaking_at_commas("normal, mean 0, sd 1")}
    assert table.greyed == (2,)
    assert "Grey: not informed by the data" in table.caption
    verdict = judge_data(run)
    assert (verdict.answer, verdict.is_good) == ("c", False)
    assert verdict.said == "The data updated 2 of 3 parameters."
    assert verdict.reasons[0].startswith("c was not updated by the data: ")
    assert verdict.reasons[0] in run.diagnosis.warnings
    assert verdict.reasons[0] not in (*model_fit(run).reasons, *model_fit(run).notes)
    said = "mode W2: 100.446 Hz was measured (the mean of 40 tests), and the other modes predict 99.56"
    assert any(reason.startswith(said) for reason in model_fit(run).reasons)


def test_what_was_not_informed_is_grey_in_the_picture(run):
    axes = plots.plot_parameter_updates({"hmc": run.trace})[0]
    drawn = {line.get_label(): line for line in axes.lines}
    mean = run.summary["mean"]
    np.testing.assert_allclose(drawn["Hamiltonian Monte Carlo"].get_ydata(), mean[["a", "b"]])
    np.testing.assert_allclose(drawn["prior: not informed"].get_ydata(), mean[["c"]])
    assert drawn["prior: not informed"].get_color() == GREY


def test_what_was_not_informed_is_said_in_the_terminal(run, capsys):
    echo_summary("hmc", run.trace, run.summary)
    lines = capsys.readouterr().out.splitlines()
    assert lines[1].split()[-1] == "from"
    assert [line.split()[-1] for line in lines[2:5]] == ["data", "data", "prior"]


def test_assumptions_stand_below_the_verdicts(run, problem):
    errors, table = origin.assumptions(run)
    assert isinstance(errors, Items)
    assert "The model itself pairs its modes with the measured ones." in errors.items
    assert [row[0] for row in table.rows] == ["W1", "W2", "T1"]
    assert [float(row[2]) for row in table.rows] == pytest.approx(problem.data.sd_hz, rel=5e-3)
    assert check_page(fmu.check(problem, draws=20)).assumptions[1] == table  # one source for both


@pytest.mark.usefixtures("no_pictures")
def test_the_pages_have_it(traces, problem, tmp_path):
    index = write_pages(traces, tmp_path / "report")
    text = index.read_text(encoding="utf-8")
    assert "Anything left undetermined?" in text
    assert "c was not updated by the data" in text
    assert 0 < text.index("Anything left undetermined") < text.index(">Assumptions<") < text.index("Contents")
    assert '<tr class="greyed"><th scope="row">c</th>' in text
    found = fmu.check(problem, draws=20)
    verdicts = {verdict.question: verdict for verdict in check_page(found).verdicts}
    assert verdicts["Are the tests independent?"].is_good is False
    told = verdicts["What can the data identify?"]
    assert told.is_good is False
    assert told.reasons[0].startswith("The measurement carries no information on c: 100 %")
    assert told.reasons[0] in " ".join(str(found).split())
