"""Estimates while a run grows: those that the same run would have had if it had been shorter."""

import numpy as np
import pytest

import fmu
from fmu.analysis.convergence.effective import lengths, running_means, running_rhat


class Correlated:
    """A Gaussian in the plane with correlation 0.9."""

    ndim = 2
    lower = np.full(2, -np.inf)
    upper = np.full(2, np.inf)
    precision = np.linalg.inv([[1.0, 0.9], [0.9, 1.0]])

    def log_prob(self, x):
        return -0.5 * np.einsum("...i,ij,...j->...", x, self.precision, x)

    def log_prob_and_grad(self, x):
        return self.log_prob(x), -np.asarray(x) @ self.precision

    def sample_prior(self, rng, n):
        return rng.normal(size=(n, 2))


@pytest.fixture(scope="module")
def mh():
    return fmu.sample(Correlated(), "mh", draws=300, warmup=50, chains=3)


@pytest.fixture(scope="module")
def emcee():
    return fmu.sample(Correlated(), "emcee", draws=40, warmup=10, chains=2)


def shorter(trace, draws):
    cut = trace.copy()
    for group in ("posterior", "sample_stats"):
        cut[group] = cut[group].isel(draw=slice(draws))
    return cut


def test_lengths_grow_to_the_whole_run():
    at = lengths(1000)
    assert len(at) == 20
    assert (at[0], at[-1]) == (20, 1000)
    assert np.all(np.diff(at) > 0)
    np.testing.assert_allclose(at[1:] / at[:-1], (1000 / 20) ** (1 / 19), rtol=0.05)
    assert lengths(7).tolist() == [7]


@pytest.mark.parametrize("sampler", ["mh", "emcee"])
def test_means_are_those_of_shorter_runs(sampler, request):
    trace = request.getfixturevalue(sampler)
    walkers = int(trace.attrs["walkers"])
    at, means = running_means(trace)
    assert means.shape == (len(at), trace["posterior"].sizes["chain"], 2)
    for k in (0, len(at) // 2, -1):
        first = trace["posterior"].isel(draw=slice(at[k] * walkers))
        expected = np.stack([first[name].mean("draw") for name in ("x0", "x1")], axis=-1)
        np.testing.assert_allclose(means[k], expected, rtol=1e-12)


def test_means_at_given_steps(mh):
    at, means = running_means(mh, np.array([1, 300]))
    np.testing.assert_array_equal(at, [1, 300])
    np.testing.assert_allclose(means[0, :, 0], mh["posterior"]["x0"][:, 0])


def test_rhat_is_that_of_shorter_runs(mh):
    at, rhat = running_rhat(mh)
    for k in (0, 10, -1):
        expected = fmu.summary(shorter(mh, int(at[k])))["rhat"]
        np.testing.assert_allclose(rhat[k], expected, rtol=1e-12)


def test_rhat_of_thinned_draws_is_near_that_of_all(mh, emcee):
    whole = fmu.summary(emcee)["rhat"].to_numpy()
    np.testing.assert_allclose(running_rhat(emcee)[1][-1], whole, rtol=1e-12)
    thinned = running_rhat(emcee, most=400)[1][-1]
    assert not np.array_equal(thinned, whole)
    np.testing.assert_allclose(thinned, whole, atol=0.02)


def test_rhat_of_one_chain_is_unknown():
    trace = fmu.sample(Correlated(), "mh", draws=30, warmup=5, chains=1)
    assert np.isnan(running_rhat(trace)[1]).all()
