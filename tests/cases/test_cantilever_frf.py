"""The case cantilever-frf: its files are those that its script writes, and its truth is found."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

import fmu
from tests.validation import cantilever_frf

TRUTH = np.r_[cantilever_frf.MODULI, cantilever_frf.RATIOS]


@pytest.fixture(scope="module")
def problem():
    return fmu.cases.load(cantilever_frf.NAME)


def test_the_script_writes_the_files(tmp_path):
    cantilever_frf.write(tmp_path)
    own = fmu.cases.path(cantilever_frf.NAME)
    assert own.read_text(encoding="utf-8") == cantilever_frf.text()
    written, kept = (fmu.read_frf(folder / cantilever_frf.NAME / "frfs.csv", kind="accelerance")
                     for folder in (tmp_path, own.parent))  # fmt: skip
    assert np.allclose(np.asarray(written.values), np.asarray(kept.values), rtol=1e-4, atol=0)


def test_the_reduced_model_gives_the_direct_solves(problem):
    (found,) = problem.frfs(TRUTH)
    exact = cantilever_frf.accelerances()
    # training allows 0.1 in the root of the sum of squared errors of all lines, each in standard deviations
    assert np.sqrt(np.sum(np.abs((found - exact) / (cantilever_frf.NOISE * np.abs(exact))) ** 2)) < 0.3


def test_a_basis_from_the_cache_answers_as_the_one_that_was_trained(tmp_path, monkeypatch):
    monkeypatch.setenv("FMU_CACHE_DIR", str(tmp_path))
    trained, restored = (fmu.cases.load(cantilever_frf.NAME) for _ in range(2))
    theta = trained.sample_prior(np.random.default_rng(0), 20)
    assert_array_equal(restored.log_prob(theta), trained.log_prob(theta))  # bit for bit: a run is to be repeatable


def test_the_search_finds_the_truth(problem):
    (best,) = fmu.find_map(problem).maxima
    information = problem.likelihood.quadratic(best.theta[None])[2][0]
    away = best.theta - TRUTH
    assert away @ information @ away < 32.9  # of chi-square with 10 degrees of freedom, p = 3e-4
    assert best.log_prob > problem.log_prob(TRUTH)
