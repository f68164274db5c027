"""The gates of the coverage study, on posteriors whose coverage is known."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from scipy.stats import norm

from tests.validation import coverage, coverage_page
from tests.validation.coverage import INTERVAL, NAMES, QUANTITIES, RANKED, TAIL, Replicate, Study, lost_to_draws
from tests.validation.kept import Units

REPLICATES = 200


@pytest.fixture(autouse=True)
def _so_many_decide(monkeypatch):
    monkeypatch.setattr(coverage, "REPLICATES", REPLICATES)


@cache
def study(factor=1.0, shift=0.0):
    """Runs of Gaussian posteriors whose draws are too narrow by a factor, or shifted, in the first parameter."""
    rng = np.random.default_rng(5)
    scale, away = np.ones(len(QUANTITIES)), np.zeros(len(QUANTITIES))
    scale[0], away[0] = 1.0 / factor, shift
    edge = norm.isf(TAIL)
    runs = []
    for _ in range(REPLICATES):
        truth = rng.standard_normal(len(QUANTITIES))
        draws = away + scale * rng.standard_normal((RANKED, len(QUANTITIES)))
        covered = (np.abs(truth - away) <= edge * scale)[: len(NAMES)]
        runs.append(
            Replicate(
                truth=np.exp(truth[: len(NAMES)]),
                covered=covered,
                ranks=np.sum(draws < truth, axis=0),
                sd=scale[: len(NAMES)],
                lost=np.full(len(NAMES), 0.002),
                ess=400.0,
                draws=640,
                processor_s=1.0,
            )
        )
    return Study(runs)


def held(count):
    """The same, right; but of the first parameter the interval holds so many truths."""
    right = study()
    return Study([replace(run, covered=np.append(i < count, run.covered[1:])) for i, run in enumerate(right.runs)])


def test_a_correct_sampler_passes():
    found = study()
    assert found.failures == []
    assert np.all(np.abs(found.covered / REPLICATES - INTERVAL) < 0.07)
    assert coverage_page.verdict(found).startswith("**Yes: all gates pass.**")


@pytest.mark.parametrize("wrong", [{"factor": 1.6}, {"factor": 0.4}, {"shift": 1.0}])
def test_a_wrong_one_is_found(wrong):
    failures = study(**wrong).failures
    assert failures
    assert all(" of k1: p = " in failure for failure in failures)
    assert any(failure.startswith("coverage of k1") for failure in failures)


def test_a_coverage_that_is_rare_by_itself_is_named_with_what_it_means_among_all():
    found = held(167)
    what, p, among = found.smallest
    assert what == "coverage of k1"
    assert p == pytest.approx(0.0079, abs=1e-4)  # two-sided, of an expected 89.8 %
    assert among == pytest.approx(1 - (1 - p) ** 25)
    said = coverage_page.verdict(found)
    assert "The smallest of the 25 p-values is 0.0079 (coverage of k1)." in said
    assert f"with a probability of {100 * among:.2g} %" in said


@pytest.mark.parametrize(
    ("count", "said"),
    [(167, "**Yes: all gates pass.**"), (163, "**No gate fails, but"), (159, "**Some gates fail:**")],
)
def test_the_verdict_turns_with_the_count(count, said):
    assert coverage_page.verdict(held(count)).startswith(said)


def test_too_few_replicates_decide_nothing():
    said = coverage_page.verdict(Study(study().runs[:150]))
    assert said.startswith("**No gate fails, but 150 of 200 replicates are too few to decide.**")


def test_the_band_is_where_the_gate_turns():
    lowest, highest = study().band
    for count, fails in ((lowest - 1, True), (lowest, False), (highest, False), (highest + 1, True)):
        assert bool(held(count).failures) == fails


def test_what_an_interval_loses_to_its_draws():
    n = 100
    draws = np.random.default_rng(1).standard_normal((20_000, n))
    low, high = np.quantile(draws, [TAIL, 1 - TAIL], axis=1)
    lost = INTERVAL - np.mean(norm.cdf(high) - norm.cdf(low))
    assert lost == pytest.approx(float(lost_to_draws(np.full(2, float(n)), n)), rel=0.05)


def test_runs_that_are_kept_are_not_repeated(tmp_path, monkeypatch):
    runs = iter(study().runs[:3])
    monkeypatch.setattr(coverage, "_replicate", lambda seed: next(runs))
    coverage.study(Units(tmp_path), replicates=3)
    again = coverage.study(Units(tmp_path), replicates=3)
    for name in ("ranks", "covered", "expected", "spread_of_truths"):
        assert_array_equal(getattr(again, name), getattr(Study(study().runs[:3]), name))


@pytest.mark.validate
def test_a_study_continues_from_what_is_kept(tmp_path):
    whole = coverage.study(Units(), replicates=2)
    coverage.study(Units(tmp_path), replicates=1)
    again = coverage.study(Units(tmp_path), replicates=2)
    assert_array_equal(again.ranks, whole.ranks)


@pytest.mark.usefixtures("quick_figures")
def test_the_page_shows_every_parameter(tmp_path):
    coverage_page.write(study(factor=1.6), tmp_path)
    page = (tmp_path / "coverage.md").read_text(encoding="utf-8")
    assert all(f"| {name} | " in page for name in NAMES)
    assert "**Some gates fail:**" in page
    assert (tmp_path / "coverage" / "coverage.png").stat().st_size > 10_000
