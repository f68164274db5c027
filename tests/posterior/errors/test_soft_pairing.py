"""A likelihood that does not jump where modes veer: against the one that does, and against differences."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.special import logsumexp

import fmu
from fmu.fem.modes.modal import mac
from fmu.posterior.errors.mixture import MixtureLikelihood
from tests.gradients import assert_gradient
from tests.veering import SENSORS, SHAPES, veering_model, veering_problem

NOISE = fmu.Parameter("sigma", start=0.02, lower=1e-3, upper=1.0)
ERRORS = {
    "plain": "frequency",
    "absolute": [fmu.FrequencyErrors("absolute", sd=0.05)],
    "relative": [fmu.FrequencyErrors("relative", sd=NOISE)],
    "eigenvalue": [fmu.FrequencyErrors("eigenvalue", sd=0.02, weights=[1.0, 2.0])],
    "shapes": [fmu.FrequencyErrors(sd=0.01), fmu.ShapeErrors(sd=0.2)],
    "shapes, inferred": [fmu.ShapeErrors(sd=0.1, model_sd=NOISE)],
    "MAC": [fmu.FrequencyErrors(sd=NOISE), fmu.MACErrors(sd=0.2)],
}


@pytest.fixture(scope="module")
def veering():
    return {pairing: veering_problem(pairing=pairing) for pairing in ("shape", "soft")}


@pytest.fixture(scope="module")
def switch(veering):
    """Two parameter vectors 1e-9 apart, on the two sides of a jump of the one-to-one assignment."""
    low, high = 1.0, 1.15
    rank = lambda a: veering["shape"].model.truth.modes(np.array([[a, 1.0]])).rank[0, 0]  # noqa: E731
    while high - low > 1e-9:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if rank(middle) == rank(1.0) else (low, middle)
    return np.array([[low, 1.0], [high, 1.0]])


def through(n=41, ndim=2):
    theta = np.full((n, ndim), NOISE.start)
    theta[:, 0], theta[:, 1] = np.linspace(0.9, 1.15, n), 1.0
    return theta


def by_hand(theta, tau):
    """Return the log-likelihood of frequencies 5 and 5.1 Hz with σ = 0.05 Hz, written out for one theta."""
    K = 1e3 * (np.diag([*theta, 9.0]) + [[0.02, -0.02, 0.0], [-0.02, 0.12, -0.1], [0.0, -0.1, 0.1]])  # noqa: RUF005
    lam, phi = np.linalg.eigh(K)
    f, alike = np.sqrt(lam) / (2 * np.pi), mac(phi, SHAPES)
    log_w = alike / tau - logsumexp(alike / tau, axis=1, keepdims=True)
    log_p = -0.5 * ((f - np.array([[5.0], [5.1]])) / 0.05) ** 2 - np.log(0.05 * np.sqrt(2 * np.pi))
    return logsumexp(log_w + log_p, axis=1)


@pytest.mark.parametrize("tau", [0.02, 0.2])
def test_the_mixture_written_out(tau):
    problem = veering_problem(pairing="soft", softness=tau)
    assert isinstance(problem.likelihood, MixtureLikelihood)
    theta = through(11)
    assert_allclose(problem.log_likelihood_terms(theta), [by_hand(point, tau) for point in theta], rtol=1e-9)


def test_hard_pairing_jumps_and_soft_does_not(veering, switch):
    hard, soft = (np.diff(veering[pairing].log_prob(switch))[0] for pairing in ("shape", "soft"))
    assert abs(hard) > 3.0
    assert abs(soft) < 1e-5
    assert abs(soft) < 3e4 * 1e-9


@pytest.mark.parametrize("name", ERRORS)
@pytest.mark.parametrize("reduction", [True, False], ids=["reduced", "full"])
def test_gradient_right_through_the_veering(name, reduction, switch):
    problem = veering_problem(pairing="soft", error=ERRORS[name], reduction=reduction)
    theta = through(ndim=problem.ndim)
    theta[:2, :2] = switch
    value, gradient = problem.log_prob_and_grad(theta)
    assert_allclose(value, problem.log_prob(theta), rtol=1e-12)
    assert_gradient(gradient, problem.log_prob, theta, 2e-5, order=4, of_largest=1e-6)


@pytest.mark.parametrize("reduction", [True, False], ids=["reduced", "full"])
def test_gradient_where_sensors_see_a_part_and_masses_change(reduction):
    rng = np.random.default_rng(6)
    A, B, C, D = (x @ x.T for x in rng.standard_normal((4, 5, 5)))
    K = [fmu.Term(1e3 * A, (1.0, 0.0)), fmu.Term(1e3 * B, (0.0, 0.0))]
    M = [fmu.Term(np.eye(5) + 0.1 * C, (0.0, 0.0)), fmu.Term(0.2 * D, (0.0, 1.0))]
    data = fmu.ModalData([2.0, 6.0], sensors=((0, "x"), (2, "x"), (3, "x")), shapes=rng.standard_normal((3, 2)))
    problem = fmu.UpdatingProblem.reduced(
        fmu.SeparableModel(K, M),
        data,
        [fmu.Parameter("k", 1.0, 0.5, 2.0), fmu.Parameter("m", 1.0, 0.5, 2.0)],
        pairing="soft",
        softness=0.2,
        error=[fmu.FrequencyErrors(sd=0.3), fmu.ShapeErrors(sd=0.5)],
        reduction=reduction,
    )
    theta = rng.uniform(0.6, 1.8, size=(6, 2))
    gradient = problem.log_prob_and_grad(theta)[1]
    assert_gradient(gradient, problem.log_prob, theta, 1e-3, order=4, of_largest=1e-6)


def test_far_from_the_veering_soft_is_hard(veering):
    """Where every measured shape has one mode that is like it, MAC above 0.95, to a millionth of a nat."""
    rng = np.random.default_rng(1)
    theta = rng.uniform(0.8, 1.3, size=(4000, 2))
    theta = theta[theta[:, 1] - theta[:, 0] > 0.15]
    seen = veering["shape"].model.observed(theta)
    assert all(np.diag(mac(shapes, SHAPES)).min() > 0.95 for shapes in seen.shapes)
    near = veering["shape"].log_prob(theta) > -30  # the maximum is about −5
    assert near.sum() > 5
    hard, soft = (veering[pairing].log_prob(theta[near]) for pairing in ("shape", "soft"))
    assert_allclose(soft, hard, atol=1e-6)


def test_rows_do_not_depend_on_their_batch():
    problem = veering_problem(pairing="soft", error=ERRORS["MAC"])
    theta = through(17, 3)
    assert_array_equal(problem.log_prob(theta), [problem.log_prob(point) for point in theta])
    value, gradient = problem.log_prob_and_grad(theta)
    for i, point in enumerate(theta):
        one = problem.log_prob_and_grad(point)
        assert one[0] == value[i]
        assert_array_equal(one[1], gradient[i])


def test_the_full_model_answers_outside_the_box(veering):
    theta = np.array([[1.0, 1.0], [0.5, 1.0], [1.0, 2.0]])
    before = veering["soft"].model.full_solves
    soft = veering["soft"].log_likelihood(theta)
    assert veering["soft"].model.full_solves == before + 2
    assert_allclose(
        soft,
        veering["soft"].with_model(veering["soft"].model.truth).likelihood.terms(theta).sum(axis=1),
        rtol=1e-9,
    )


def test_references_of_the_initial_model():
    """No shapes measured: compared at all translations, in each block's own coordinates."""
    problem = fmu.cases.load("cantilever-young", "soft")
    hard = fmu.cases.load("cantilever-young", "shape")
    assert problem.model.sizes
    rng = np.random.default_rng(2)
    theta = hard.sample_prior(rng, 4)
    assert_allclose(problem.log_prob(theta), hard.log_prob(theta), rtol=1e-5)
    _, gradient = problem.log_prob_and_grad(theta)
    h = 1e-3 * problem.scale  # with 1e-4 rounding, 1e-16 λ_max/λ_1 = 2e-9 of λ, shows
    for k in range(problem.ndim):
        step = h[k] * np.eye(problem.ndim)[k]
        near, far = (problem.log_prob(theta + j * step) - problem.log_prob(theta - j * step) for j in (1, 2))
        reference = (8 * near - far) / 12
        size = np.max(np.abs(gradient * h), axis=1)
        assert np.max(np.abs(gradient[:, k] * h[k] - reference) / size) < 1e-6
    mac_full = problem.model.truth.seen_candidates(theta).mac
    assert_allclose(problem.model.seen_candidates(theta).mac, mac_full, atol=1e-4)


def test_a_mode_that_no_sensor_sees_has_no_share():
    """Two equal masses, sensors on the first two of three: what moves the third alone is left out."""
    K = [fmu.Term(1e3 * np.diag([1.0, 1.5, 0.0]), (1.0,)), fmu.Term(1e3 * np.diag([0.0, 0.0, 1.0]), (0.0,))]
    link = np.zeros((3, 3))
    link[:2, :2] = [[0.1, -0.1], [-0.1, 0.1]]
    K.append(fmu.Term(1e3 * link, (0.0,)))
    # a tie of no stiffness at θ = 1 alone would not couple the blocks: the third mass is coupled in mass
    M = [fmu.Term(np.eye(3), (0.0,))]
    coupling = np.zeros((3, 3))
    coupling[0, 2] = coupling[2, 0] = 1e-30
    model = fmu.SeparableModel([*K, fmu.Term(coupling, (0.0,))], M)
    assert len(model.blocks) == 1
    data = fmu.ModalData([5.2, 6.4], sensors=SENSORS[:2], shapes=[[1.0, -0.1], [0.1, 1.0]])
    problem = fmu.UpdatingProblem(
        model,
        data,
        [fmu.Parameter("k", 1.1, 0.5, 2.0)],
        pairing="soft",
        error=[fmu.FrequencyErrors(sd=0.01), fmu.ShapeErrors(sd=0.1)],
    )
    theta = np.array([[0.9], [1.0], [1.2]])
    candidates = problem.model.truth.seen_candidates(theta)
    unseen = np.isneginf(candidates.mac).all(axis=1)
    assert_array_equal(unseen.sum(axis=1), 1)
    assert_allclose(candidates.frequencies[unseen], np.sqrt(1e3) / (2 * np.pi))
    value, gradient = problem.log_prob_and_grad(theta)
    assert np.all(np.isfinite(value))
    assert_gradient(gradient, problem.log_prob, theta, 2e-5, order=4, rtol=1e-6)


@pytest.mark.validate
def test_hamiltonian_trajectories_across_the_veering():
    """Jumps of the log-probability cost steps: warm-up shortens them until trajectories that meet one are rare."""
    rhat, rate, per_gradient, means = {}, {}, {}, {}
    for pairing in ("shape", "soft"):
        problem = veering_problem(pairing=pairing, c=0.01, frequencies=(5.17, 5.12), sd_hz=0.03)
        trace = fmu.sample(problem, "hmc", draws=120, warmup=150, seed=2)
        table = fmu.summary(trace)
        rhat[pairing] = table["rhat"].max()
        rate[pairing] = float(trace["sample_stats"]["acceptance_rate"].mean())
        per_gradient[pairing] = table["ess_bulk"].min() / int(trace["sample_stats"]["n_gradients"].sum())
        means[pairing] = table["mean"].to_numpy()
        assert fmu.pairing_changes(trace).rule == pairing
    assert rhat["soft"] < 1.03
    assert rate["soft"] > 0.65
    assert rate["shape"] > 0.5
    assert per_gradient["soft"] > 1.5 * per_gradient["shape"]
    assert_allclose(means["soft"], means["shape"], atol=0.005)  # a half of a standard deviation


def test_maxima_certificate_and_predictions():
    problem = veering_problem(pairing="soft", error=ERRORS["shapes"])
    maxima = fmu.find_map(problem, starts=8)
    assert_allclose(problem.log_prob_and_grad(maxima[0].theta)[1] * maxima[0].sd, 0.0, atol=1e-3)
    trace = fmu.sample(problem, "hmc", draws=30, warmup=50, chains=2, maxima=maxima)
    assert trace.attrs["certificate_log_prob_error"] < 1e-3
    assert set(trace["posterior_predictive"].data_vars) == {"frequency", "model_frequency"}
    assert list(trace["identifiability"]["parameter"].to_numpy()) == ["k1", "k2"]
    assert problem.configuration()["likelihood"]["softness"] == 0.02


def test_from_a_file(tmp_path):
    text = fmu.cases.path("cantilever-young").read_text()
    path = tmp_path / "soft.toml"
    path.write_text('pairing = "soft"\nsoftness = 0.05\nreduction = false\n' + text)
    problem = fmu.load(path)
    assert isinstance(problem.likelihood, MixtureLikelihood)
    assert problem.model.softness == 0.05
    path.write_text('pairing = "soft"\nsoftness = 0.0\n' + text)
    with pytest.raises(ValueError, match=r"softness: must be greater than 0"):
        fmu.load(path)


def test_what_the_data_can_tell_is_about_the_mode_of_the_same_shape():
    """At a start where the frequency of another mode fits better, both parameters are still informed."""
    soft = veering_problem(pairing="soft", softness=0.1, sd_hz=0.01, frequencies=(5.3, 5.33))
    hard = veering_problem(pairing="shape", sd_hz=0.01, frequencies=(5.3, 5.33))
    theta = np.array([[0.9, 1.0]])
    assert soft.log_likelihood(theta) > hard.log_likelihood(theta) + 100.0  # it takes the second mode for both
    assert_allclose(soft.sensitivity(theta)[0], hard.sensitivity(theta)[0], rtol=1e-6)


def test_what_does_not_go_with_it():
    with pytest.raises(ValueError, match=r"^softness: must be a positive finite number \(got 0\.0\)$"):
        veering_problem(pairing="soft", softness=0.0)
    data = fmu.ModalData([5.0, 5.1], sensors=SENSORS, shapes=SHAPES, covariance_hz2=np.diag([0.01, 0.02]))
    parameters = [fmu.Parameter(f"k{k}", 1.0, 0.8, 1.3) for k in (1, 2)]
    with pytest.raises(ValueError, match=r"^pairing: soft needs errors that are independent from mode to mode"):
        fmu.UpdatingProblem.reduced(veering_model(0.02), data, parameters, pairing="soft")
    black_box = fmu.BlackBoxModel(lambda theta: np.array([5.0, 5.1]) * theta[0], 2)
    with pytest.raises(ValueError, match=r"^pairing: soft needs a SeparableModel"):
        fmu.UpdatingProblem.reduced(black_box, fmu.ModalData([5.0, 5.1]), parameters, pairing="soft")
    with pytest.raises(
        ValueError, match=r"^pairing: must be one of \('shape', 'index', 'soft'\) \(got 'softly'\)$"
    ):
        veering_problem(pairing="softly")
