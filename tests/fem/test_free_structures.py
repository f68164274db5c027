"""A structure that nothing holds: its rigid-body modes are no hindrance, and no full model answers."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import fmu
from fmu.analysis.start.initial_modes import initial_modes
from fmu.posterior.assumptions import assumptions
from tests.models import free_bar
from tests.work import counted

TIGHT = 'prior = { distribution = "normal", mean = 1.0, sd = 0.02 }'
"""Four standard deviations are narrower than the bounds, and the data cannot tell E from rho."""
WORK = {"factorisations": 40, "eigenproblems": 40, "solves": 2500}


@pytest.fixture(scope="module")
def bar(tmp_path_factory):
    """Return the problem of the free bar, and what it cost to load."""
    planted = free_bar.write(tmp_path_factory.mktemp("bar"), (8, 3, 3), TIGHT)
    with counted() as work:
        problem = fmu.load(planted.path)
    return planted, problem, work


def test_the_reduced_model_is_trained_with_a_few_full_solves(bar):
    _, problem, work = bar
    for name, most in WORK.items():
        assert getattr(work, name) <= most, name
    assert problem.model.sizes == (10,)
    assert problem.model.full_solves == 0


def test_modes_are_numbered_from_the_first_elastic_one(bar):
    planted, problem, _ = bar
    theta = np.array([[1.0, 1.0], [0.81, 1.17], [1.13, 0.89]])
    exact = [planted.frequencies_hz(dict(zip(problem.names, x, strict=True))) for x in theta.tolist()]
    assert_allclose(problem.frequencies(theta), exact, rtol=1e-6)
    assert np.isfinite(problem.log_prob_and_grad(theta)[1]).all()


def test_the_words_say_how_many_modes_are_rigid(bar):
    _, problem, _ = bar
    found = initial_modes(problem)
    assert "Computed modes 1–6 are rigid-body motions; the first elastic mode is number 7." in found.notes
    assert [mode.number for mode in found.modes if mode.measured is not None] == [7, 8, 9, 10]
    words = " ".join(assumptions(problem.configuration(), 1e-6).sentences)
    assert "among the elastic modes, which follow 6 rigid-body modes: 1, 2, 3, 4." in words


def test_numbers_that_are_given_count_the_rigid_modes(bar):
    planted, problem, _ = bar
    text = planted.path.read_text(encoding="utf-8")
    given = planted.path.with_name("given.toml")
    given.write_text(text.replace("[measurement]", "[measurement]\nnumbers = [7, 8, 9, 10]"), encoding="utf-8")
    assert_allclose(fmu.load(given).frequencies(problem.start), problem.frequencies(problem.start), rtol=1e-12)


def test_no_draw_is_answered_by_the_full_model(bar):
    planted, problem, _ = bar
    maxima = fmu.find_map(problem, starts=8)
    trace = fmu.sample(problem, draws=100, warmup=100, chains=4, seed=1, maxima=maxima)
    assert trace.attrs["certificate_full_share"] == 0
    ratio = trace.posterior["E"] / trace.posterior["rho"]
    low, high = np.quantile(ratio, [0.005, 0.995])
    assert low < planted.truth["E"] / planted.truth["rho"] < high
