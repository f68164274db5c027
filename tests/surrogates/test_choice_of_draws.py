"""The draws that are solved next, against the variances that are left after every possible choice."""

from types import SimpleNamespace

import numpy as np
import pytest

from fmu.surrogates.selection import choose_draws

SCATTER = 1e-3


@pytest.fixture(scope="module")
def draws():
    rng = np.random.default_rng(3)
    return np.concatenate([rng.normal(0.0, 0.1, (40, 1)), rng.normal(1.0, 0.2, (25, 1))])


def covariance(x):
    return np.exp(-0.5 * (x - x.T) ** 2 / 0.3**2)


def left(x, weight, chosen):
    """Return the mean of the weighted variances at x after the values at the chosen points are known."""
    K = covariance(x)
    known = K[np.ix_(chosen, chosen)] + SCATTER * np.eye(len(chosen))
    return weight @ np.diag(K - K[:, chosen] @ np.linalg.solve(known, K[chosen]))


def test_each_choice_leaves_the_least_variance(draws):
    weight = 1.0 + np.abs(draws[:, 0])
    process = SimpleNamespace(unit=np.ones(1), covariance=lambda x: (covariance(x), SCATTER))
    model = SimpleNamespace(
        n_parameters=1,
        coordinates=SimpleNamespace(to_x=lambda theta: theta),
        weights_of_learnt=lambda theta, of_frequency: of_frequency,
        of_frequencies=(process,),
        of_shapes=(),
    )
    likelihood = SimpleNamespace(
        sensitivity_to_model=lambda theta: (weight[:, None], np.empty((len(theta), 0, 0)))
    )
    found = choose_draws(likelihood, model, draws, 4).tolist()
    for n in range(4):
        variances = [left(draws, weight, [*found[:n], i]) for i in range(len(draws))]
        assert variances[found[n]] == pytest.approx(min(variances), rel=1e-9)
