"""A box so wide that a basis for it would not pay: the tolerance is kept where the posterior has its mass."""

from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import fmu
from fmu.analysis.certificate import CertificateWarning, certify
from fmu.fem.modes.eigensolver import eigen
from fmu.fem.modes.modal import frequency_hz
from fmu.fem.reduced import training
from fmu.posterior.reduction.region import PLAUSIBLE, plausible_points
from fmu.posterior.reduction.tolerance import Tolerance, next_power_of_ten
from fmu.posterior.reduction.train_reduced import LOOSEST_LOG_PROB, ReductionWarning, _warn_if_missed
from tests.validation.scale_model import NOISE, E, Size, frame

PARAMETERS, MODES, PAYS = 3, 6, 60
TRUTH = E * np.array([1.1, 0.8, 1.3])


def wide():
    """Return the problem of a frame whose moduli are known within a factor of three, up or down."""
    whole = frame(Size(12, 3, 2), PARAMETERS)
    names = [f"E_{group.name}" for group in whole.groups]
    model = whole.separable({f"E_{group.name}": [("E", group.name)] for group in whole.groups})
    exact = frequency_hz(eigen(model.K(TRUTH), model.M(TRUTH), MODES)[0])
    data = fmu.ModalData(exact, sd_hz=NOISE * exact)
    parameters = [fmu.Parameter(name, start=E, lower=E / 3.0, upper=3.0 * E) for name in names]
    return fmu.UpdatingProblem.reduced(model, data, parameters, pairing="index")


@pytest.fixture(scope="module")
def made(tmp_path_factory, certified):
    patch = pytest.MonkeyPatch()
    patch.setenv("FMU_CACHE_DIR", str(tmp_path_factory.mktemp("cache")))
    patch.setattr(training, "affordable", lambda n_dof: PAYS)
    with pytest.warns(ReductionWarning) as said:
        problem = wide()
    trace = fmu.sample(problem, draws=100, warmup=60, chains=2, seed=1, maxima=fmu.find_map(problem, starts=2))
    yield problem, trace, [str(warning.message) for warning in said]
    patch.undo()


def off(problem, theta):
    return np.max(np.abs(problem.frequencies(theta) / problem.model.truth.frequencies(theta) - 1.0), axis=1)


def test_it_is_told_and_again_when_it_comes_from_the_cache(made):
    problem, _, said = made
    (message,) = said
    assert message.startswith(
        "reduction: within the bounds a basis for frequencies to 1e-06 would not pay; this one"
    )
    assert "keeps it where the posterior has its mass, and 0.001 elsewhere" in message
    with pytest.warns(ReductionWarning) as again:
        second = wide()
    assert [str(warning.message) for warning in again] == said
    theta = problem.sample_prior(np.random.default_rng(0), 20)
    assert_array_equal(second.log_prob(theta), problem.log_prob(theta))


def test_the_box_keeps_a_thousandth_and_the_region_the_tolerance(made):
    problem, *_ = made
    (size,) = problem.model.sizes
    assert size < PAYS
    theta = problem.sample_prior(np.random.default_rng(2), 60)
    assert 1e-5 < off(problem, theta).max() <= 1e-3
    region = plausible_points(problem, 40, np.random.default_rng(3))
    assert off(problem, region).max() <= 1e-6


def test_the_posterior_is_that_of_the_full_model(made):
    problem, trace, _ = made
    draws = np.concatenate(np.stack([trace["posterior"][name] for name in problem.names], axis=-1))[::2]
    exact = np.sum(problem.with_model(problem.model.truth).likelihood.terms(draws), axis=1)
    found = np.sum(problem.likelihood.terms(draws), axis=1)
    plausible = exact > exact.max() - PLAUSIBLE
    assert np.all(plausible)
    assert np.max(np.abs(found - exact)) <= 1e-3
    # the draws, weighted as those of the full model, have the same moments
    weights = np.exp(exact - found)
    moments = [np.average(draws, axis=0, weights=w) for w in (weights, np.ones(len(draws)))]
    assert_allclose(*moments, rtol=0, atol=1e-3 * draws.std(axis=0).min())
    assert trace.attrs["certificate_frequency_error"] <= 1e-6
    assert trace.attrs["certificate_log_prob_error"] <= 1e-3
    assert trace.attrs["certificate_bound"] < 5e-6


def test_the_certificate_says_when_draws_leave_the_region(made):
    """A few draws far off among many, none of which a sample of them need hold."""
    problem, trace, _ = made
    far = trace.copy(deep=True)
    corner = np.where([True, False, True], 1.01 * problem.lower, 0.99 * problem.upper)
    for name, value in zip(problem.names, corner, strict=True):
        far["posterior"][name].values[0, :2] = value
    with pytest.warns(CertificateWarning, match="outside its tolerance"):
        certificate = certify(far, problem)
    assert certificate.bound > 1e-5
    assert certificate.frequency_error > 1e-5
    assert certificate.bound_exceeded == 0


def test_powers_of_ten_are_exact():
    """Those of NumPy are not: 10 ** -5 was 9.999999999999999e-06."""
    assert [next_power_of_ten(x) for x in (2e-6, 1e-5, 1.0001e-5, 3.0)] == [1e-5, 1e-5, 1e-4, 10.0]


@pytest.mark.parametrize(
    ("elsewhere", "kept"),
    [(1e-5, "1e-05;"), (1e-3, "1e-05 where the posterior has its mass, and 0.001 elsewhere;")],
)
def test_one_tolerance_everywhere_is_told_once(elsewhere, kept):
    state = {"elsewhere": np.array(elsewhere), "loosened": np.array([1e-5, LOOSEST_LOG_PROB])}
    with pytest.warns(ReductionWarning, match=f"this one of 9 vectors keeps {kept}"):
        _warn_if_missed(None, SimpleNamespace(sizes=(9,)), Tolerance(), state)


@pytest.mark.validate
def test_where_no_basis_pays_there_either_one_is_trained_at_draws(made, monkeypatch):
    monkeypatch.setenv("FMU_CACHE_DIR", "")
    monkeypatch.setattr(training, "affordable", lambda n_dof: 40)
    with pytest.warns(ReductionWarning, match="would not pay; this one of .* vectors keeps .* where "):
        problem = wide()
    assert problem.tolerance.log_prob == LOOSEST_LOG_PROB
