"""Pages of random problems do not contradict themselves; with a fault that pages once had, the checker turns."""

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from scipy.special import stdtrit
from scipy.stats import t as student

from fmu.analysis import prediction
from fmu.analysis.convergence.diagnosis import maxima_of, with_maxima
from fmu.analysis.fit import checks
from fmu.analysis.maxima.kinds import MAXIMUM
from fmu.report import sections
from fmu.report.document import PageTable
from fmu.report.sections import verdicts
from tests.validation import contradictions as contradictions_module
from tests.validation.contradictions import contradictions, numbers, page_of, said_of
from tests.validation.contradictions_cases import random_case

AT_A_BOUND, CONTRADICTED, FITTING = 0, 9, 6


@pytest.fixture(scope="module")
def pages():
    """Pages of short runs: of a truth beyond a bound, of a model that the data reject, and of one that fits."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(contradictions_module, "LENGTH", {"draws": 120, "warmup": 120, "chains": 4})
        return {seed: page_of(seed)[0] for seed in (AT_A_BOUND, CONTRADICTED, FITTING)}


@pytest.fixture
def tables(monkeypatch):
    """Leave out the sections that no rule reads, such as those of chains: most of the time of a page."""
    read = [name for name in sections.OF_A_SAMPLER if name.startswith(("updating.", "fit.", "prediction."))]
    monkeypatch.setattr(sections, "OF_A_SAMPLER", read)


def rules(said):
    return {line.partition(":")[0] for line in contradictions(said)}


@pytest.mark.parametrize("seed", [AT_A_BOUND, CONTRADICTED, FITTING])
def test_a_sample_of_pages(pages, seed):
    assert contradictions(pages[seed]) == []


@pytest.mark.validate
@pytest.mark.parametrize("seed", range(200, 220))
def test_more_pages(seed):
    assert contradictions(page_of(seed)[0]) == []


def test_problems_are_those_of_their_number():
    assert random_case(5).words == random_case(5).words != random_case(6).words


def changed(said, section, row, **cells):
    """The page with other cells in a row of the first table of a section."""

    def new(one):
        if one.id != section:
            return one
        parts = list(one.parts)
        k = next(k for k, part in enumerate(parts) if isinstance(part, PageTable))
        table = parts[k]
        rows = [list(of) for of in table.rows]
        for name, value in cells.items():
            rows[row][table.header.index(name)] = value
        parts[k] = replace(table, rows=tuple(map(tuple, rows)))
        return replace(one, parts=tuple(parts))

    page = said.page
    leading, others = (tuple(map(new, group)) for group in (page.leading, page.sections))
    return replace(said, page=replace(page, leading=leading, sections=others))


@pytest.mark.usefixtures("tables")
def test_a_jump_that_is_called_a_maximum(pages):
    """As shear-12dof-damage had: 18 % for a place on a slope, and draws of the maximum as its own."""
    said = pages[FITTING]
    found = maxima_of(said.trace)
    top = found[0]
    away = replace(
        top, theta=top.theta - 2.5 * top.sd, log_prob=float(said.problem.log_prob(top.theta - 2.5 * top.sd)),
        share=0.18, kind=MAXIMUM, starts=1,
    )  # fmt: skip
    trace = with_maxima(said.trace, replace(found, maxima=(replace(top, share=0.82), away)))
    assert "shares_against_gradients" in rules(said_of(trace, said.problem))


@pytest.mark.usefixtures("tables")
def test_a_share_that_no_draw_has(pages):
    said = pages[FITTING]
    found = maxima_of(said.trace)
    far = replace(found[0], theta=found[0].theta + 30.0 * found[0].sd, share=0.18)
    trace = with_maxima(said.trace, replace(found, maxima=(replace(found[0], share=0.82), far)))
    other = said_of(trace, said.problem)
    trust = replace(other.verdict("Can the run"), is_good=True)
    page = replace(other.page, verdicts=(*other.page.verdicts[:-1], trust))
    assert "shares_against_draws" in rules(replace(other, page=page))


@pytest.mark.usefixtures("tables")
def test_a_range_read_from_one_side(pages, monkeypatch):
    """`least` was the nearer end of a skewed range: 1.1 % beside an own error of 1.5 %."""

    def nearer(row, level):
        z = float(stdtrit(1e8, 0.5 * level) / stdtrit(1e8, 0.05))
        mean = row["mean"]
        least = z * min(mean - row["eti90_lb"], row["eti90_ub"] - mean)
        return mean - least, mean + least

    said = pages[FITTING]
    trace = said.trace.copy()
    kept = trace["leave_one_out"].to_dataset().copy(deep=True)
    k = int(np.flatnonzero(np.isfinite(kept["mean"]))[0])
    measured, sd = kept["measured"][k].item(), 0.01 * kept["measured"][k].item()
    mean = measured + 4.0 * sd
    values = {"mean": mean, "sd": sd, "p": 2.0 * student.sf(4.0, 3), "prior_sd": 100.0 * sd,
              "eti90_lb": mean + sd * student.ppf(0.05, 3), "eti90_ub": mean + 0.3 * sd}  # fmt: skip
    for name, value in values.items():
        kept[name][k] = value
    trace["leave_one_out"] = xr.DataTree(kept)
    assert "checks_against_power" not in rules(said_of(trace, said.problem))
    monkeypatch.setattr(checks, "_limits", nearer)
    assert "checks_against_power" in rules(said_of(trace, said.problem))


@pytest.mark.usefixtures("tables")
def test_a_mode_without_a_refit_that_counts(pages, monkeypatch):
    said = pages[FITTING]
    trace = said.trace.copy()
    kept = trace["leave_one_out"].to_dataset().copy(deep=True)
    for name in ("mean", "sd", "p", "elpd"):
        kept[name][:] = np.nan
    kept["method"][:] = ""
    trace["leave_one_out"] = xr.DataTree(kept)
    assert not rules(said_of(trace, said.problem))
    monkeypatch.setattr(checks, "NOT_PREDICTED", "")
    found = rules(said_of(trace, said.problem))
    assert found == {"checks_against_power", "modes_without_a_word"}


@pytest.mark.usefixtures("tables")
def test_a_certainty_that_does_not_say_what_it_assumes(pages, monkeypatch):
    monkeypatch.setattr(verdicts, "ASSUMED", "")
    assert "certainty_against_fit" in rules(said_of(pages[CONTRADICTED].trace, pages[CONTRADICTED].problem))


@pytest.mark.usefixtures("tables")
def test_a_green_line_beside_a_parameter_at_its_bound(pages, monkeypatch):
    monkeypatch.setattr(prediction, "PINNED", 2.0)
    monkeypatch.setattr(verdicts, "CONTRADICTED", "")
    for seed in (AT_A_BOUND, CONTRADICTED):
        assert "intervals_against_bounds" in rules(said_of(pages[seed].trace, pages[seed].problem))


def test_an_interval_beyond_its_bounds(pages):
    said = pages[FITTING]
    (row, _), *_ = said.rows("parameters")
    low, high = numbers(row["bounds"])
    interval = f"{low:.3f} to {high + 0.5:.3f}"
    assert rules(changed(said, "parameters", 0, **{"90 % interval": interval})) == {"intervals_against_bounds"}


def test_a_mean_that_the_table_has_otherwise(pages):
    said = pages[FITTING]
    assert "table_against_screen" in rules(changed(said, "parameters", 0, mean="7.000"))


def test_a_converged_run_without_effective_draws(pages):
    said = pages[FITTING]
    *others, trust = said.page.verdicts
    words = "R-hat at most 1.2000 (below 1.01 needed), at least 12 effective draws (400 needed)."
    page = replace(said.page, verdicts=(*others, replace(trust, said=words, is_good=True)))
    assert "convergence_against_numbers" in rules(replace(said, page=page))


def test_the_numbers_of_a_text():
    assert numbers("1 234.5 Hz, predicted -0.5 ± 2e-3 Hz") == [1234.5, -0.5, 2e-3]
