"""The two-storey shear building of Beck & Au (2002) by quadrature, without anything of fmu."""

from functools import cache
from typing import NamedTuple

import numpy as np

from tests.shear_building import two_frequencies_hz

SD = 1 / 16
MODES_OF_PRIORS, SD_OF_PRIORS = (1.3, 0.8), 1.0
BETWEEN = 0.9
"""Of the lower storey's factor: between both modes of the posterior, where there is next to nothing."""


class Posterior(NamedTuple):
    unnormalised_evidence: float  # with the likelihood exp(−J/(2 sd²)) of the paper
    mean: np.ndarray
    sd: np.ndarray
    stiff_below: float  # the probability of θ1 > BETWEEN

    @property
    def log_evidence(self):
        """With the errors' density normalised."""
        return float(np.log(self.unnormalised_evidence / (2 * np.pi * SD**2)))


@cache
def quadrature(nodes=400, masses=(16.5e3, 16.1e3)):
    """Gauss–Legendre, in the standard normal variables that the logarithms have under the prior."""
    theta, prior, squares = _grid(nodes, masses)
    mass = prior * np.exp(-0.5 * squares.sum(axis=1) / SD**2)
    evidence = mass.sum()
    mean = mass @ theta / evidence
    sd = np.sqrt(mass @ (theta - mean) ** 2 / evidence)
    return Posterior(evidence, mean, sd, mass[theta[:, 0] > BETWEEN].sum() / evidence)


def left_out(nodes=400):
    """The log-density of the error of each mode given the other mode."""
    _, prior, squares = _grid(nodes, (16.5e3, 16.1e3))
    density = np.exp(-0.5 * squares / SD**2) / (np.sqrt(2 * np.pi) * SD)
    return np.log(prior @ density.prod(axis=1) / (prior @ density[:, ::-1]))


def _grid(nodes, masses):
    """Nodes (n, 2), their mass under the prior, and the squared errors of both eigenvalues there."""
    x, w = np.polynomial.legendre.leggauss(nodes)
    half = 7.0
    z = half * np.stack(np.meshgrid(x, x, indexing="ij"), axis=-1).reshape(-1, 2)
    variances = []
    for mode in MODES_OF_PRIORS:  # mode² v (1 + v)³ = sd², with v = exp(variance of the logarithm) − 1
        roots = np.roots([1, 3, 3, 1, -((SD_OF_PRIORS / mode) ** 2)])
        variances.append(np.log1p(roots[np.isreal(roots)].real.max()))
    theta = np.exp(np.log(MODES_OF_PRIORS) + variances + np.sqrt(variances) * z)
    prior = half**2 * np.outer(w, w).ravel() * np.exp(-0.5 * np.sum(z**2, axis=1)) / (2 * np.pi)
    return theta, prior, ((two_frequencies_hz(29.7e6 * theta, masses) / [3.13, 9.83]) ** 2 - 1) ** 2
