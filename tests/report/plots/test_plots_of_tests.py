"""What the plots and sections of several tests show: values, populations, the next test, losses."""

import re
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

import fmu
from fmu.report.document import Omitted, PageTable
from fmu.report.plots import plot_damage_by_test, plot_losses, plot_values
from fmu.report.run import runs_of
from fmu.report.sections import tests
from fmu.report.sections.verdicts import verdicts


def measured(k, noise=0.01, seed=3):
    """Return a test of one mass on a spring for each stiffness k, f² = k/(4π²)."""
    rng = np.random.default_rng(seed)
    f = np.sqrt(k) / (2 * np.pi) * (1 + noise * rng.standard_normal(len(k)))
    data = [fmu.ModalData([one], sd_hz=noise * one) for one in f]
    return [fmu.Test(f"t{i}", one, group="old" if i < 2 else "new") for i, one in enumerate(data)]


def drawn(k, varies, **length):
    return drawn_from(measured(np.asarray(k)), varies, **length)


def drawn_from(listed, varies, draws=60, warmup=60):
    model = fmu.SeparableModel.from_terms(["k"], [(np.eye(1), "k")], [np.eye(1)])
    problem = fmu.JointProblem(
        model,
        listed,
        [fmu.Parameter("k", 1.0, 0.5, 1.5, unit="N/m")],
        varies={"k": varies},
        pairing="index",
    )
    return fmu.sample(problem, "hmc", draws=draws, warmup=warmup, chains=2, seed=1)


@pytest.fixture(scope="module")
def scattered():
    return drawn([0.9, 1.0, 1.05, 1.1, 0.95], fmu.Population())


@pytest.fixture(scope="module")
def weakened():
    return drawn([1.0, 1.0, 0.7, 0.7], "group")


def test_every_value_stands_in_its_test(scattered):
    (axis,) = plot_values(scattered)
    values = scattered["tests"]["k"].to_numpy().reshape(-1, 5)
    (bars,) = axis.containers
    assert_allclose(bars.lines[0].get_ydata(), values.mean(axis=0) / 1e3, rtol=1e-12)
    assert axis.get_ylabel() == "k / kN/m"
    assert [label.get_text() for label in axis.get_xticklabels()] == [f"t{i}" for i in range(5)]


def test_the_section_tells_variability_from_uncertainty(scattered):
    (run,) = runs_of({"hmc": scattered}).values()
    parts = tests.population(run).parts
    scatter, following = (part for part in parts if isinstance(part, PageTable))
    assert scatter.header == ("parameter", "mean", "unit", "sd over the tests", "of the mean")
    assert scatter.rows[0][0] == "k"
    mean, sd = (number.split(" ± ") for number in (scatter.rows[0][1], scatter.rows[0][3]))
    posterior = scattered["posterior"]
    for (middle, error), name in ((mean, "k mean"), (sd, "k sd")):
        of = posterior[name].to_numpy() / 1e3
        assert float(middle.split()[0]) == pytest.approx(of.mean(), abs=0.1 * of.std())
        assert float(error.split()[0]) == pytest.approx(of.std(), rel=0.1)
    draws = scattered["next_test"]["frequency"].to_numpy().ravel()
    ((_, median, half, most),) = following.rows
    last_digit = 10.0 ** -len(median.partition(".")[2])
    assert last_digit < 0.2 * draws.std()
    assert float(median) == pytest.approx(np.median(draws), abs=0.51 * last_digit)
    lower, upper = map(float, half.split(" to "))
    low, high = map(float, most.split(" to "))
    assert low < lower < float(median) < upper < high
    assert isinstance(tests.losses(run), Omitted)


def test_losses_are_drawn_with_their_probability(weakened):
    (axis,) = plot_losses(weakened, 0.2)
    losses = weakened["loss"]["k"].sel(state="new").to_numpy().ravel()
    assert axis.get_title(loc="left") == "new"
    assert axis.texts[0].get_text() == "> 99 %"
    assert_allclose(axis.lines[2].get_ydata(), 100.0 * np.quantile(losses, (0.05, 0.95)), rtol=1e-9)
    (unlikely,) = plot_losses(weakened, 0.6)
    assert unlikely.texts[0].get_text() == "< 1 %"


def test_the_section_names_what_was_lost(weakened):
    (run,) = runs_of({"hmc": weakened}).values()
    (table,) = (part for part in tests.losses(run).parts if isinstance(part, PageTable))
    assert [row[:2] for row in table.rows] == [("new", "k"), ("new", "the largest of all")]
    before, after, loss = (float(cell.split(" ")[0]) for cell in table.rows[0][2:5])
    assert loss == pytest.approx(30.0, abs=4.0)
    assert after / before == pytest.approx(1.0 - loss / 100.0, abs=0.01)
    assert isinstance(tests.population(run), Omitted)


def test_losses_by_test_and_their_date():
    trace = drawn([1.0, 1.0, 1.0, 0.7, 0.7, 0.7], fmu.UndatedDamage(), draws=100, warmup=100)
    probability, loss = plot_damage_by_test(trace, 0.2)
    assert (probability.get_ylabel(), loss.get_ylabel(), loss.get_xlabel()) == (
        "P(loss > 20 %)", "loss / %", "number of the test",
    )  # fmt: skip
    draws = trace["loss_by_test"]["k"].to_numpy().reshape(-1, 6)
    (line,) = probability.lines
    assert_allclose(line.get_xdata(), range(1, 7))
    assert_allclose(line.get_ydata(), (draws > 0.2).mean(axis=0))
    assert line.get_ydata()[0] == 0.0
    assert line.get_ydata()[-1] > 0.9
    (mean, _) = loss.lines
    assert_allclose(mean.get_ydata(), 100 * draws.mean(axis=0))
    date = trace["posterior"]["test of damage"].to_numpy()
    low, high = np.quantile(date, (0.05, 0.95))
    (band,) = probability.patches
    assert_allclose([band.get_x(), band.get_x() + band.get_width()], [low, high])
    table = fmu.damage_by_test(trace, beyond=(0.2,))
    assert_allclose(table.loc[("t5", "k")].iloc[[0, 4]], [draws[:, 5].mean(), (draws[:, 5] > 0.2).mean()])
    (run,) = runs_of({"hmc": trace}).values()
    words = tests.losses(run).parts[0]
    assert "test of damage: " in str(words)
    assert "P(loss > 5 %) in the last test: k > 99 % in t5" in str(words)
    with pytest.raises(
        ValueError, match="trace: has no losses, as it has no parameter that varies between groups"
    ):
        fmu.damage(trace)
    with pytest.raises(ValueError, match="trace: has no losses by test"):
        fmu.damage_by_test(trace.filter(lambda node: node.name != "loss_by_test"))


def test_the_last_test_is_the_last_in_time():
    """The tests are listed in another order; the loss comes before day 3."""
    days = [3, 0, 4, 1, 5, 2]
    listed = measured(np.where(np.array(days) >= 3, 0.7, 1.0))
    listed = [replace(test, covariates={"day": float(day)}) for test, day in zip(listed, days, strict=True)]
    (run,) = runs_of({"hmc": drawn_from(listed, fmu.UndatedDamage(by="day"), draws=100, warmup=100)}).values()
    assert "P(loss > 5 %) in the last test: k > 99 % in t4." in str(tests.losses(run).parts[0])
    what, sure, *_ = verdicts(run)
    assert re.fullmatch(r"k [-+][\d.]+ %, k loss to 0\.\d+", what.answer)
    assert "day of damage" not in what.answer + sure.answer + sure.said


def test_only_values_of_the_structure_have_changed(scattered):
    """The standard deviation of the population and the scores of the tests are no changes of the structure."""
    (run,) = runs_of({"hmc": scattered}).values()
    what, sure, *_ = verdicts(run)
    assert re.fullmatch(r"k mean [-+][\d.]+ %", what.answer)
    assert sure.said.startswith("Mean ± sd. Least certain: k mean, ")


def test_a_log_normal_population_has_a_median_and_a_relative_scatter():
    trace = drawn([0.9, 1.0, 1.05, 1.1, 0.95], fmu.Population(distribution="log-normal"), draws=15, warmup=15)
    (run,) = runs_of({"hmc": trace}).values()
    table = next(part for part in tests.population(run).parts if isinstance(part, PageTable))
    assert table.header == ("parameter", "mean or median", "unit", "sd over the tests", "relative scatter")
    assert table.rows[0][3].endswith(" of the logarithm")
    (axis,) = plot_values(trace)
    assert "population: median and relative scatter" in axis.get_legend_handles_labels()[1]
