"""Selection of the draws at which to solve the model next: those that reduce the posterior's error most."""

from __future__ import annotations

import numpy as np

from fmu.fem.surrogate.surrogate_model import SurrogateModel
from fmu.posterior.errors.likelihood import ModalLikelihood
from fmu.types import FloatArray, IntArray


def error_variances(
    likelihood: ModalLikelihood, model: SurrogateModel, theta: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return two variances of the log-probability error at theta (n, ndim), each of shape (n,).

    The first is due to the surrogate's own uncertainty, the second to the scatter of the solver.
    """
    of_frequency, of_shape = likelihood.sensitivity_to_model(theta)
    structural = theta[:, : model.n_parameters]
    v, shape_v = model.variances(structural)
    expected = np.sum(of_frequency * v, axis=1) + np.sum(of_shape * shape_v, axis=(1, 2))
    of_scatter = np.sum(model.weights_of_learnt(structural, of_frequency) * model.scatter**2, axis=1)
    for i, process in enumerate(model.of_shapes):
        of_scatter += np.sum(of_shape[:, :, i] * process.scatter**2, axis=1)
    return np.asarray(expected), np.asarray(of_scatter)


def choose_draws(likelihood: ModalLikelihood, model: SurrogateModel, draws: FloatArray, n: int) -> IntArray:
    """Return the indices (n,) of the posterior draws (N, ndim) at which to solve the model.

    The draws are selected one by one. Each minimises the variance of the log-probability that remains after it is
    solved, averaged over the posterior. This is a sequential integrated-variance design (Sacks, Welch, Mitchell &
    Wynn 1989, *Stat. Sci.* 4, 409–435), weighted by the posterior and by the sensitivity of the likelihood. Each
    selected point reduces the variance around it, so the points of a batch are not close together.
    """
    of_frequency, of_shape = likelihood.sensitivity_to_model(draws)
    x = model.coordinates.to_x(draws[:, : model.n_parameters])
    of_learnt = model.weights_of_learnt(draws[:, : model.n_parameters], of_frequency)
    ends = np.cumsum([len(process.unit) for process in model.of_frequencies])[:-1]
    by_process = np.split(of_learnt, ends, axis=1) + [of_shape[:, :, i] for i in range(len(model.of_shapes))]
    processes = (*model.of_frequencies, *model.of_shapes)
    covariances, scatters = map(list, zip(*(process.covariance(x) for process in processes), strict=True))
    weights = [weight @ process.unit**2 for weight, process in zip(by_process, processes, strict=True)]
    found: list[int] = []
    for _ in range(n):
        gain = np.zeros(len(draws))
        for covariance, scatter, weight in zip(covariances, scatters, weights, strict=True):
            gain += weight @ covariance**2 / (np.diag(covariance) + scatter)
        gain[found] = -np.inf
        best = int(np.argmax(gain))
        found.append(best)
        for k, (covariance, scatter) in enumerate(zip(covariances, scatters, strict=True)):
            column = covariance[:, best]
            covariances[k] = covariance - np.outer(column, column) / (column[best] + scatter)
    return np.array(found)


def stratify(uncertainty: FloatArray, n: int, rng: np.random.Generator) -> IntArray:
    """Sort the draws by `uncertainty` (N,), divide them into n groups of about equal size, and pick one from each.

    Return the indices of the picked draws, shape (n,). Within a group, the choice is random.
    """
    groups = np.array_split(np.argsort(uncertainty, kind="stable"), n)
    return np.array([rng.choice(group) for group in groups])
