"""Importance sampling by several proposals: right integrals whatever the counts, and honest weights."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats
from scipy.special import logsumexp

from fmu.samplers.mixture.importance import cut_largest, draw_mixture, effective_size, even_out, resample


class Gaussian:
    def __init__(self, mean, sd):
        self.law = stats.norm(mean, sd)

    def draw(self, rng, n):
        return self.law.rvs(size=(n, 1), random_state=rng)

    def log_density(self, u):
        return self.law.logpdf(u[:, 0])


PROPOSALS = [Gaussian(-2.0, 1.0), Gaussian(1.0, 0.5), Gaussian(0.0, 4.0)]


@pytest.mark.parametrize("counts", [(4000, 4000, 4000), (300, 9000, 2700)])
def test_the_integral_is_right_whatever_the_counts(counts):
    """7 N(-1, 1.5²) under three proposals, none of which is alone enough."""
    target = Gaussian(-1.0, 1.5)
    u, log_q = draw_mixture(PROPOSALS, counts, np.random.default_rng(1))
    each = [
        n / sum(counts) * np.exp(proposal.log_density(u)) for n, proposal in zip(counts, PROPOSALS, strict=True)
    ]
    np.testing.assert_allclose(np.exp(log_q), np.sum(each, axis=0), rtol=1e-12)
    weight = 7.0 * np.exp(target.log_density(u) - log_q)
    for values, exact in ((weight, 7.0), (weight * u[:, 0], -7.0)):
        assert abs(values.mean() - exact) < 5 * values.std() / np.sqrt(len(u))
    assert weight.std() < 7.0 * np.sqrt(10.0)


def test_the_effective_size_is_kishs():
    assert effective_size(np.full(50, -1000.0)) == pytest.approx(50.0)
    assert effective_size(np.log([2.0, 1.0, 1.0])) == pytest.approx(16 / 6)


def test_no_weight_is_far_above_the_mean():
    log_w = np.concatenate([np.zeros(99), [50.0]])
    cut = cut_largest(log_w)
    assert cut[99] == pytest.approx(logsumexp(log_w) - np.log(100) + 0.5 * np.log(100))
    np.testing.assert_array_equal(cut[:99], log_w[:99])


def test_weights_are_evened_out_as_far_as_needed():
    log_w = 3.0 * np.random.default_rng(2).standard_normal(400)
    evened = even_out(log_w, 100.0, 0.7)
    assert effective_size(log_w) < 50.0 < 100.0 <= effective_size(evened)
    assert effective_size(evened / 0.7) < 100.0
    np.testing.assert_array_equal(even_out(evened, 100.0, 0.7), evened)


def test_draws_are_chosen_by_their_weights():
    u = np.arange(3.0)[:, None]
    chosen = resample(np.random.default_rng(3), u, np.log([1.0, 2.0, 5.0]) + 700.0, 8000)
    assert chosen.shape == (8000, 1)
    share = np.bincount(chosen[:, 0].astype(int)) / 8000
    np.testing.assert_allclose(share, [0.125, 0.25, 0.625], atol=5 * 0.5 / np.sqrt(8000))
