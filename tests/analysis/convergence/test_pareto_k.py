import numpy as np
import pytest

from fmu.analysis.convergence.pareto import heavy_tail_in_words, pareto_k


@pytest.mark.parametrize(
    ("log_w", "k"), [([], np.inf), ([0.0, -1.0, -2.0], np.inf), ([0.5] * 8, -np.inf)], ids=["none", "few", "equal"]
)
def test_weights_without_a_tail_have_a_shape(log_w, k):
    assert pareto_k(np.array(log_w)) == k
    assert bool(heavy_tail_in_words(k)) == (k > 0)


@pytest.mark.parametrize("k", [0.2, 0.6, 1.0])
def test_the_shape_of_pareto_weights_is_recovered(k):
    log_w = -k * np.log(np.random.default_rng(3).uniform(size=200_000))
    assert pareto_k(log_w) == pytest.approx(k, abs=0.08)
