"""The gates of the coverage study, on posteriors whose coverage is known."""

import numpy as np
import pytest
from scipy.stats import norm

from tests.validation import coverage_page
from tests.validation.coverage import INTERVAL, NAMES, QUANTITIES, RANKED, REPLICATES, Replicate, Study


def study(factor=1.0, shift=0.0):
    """Runs of Gaussian posteriors whose draws are too narrow by a factor, or shifted, in the first parameter."""
    rng = np.random.default_rng(5)
    scale, away = np.ones(len(QUANTITIES)), np.zeros(len(QUANTITIES))
    scale[0], away[0] = 1.0 / factor, shift
    edge = norm.isf(0.5 * (1.0 - INTERVAL))
    runs = []
    for _ in range(REPLICATES):
        truth = rng.standard_normal(len(QUANTITIES))
        draws = away + scale * rng.standard_normal((RANKED, len(QUANTITIES)))
        covered = (np.abs(truth - away) <= edge * scale)[: len(NAMES)]
        runs.append(
            Replicate(
                np.exp(truth[: len(NAMES)]),
                covered,
                np.sum(draws < truth, axis=0),
                scale[: len(NAMES)],
                400.0,
                640,
                1.0,
            )
        )
    return Study(runs)


def test_a_correct_sampler_passes():
    found = study()
    assert found.failures == []
    assert found.band == (165, 192)
    assert np.all(np.abs(found.covered / REPLICATES - INTERVAL) < 0.07)


@pytest.mark.parametrize("wrong", [{"factor": 1.6}, {"factor": 0.4}, {"shift": 1.0}])
def test_a_wrong_one_is_found(wrong):
    failures = study(**wrong).failures
    assert failures
    assert all(failure.startswith("k1:") for failure in failures)
    assert any("the interval holds" in failure for failure in failures)


def test_the_page_shows_every_parameter(tmp_path):
    coverage_page.write(study(factor=1.6), tmp_path)
    page = (tmp_path / "coverage.md").read_text(encoding="utf-8")
    assert all(f"| {name} | " in page for name in NAMES)
    assert "**Gates that fail:**" in page
    assert (tmp_path / "coverage" / "coverage.png").stat().st_size > 10_000
