"""Models of a generator: none costs more than its budget of counted work, none is wrong, no library warns.

Up to 300 degrees of freedom frequencies are compared with a solution refined in extended precision, above with a
dense one. The frequencies may differ by ten times the rounding that the cancellation in φᵀKφ allows.
"""

import warnings

import numpy as np
import pytest
import scipy.linalg as sl

import fmu
from fmu.fem.modes.full_block import full_model
from fmu.fem.reduced.training import BUDGET
from fmu.posterior.rounding import RoundingWarning
from fmu.posterior.train_reduced import ReductionWarning
from tests.models.random_models import random_model
from tests.work import counted

MODES = 3
EXTENDED = 300
SAMPLE, ALL = range(100, 105), range(40)
REFUSED = "rounding: "
"""How a refusal begins: a soft part beside one that is eight decades stiffer may have lost its digits."""


def lowest(K, M, count):
    """Return the lowest λ (count,) and shapes of K φ = λ M φ by a dense solver; of a small problem refined.

    From the inverse problem M x = μ (K + s M) x at a unit diagonal, which has the digits of the low modes whatever
    M lacks; then by subspace iteration with residuals and Rayleigh quotients in extended precision.
    """
    shift = 1e-6 * np.trace(K) / np.trace(M)
    A = K + shift * M
    scale = 1.0 / np.sqrt(np.diag(A))
    S, B = scale[:, None] * A * scale, scale[:, None] * M * scale
    mu, X = sl.eigh(B, S, subset_by_index=[len(K) - count, len(K) - 1])
    lam, X = 1.0 / mu[::-1] - shift, X[:, ::-1]
    if len(K) > EXTENDED:
        return lam, scale[:, None] * X
    long = scale.astype(np.longdouble)
    stiff, heavy = (long[:, None] * part.astype(np.longdouble) * long for part in (K, M))
    factors, Y = sl.cho_factor(S), X.astype(np.longdouble)
    for _ in range(4):
        load = heavy @ Y
        Y = np.zeros_like(load)
        for _ in range(4):
            Y += sl.cho_solve(factors, (load - stiff @ Y - shift * (heavy @ Y)).astype(float))
        energy, gram = (Y.T @ (part @ Y) for part in (stiff + shift * heavy, heavy))
        unit = 1.0 / np.sqrt(np.diag(energy))
        small = [(unit[:, None] * part * unit).astype(float) for part in (gram, energy)]
        Y = Y @ (unit[:, None] * sl.eigh(*small)[1][:, ::-1])
    lam = np.sum(Y * (stiff @ Y), axis=0) / np.sum(Y * (heavy @ Y), axis=0)
    return lam.astype(float), scale[:, None] * Y.astype(float)


def exact(random, theta):
    """Return the lowest elastic frequencies in Hz, (MODES,), and how far rounding may move each, relative."""
    K, M = random.model.K(theta).toarray(), random.model.M(theta).toarray()
    lam, phi = lowest(K, M, MODES + 12)
    n_rigid = 6 * random.free + 3 * random.mechanism
    elastic = np.argsort(lam)[n_rigid : n_rigid + MODES]
    phi = phi[:, elastic] / np.sqrt(np.sum(phi[:, elastic] * (M @ phi[:, elastic]), axis=0))
    sizes = np.sum(np.abs(phi) * (np.abs(K) @ np.abs(phi)), axis=0)
    rounding = 0.5 * np.finfo(float).eps * (sizes / lam[elastic] + len(K) ** 0.5)
    return np.sqrt(lam[elastic]) / (2.0 * np.pi), rounding


def require_right(seed, most_dofs):
    """Pose a problem on the model of a seed, and fail if it costs too much, is wrong, or a library warns."""
    random = random_model(seed, most_dofs)
    start = np.ones(len(random.parameters))
    n_rigid = 6 * random.free + 3 * random.mechanism
    spectrum = full_model(random.model).spectrum(1.03 * start[None], n_rigid + MODES)
    measured = np.sqrt(spectrum.eigenvalues[0, n_rigid:]) / (2.0 * np.pi)
    measured = np.maximum(measured, 1e-3)  # data, compared with nothing; 0 where a soft part is lost in rounding
    data = fmu.ModalData(measured, sd_hz=5e-3 * measured)
    with warnings.catch_warnings(), counted() as work:
        warnings.simplefilter("error")
        warnings.simplefilter("ignore", ReductionWarning)
        warnings.simplefilter("ignore", RoundingWarning)
        try:
            problem = fmu.UpdatingProblem.reduced(random.model, data, random.parameters, pairing="index")
        except ValueError as error:
            if not (str(error).startswith(REFUSED) and random.decades > 1.0):
                pytest.fail(f"{random}: {error}")
            return
        n_points = 2 if random.model.n_dof <= EXTENDED else 1
        theta = np.random.default_rng(seed).uniform(0.7, 1.3, size=(n_points, len(start)))
        full, answered = problem.model.full_frequencies(theta), problem.frequencies(theta)
        assert np.isfinite(problem.log_prob_and_grad(theta)[0]).all(), random
    # an eigenproblem of the full model takes about 40 solves and 4 factorisations
    assert work.factorisations <= 4 * BUDGET, random
    assert work.solves <= 60 * BUDGET, random
    tolerance = 1e-6 if problem.tolerance is None or problem.model.confirmed else 1e-2
    for row, point in enumerate(theta):
        frequencies, rounding = exact(random, point)
        if np.max(10.0 * rounding) > 0.05:  # double precision has no digits of the lowest mode: no reference
            return
        assert np.all(np.abs(full[row] / frequencies - 1.0) <= 10.0 * rounding), random
        assert np.all(np.abs(answered[row] / frequencies - 1.0) <= 10.0 * rounding + tolerance), random


@pytest.mark.parametrize("seed", SAMPLE)
def test_some_small_models(seed, monkeypatch):
    monkeypatch.setenv("FMU_CACHE_DIR", "")
    require_right(seed, 700)


@pytest.mark.validate
@pytest.mark.parametrize("seed", ALL)
def test_forty_models(seed, monkeypatch):
    monkeypatch.setenv("FMU_CACHE_DIR", "")
    require_right(seed, 5000)
