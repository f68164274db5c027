"""Losses on a terminal: in a table of their own, with before and after, beside the verdict on the model."""

import re

import numpy as np
import pytest
from click.testing import CliRunner
from numpy.testing import assert_allclose

import fmu
from fmu.analysis.maxima.results import Maxima
from fmu.analysis.trace.conversion import save_trace
from fmu.analysis.trace.damage import before_and_after
from fmu.cli import main
from fmu.cli.damage import echo_losses
from fmu.cli.tables import echo_maxima, echo_summary
from fmu.report.plots import plot_losses
from tests.mast import NAMES, damaged

pytestmark = pytest.mark.usefixtures("quick_figures")


def printed(faster, folder):
    """Return what ``fmu damage`` prints of a run on the mast."""
    save_trace(damaged(faster), folder / "hmc.nc")
    result = CliRunner().invoke(main, ["damage", str(folder)])
    assert result.exit_code == 0, result.output
    assert (folder / "damage.png").stat().st_size > 10_000
    return result.stdout


def test_before_and_after_are_those_of_the_draws():
    trace = damaged()
    values = before_and_after(trace)
    assert list(values.index) == [("after", name) for name in NAMES]
    for name in NAMES:
        of_tests = trace["tests"][name].mean(("chain", "draw"))
        assert_allclose(values.loc[("after", name)], of_tests.sel(test=["first", "second"]), rtol=1e-12)


def test_limits_are_written_in_full(capsys):
    """12.5 % was called 12 %, and two such limits had one column."""
    trace = damaged()
    beyond = (0.12, 0.125, 0.125, 0.07)
    table = fmu.damage(trace, beyond)
    assert list(table.columns[4:]) == ["P(loss > 12 %)", "P(loss > 12.5 %)", "P(loss > 7 %)"]
    draws = trace["loss"]["columns 1"].to_numpy().ravel()
    row = table.loc[("after", "columns 1")]
    assert_allclose(row.iloc[4:], [np.mean(draws > limit) for limit in (0.12, 0.125, 0.07)], atol=1e-15)
    echo_losses(trace, fmu.diagnose(trace), beyond)
    said = capsys.readouterr().out
    assert [said.count(f"P > {limit} %") for limit in ("12", "12.5", "7")] == [1, 1, 1]
    assert plot_losses(trace, 0.125)[0].get_title("right") == "below: P(loss > 12.5 %)"


def test_losses_have_values_before_and_after_beside_the_verdict_on_the_model(tmp_path):
    said = printed(1.0, tmp_path)
    assert all(len(line) <= 80 for line in said.splitlines()[:-1])  # the last has a path
    assert len(said.splitlines()) < 20
    assert said.startswith("Losses since before (test first)\n\nAfter: after (test second)\n")
    before, after = before_and_after(damaged()).loc[("after", "columns 1")]
    row = next(line for line in said.splitlines() if line.startswith("columns 1"))
    shown = [float(x) for x in re.findall(r"\d+\.\d+", row)[:2]]
    assert_allclose(shown, [before, after], rtol=0.03)
    assert row.endswith("> 99 %    > 99 %")
    assert "The model: " in said


def test_a_contradicted_model_stands_beside_the_probabilities(tmp_path):
    said = " ".join(printed(2.0, tmp_path).split())
    fit = fmu.diagnose(damaged(2.0)).fit
    assert fit.answer.startswith("contradicted by ")
    assert f"The model: {fit.answer}. P is the probability" in said
    assert re.search(rf"Do not rely on P: .*the model is {fit.answer}\.", said)


def test_the_summary_leaves_losses_to_their_own_table(capsys):
    trace = damaged()
    echo_summary("hmc", trace, fmu.summary(trace))
    said = capsys.readouterr().out
    assert all(name in said for name in NAMES)
    assert "loss" not in said


@pytest.mark.parametrize("most", [5, 40])
def test_of_many_rows_only_the_probabilities_of_the_maxima_are_printed(most, capsys):
    problem = fmu.cases.load("shear-2dof")
    maxima = fmu.find_map(problem, starts=4)
    assert isinstance(maxima, Maxima)
    echo_maxima(maxima, most)
    said = capsys.readouterr().out
    assert "share of probability" in said
    assert ("map.csv" in said) == (most == 5)
    assert (problem.names[0] in said) == (most == 40)
