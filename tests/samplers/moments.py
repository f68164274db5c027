"""What the tests of the samplers ask of a run: effective sizes by ArviZ, errors in units of their MCSE."""

from __future__ import annotations

import numpy as np


def moment_errors(target, result):
    """Compare mean, variances and covariances with the exact ones.

    The moments are expectations of x and of (x − μ)(x − μ)ᵀ with the exact μ, so that each is a plain average. The
    walkers of an ensemble are averaged before anything else, for they are not independent of each other.

    Returns
    -------
    errors : ndarray
        (estimate − exact)/MCSE of every moment.
    size : ndarray
        Independent draws from the target that would give the same MCSE.
    """
    from arviz_stats.base import array_stats

    x = result.posterior.position
    away = x - target.mean
    i, j = np.triu_indices(target.ndim)
    values = np.concatenate([x, away[:, :, i] * away[:, :, j]], axis=2)
    exact = np.concatenate([target.mean, target.covariance[i, j]])
    series = values.reshape(result.chains, result.draws, result.walkers, -1).mean(axis=2)
    ess = np.array(
        [array_stats.ess(s, chain_axis=0, draw_axis=1, method="mean") for s in np.moveaxis(series, 2, 0)]
    )
    mcse = series.std(axis=(0, 1)) / np.sqrt(ess)
    size = values.var(axis=(0, 1)) / mcse**2
    return (values.mean(axis=(0, 1)) - exact) / mcse, size


def assert_right(target, result, least=1000):
    """Fail unless every moment is known well enough to be wrong, and is then within 5 MCSE of the exact one."""
    errors, size = moment_errors(target, result)
    assert size.min() > least, f"too few effective draws to judge: {size.min():.0f}"
    assert np.abs(errors).max() < 5, f"errors in MCSE: {np.round(errors, 1)}"
