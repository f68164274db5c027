"""Whether samplers agree, in one sentence, which turns when one of them differs."""

import numpy as np
import pytest

from fmu.analysis.convergence.agreement import CLOSE, agreement
from fmu.analysis.convergence.diagnostics import summary
from fmu.analysis.convergence.effective import ess_mean, ess_tail, mcse_sd


def of(make_trace, *arrays):
    traces = {name: make_trace(x) for name, x in zip("abc", arrays, strict=False)}
    return agreement(traces, {name: summary(trace) for name, trace in traces.items()})


@pytest.fixture
def draws():
    return list(np.random.default_rng(41).standard_normal((3, 4, 600, 2)))


def test_samplers_of_one_distribution_agree(make_trace, draws):
    found = of(make_trace, *draws)
    assert found.agrees
    assert 0 < found.z < CLOSE
    assert found.sentence.startswith(
        "The 3 samplers agree: of 12 differences of their means and sds the largest is "
    )
    assert found.left_out == ()


def test_a_mean_that_differs_turns_the_sentence(make_trace, draws):
    draws[1][..., 1] += 0.5
    found = of(make_trace, *draws)
    assert found.agrees is False
    assert found.sentence.startswith("The samplers disagree: mean of x1, ")
    assert "b" in found.sentence.split("x1, ")[1].split(":")[0]
    assert "at least one of the two is wrong" in found.sentence


def test_a_spread_that_differs_turns_it_too(make_trace, draws):
    draws[2][..., 0] *= 1.4
    found = of(make_trace, *draws)
    assert found.agrees is False
    assert "sd of x0" in found.sentence


def test_scores_of_tests_are_not_compared(make_trace, draws):
    """Their standard errors are not tested, and pages of many tests leave their draws out."""
    draws[1][..., 1] += 0.5
    draws[1][..., 1] += 0.2 * np.arange(4)[:, None]  # an R-hat of 1.02
    traces = {name: make_trace(x) for name, x in zip("ab", draws, strict=False)}
    for trace in traces.values():
        roles = {"role": ["mean", "score"], "role_of": ["x", "x"], "role_where": ["", "t1"]}
        constants = trace["constant_data"].to_dataset()
        trace["constant_data"] = constants.assign({name: ("parameter", column) for name, column in roles.items()})
    summaries = {name: summary(trace) for name, trace in traces.items()}
    found = agreement(traces, summaries)
    assert found.agrees
    assert "The 2 samplers agree: of 2 differences" in found.sentence
    for trace in traces.values():
        trace["posterior"] = trace["posterior"].to_dataset()[["x0"]]
    assert agreement(traces, summaries) == found


def test_a_run_with_too_few_draws_is_left_out_and_named(make_trace, draws):
    draws[2] = draws[2][:, :50] + 3.0
    found = of(make_trace, *draws)
    assert found.agrees
    assert found.left_out == ("c",)
    assert found.sentence.endswith("Left out: c, whose R-hat or effective draws miss the criterion.")
    alone = of(make_trace, draws[0], draws[2])
    assert alone.agrees is None
    assert np.isnan(alone.z)


def test_the_standard_error_of_a_standard_deviation():
    """Of n independent normal draws it is σ/√(2n)."""
    x = np.random.default_rng(8).standard_normal((4, 5000))
    assert mcse_sd(x) == pytest.approx(1 / np.sqrt(2 * x.size), rel=0.1)


def test_the_error_of_an_sd_looks_at_a_slow_tail():
    """Rare and independent spikes make most of the variance; what lies beyond 95 % comes and goes slowly."""
    rng = np.random.default_rng(2)
    x = rng.uniform(-1.0, 1.0, (4, 2000))
    x[:, 500:600] = rng.uniform(1.0, 1.2, (4, 100))
    x[rng.uniform(size=x.shape) < 0.003] = 6.0
    squares = (x - x.mean()) ** 2
    assert ess_tail(x) < 0.3 * ess_mean(squares)
    expected = np.std(squares, ddof=1) / np.sqrt(ess_tail(x)) / (2.0 * np.std(x, ddof=1))
    assert mcse_sd(x) == pytest.approx(expected, rel=1e-12)
