"""Functions of the user's own: their contract, pairing, gradients, and what happens where they fail."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import fmu
from fmu.fem.black_box import BlackBoxModel
from fmu.fem.programs.solves import MOST_REASONS
from tests.shear_building import shear_building, storey

M = np.diag([2.0, 1.0])
K_PARTS = np.array([storey(0, 2), storey(1, 2)])
PARAMETERS = [fmu.Parameter(name, 300.0, 100.0, 600.0) for name in ("k1", "k2")]
START = np.array([300.0, 300.0])


def solved(theta):
    """Frequencies, shapes and gradients of two storeys, all from one eigenproblem."""
    lam, y = np.linalg.eigh(np.tensordot(theta, K_PARTS, 1) / np.sqrt(np.outer(M.diagonal(), M.diagonal())))
    phi = y / np.sqrt(M.diagonal())[:, None]
    f = np.sqrt(lam) / (2 * np.pi)
    slopes = np.einsum("im,kij,jm->mk", phi, K_PARTS, phi) / (8 * np.pi**2 * f[:, None])
    return f, phi, slopes


def frequencies(theta):
    return solved(theta)[0]


def everything(theta):
    return dict(zip(("frequencies", "shapes", "gradient"), solved(theta), strict=True))


def batched(theta):
    return tuple(np.stack(part) for part in zip(*map(solved, theta), strict=True))


SEPARABLE = shear_building(["k1", "k2"], mass=M)
DATA = fmu.ModalData(1.05 * frequencies(START), sensors=((0, "x"), (1, "x")), shapes=solved(START)[1])


def problem(model, data=DATA, **settings):
    return fmu.UpdatingProblem.reduced(model, data, PARAMETERS, beta=2.0, **settings)


@pytest.fixture(scope="module")
def matrices():
    return problem(SEPARABLE, reduction=False)


@pytest.fixture
def theta():
    return np.random.default_rng(1).uniform(100.0, 600.0, (20, 2))


FORMS = [
    (frequencies, {}),
    (lambda theta: frequencies(theta).tolist(), {}),
    (lambda theta: tuple(frequencies(theta)), {}),
    (lambda theta: {"frequencies": frequencies(theta)}, {}),
    (everything, {}),
    (solved, {}),
    (lambda theta: solved(theta)[:2], {}),
    (lambda theta: (frequencies(theta), None, solved(theta)[2]), {}),
    (batched, {"batched": True}),
    (lambda theta: batched(theta)[0], {"batched": True}),
]


@pytest.mark.parametrize(("function", "settings"), FORMS)
def test_every_form_gives_the_posterior_of_the_matrices(matrices, theta, function, settings):
    posed = problem(BlackBoxModel(function, 2, **settings))
    assert_allclose(posed.log_prob(theta), matrices.log_prob(theta), rtol=1e-12)
    value, gradient = posed.log_prob_and_grad(theta)
    expected_value, expected = matrices.log_prob_and_grad(theta)
    assert_allclose(value, expected_value, rtol=1e-12)
    assert_allclose(gradient, expected, rtol=1e-5, atol=1e-7 * np.abs(expected).max())
    assert_array_equal(posed.log_prob(theta), [posed.log_prob(point) for point in theta])


def test_differences_are_of_second_order(matrices, theta):
    """Halving the step divides the error by four."""
    theta = np.clip(theta, 150.0, 550.0)
    exact = matrices.model.frequencies_and_gradient(theta)[1]
    errors = []
    for step in (2e-2, 1e-2, 5e-3):
        found = problem(BlackBoxModel(frequencies, 2, step=step)).model.frequencies_and_gradient(theta)[1]
        errors.append(np.sqrt(np.mean((found - exact) ** 2)))
    assert_allclose(np.array(errors[:-1]) / errors[1:], 4.0, rtol=0.05)


def test_differences_stay_within_the_bounds():
    asked = []

    def function(theta):
        asked.append(theta)
        return frequencies(theta)

    posed = problem(BlackBoxModel(function, 2, step=0.05))
    corners = np.array([[100.0, 600.0], [600.0, 100.0], [100.0, 100.0]])
    _, gradient = posed.model.frequencies_and_gradient(corners)
    assert np.min(asked) >= 100.0
    assert np.max(asked) <= 600.0
    assert_allclose(gradient, np.stack([solved(corner)[2] for corner in corners]), rtol=0.1, atol=1e-4)


def test_outside_the_bounds_there_are_frequencies_too():
    posed = problem(BlackBoxModel(frequencies, 2))
    assert_allclose(posed.frequencies([50.0, 700.0]), frequencies([50.0, 700.0]), rtol=1e-12)
    slope = posed.model.frequencies_and_gradient(np.array([[50.0, 700.0]]))[1]
    assert_allclose(slope[0], solved([50.0, 700.0])[2], rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize(("function", "cost"), [(frequencies, 5), (everything, 1)])
def test_what_a_gradient_costs_is_counted(function, cost):
    calls = []

    def counted(theta):
        calls.append(theta)
        return function(theta)

    posed = problem(BlackBoxModel(counted, 2))
    assert posed.solves_per_gradient == cost
    calls.clear()
    trace = fmu.sample(
        posed, fmu.HamiltonianMonteCarlo(step_size=0.1, n_steps=3), draws=4, warmup=0, chains=2, init="start"
    )
    stats = trace["sample_stats"]
    assert int(stats["n_solves"].sum()) == cost * int(stats["n_gradients"].sum())
    assert trace.attrs["n_solves"] == int(stats["n_solves"].sum())


def test_pairing_by_shape_finds_modes_whatever_their_order(matrices, theta):
    def reversed_with_a_stranger(theta):
        f, phi, slopes = solved(theta)
        return (
            np.array([f[1], 0.5, f[0]]),
            np.column_stack([-3 * phi[:, 1], [0.0, 0.0], phi[:, 0]]),
            np.array([slopes[1], [0.0, 0.0], slopes[0]]),
        )

    posed = problem(BlackBoxModel(reversed_with_a_stranger, 2))
    assert posed.model.by_shape
    assert_allclose(posed.frequencies(theta), matrices.frequencies(theta), rtol=1e-12)
    assert_allclose(posed.log_prob_and_grad(theta)[1], matrices.log_prob_and_grad(theta)[1], rtol=1e-8)
    by_number = problem(BlackBoxModel(reversed_with_a_stranger, 2), pairing="index")
    assert not by_number.model.by_shape
    assert_allclose(by_number.frequencies(START), [frequencies(START)[1], 0.5], rtol=1e-12)


def test_pairing_by_number():
    data = fmu.ModalData([3.0], numbers=(2,))
    posed = problem(BlackBoxModel(everything, 2), data)
    assert_allclose(posed.frequencies(START), frequencies(START)[1:], rtol=1e-12)
    with pytest.raises(ValueError, match=r"^counterparts: must not be given where modes are paired by number"):
        problem(BlackBoxModel(everything, 2), fmu.ModalData([3.0], counterparts=(2,)))


def fails_beyond(limit, failure):
    def function(theta):
        return failure(theta) if theta[0] > limit else frequencies(theta)

    return function


def stop(theta):
    raise RuntimeError("no convergence\n  after 10 steps")


UNEQUAL = (
    "setting an array element with a sequence. The requested array has an inhomogeneous shape after 1 dimensions. "
    "The detected shape was (2,) + inhomogeneous part."
)
FAILURES = [
    (stop, "RuntimeError: no convergence after 10 steps"),
    (lambda theta: np.linalg.inv(np.zeros((2, 2))), "LinAlgError: Singular matrix"),
    (lambda theta: [np.nan, 1.0], "frequencies: must be finite and not negative (got [nan, 1.0])"),
    (
        lambda theta: np.ma.masked_array([2, 1], [True, False]),
        "frequencies: must be finite and not negative (got [nan, 1.0])",
    ),
    (lambda theta: [-1.0, 1.0], "frequencies: must be finite and not negative (got [-1.0, 1.0])"),
    (lambda theta: [1.0], "must give the measured modes, numbers [1, 2] (gave 1 modes)"),
    (lambda theta: 1.0, "frequencies: must have shape (n,) (got ())"),
    (lambda theta: None, "frequencies: must be real numbers (got nothing)"),
    (lambda theta: "soft", "frequencies: must be real numbers (got str of <U4)"),
    (lambda theta: [[1.0, 2.0], [3.0]], f"frequencies: must be an array with rows of equal length ({UNEQUAL})"),
    (
        lambda theta: ([1.0, 2.0], [[1.0, 2.0], [3.0]]),
        f"shapes: must be an array with rows of equal length ({UNEQUAL})",
    ),
    (lambda theta: {"f": [1.0]}, "must return frequencies, and may return shapes and gradient (got ['f'])"),
    (lambda theta: ([1.0, 2.0], np.ones((2, 3))), "shapes: must have shape (n_sensors, 2) (got (2, 3))"),
    (lambda theta: ([1.0, 2.0], None, np.ones(2)), "gradient: must have shape (2, 2) (got (2,))"),
    (lambda theta: exit(3), "SystemExit: 3"),
]


@pytest.mark.parametrize(("failure", "reason"), FAILURES)
def test_a_point_that_fails_is_recorded_and_the_rest_goes_on(failure, reason):
    posed = problem(BlackBoxModel(fails_beyond(500.0, failure), 2))
    points = np.array([[300.0, 200.0], [550.0, 200.0], [400.0, 200.0]])
    value = posed.log_prob(points)
    assert_array_equal(np.isfinite(value), [True, False, True])
    assert_array_equal([failed.theta for failed in posed.failures], points[1:2])
    assert posed.failures[0].reason == reason
    assert_array_equal(posed.model.reasons[0].theta, points[1])
    assert posed.model.reasons[0].reason == reason


@pytest.mark.parametrize(("failure", "reason"), FAILURES)
def test_a_function_that_fails_at_the_start_is_refused(failure, reason):
    with pytest.raises(ValueError, match=r"^model\.function: ") as caught:
        problem(BlackBoxModel(failure, 2))
    assert reason in str(caught.value)
    assert "start [300.0, 300.0]" in str(caught.value)


def test_with_shapes_there_are_more_ways_to_fail():
    for wrong, reason in (
        (([1.0, 2.0], np.ones((3, 2))), "shapes: must have 2 rows, one per sensor (got 3)"),
        (([1.0], np.ones((2, 1))), "must give at least the 2 measured modes (gave 1 modes)"),
        (([1.0, 2.0], np.full((2, 2), np.nan)), "shapes: must be finite"),
        ([1.0, 2.0], "shapes: must have 2 rows, one per sensor (got none)"),
    ):
        posed = problem(
            BlackBoxModel(lambda theta, wrong=wrong: wrong if theta[0] > 500.0 else everything(theta), 2)
        )
        assert posed.log_prob([550.0, 200.0]) == -np.inf
        assert posed.model.reasons[0].reason == reason


def test_of_a_batch_only_the_point_at_fault_fails():
    def function(theta):
        if np.any(theta[:, 0] > 500.0):
            raise ValueError("too stiff")
        return batched(theta)

    posed = problem(BlackBoxModel(function, 2, batched=True))
    points = np.array([[300.0, 200.0], [550.0, 200.0], [400.0, 200.0]])
    assert_array_equal(np.isfinite(posed.log_prob(points)), [True, False, True])
    assert [failure.reason for failure in posed.model.reasons] == ["ValueError: too stiff"]


def test_a_batch_of_the_wrong_shape():
    with pytest.raises(
        ValueError, match=r"frequencies: must have shape \(1, n\) \(got \(2,\)\) at|\(got \(2,\)\)"
    ):
        problem(BlackBoxModel(lambda theta: frequencies(theta[0]), 2, batched=True))


def test_differences_are_one_sided_where_one_side_fails():
    posed = problem(BlackBoxModel(fails_beyond(400.0, stop), 2))
    point = np.array([[400.0, 300.0]])
    assert_allclose(posed.model.frequencies_and_gradient(point)[1][0], solved(point[0])[2], rtol=1e-3, atol=1e-6)
    surrounded = problem(BlackBoxModel(lambda theta: stop(theta) if theta[0] != 300.0 else frequencies(theta), 2))
    slopes = surrounded.model.frequencies_and_gradient(START[None])[1][0]
    assert_array_equal(np.isnan(slopes), [[True, False], [True, False]])


def test_reasons_are_few():
    posed = problem(BlackBoxModel(fails_beyond(500.0, stop), 2))
    n = 3 * MOST_REASONS
    points = np.stack([np.linspace(510.0, 550.0, n), np.full(n, 200.0)], axis=1)
    posed.log_prob(points)
    assert len(posed.model.reasons) == MOST_REASONS
    assert_array_equal([failed.theta for failed in posed.failures], points)
    assert {failed.reason for failed in posed.failures} == {"RuntimeError: no convergence after 10 steps"}


def test_reasons_are_short():
    def logs(theta):
        raise RuntimeError("x" * 100_000)

    posed = problem(BlackBoxModel(fails_beyond(500.0, logs), 2))
    posed.log_prob([550.0, 200.0])
    assert len(posed.failures[0].reason) < 510


def test_an_interrupt_stops_everything():
    def interrupted(theta):
        raise KeyboardInterrupt

    posed = problem(BlackBoxModel(fails_beyond(500.0, interrupted), 2))
    with pytest.raises(KeyboardInterrupt):
        posed.log_prob([550.0, 200.0])


def test_theta_cannot_be_changed_from_within():
    def meddling(theta):
        result = frequencies(theta)
        theta[:] = 0.0
        return result

    point = START.copy()
    problem(BlackBoxModel(meddling, 2)).log_prob_and_grad(point)
    assert_array_equal(point, START)


@pytest.mark.parametrize(
    ("arguments", "settings", "words"),
    [
        (("modes", 2), {}, r"function: must be a function \(got \'modes\'\)"),
        ((frequencies, 0), {}, r"n_parameters: must be a whole number of at least 1 \(got 0\)"),
        ((frequencies, 2), {"step": 0.0}, r"step: must be a positive finite number of at most 0.1 \(got 0.0\)"),
    ],
)
def test_wrong_settings(arguments, settings, words):
    with pytest.raises(ValueError, match=words):
        BlackBoxModel(*arguments, **settings)


def test_what_does_not_fit_the_problem():
    with pytest.raises(ValueError, match=r"parameters: the model takes 3 \(got 2\)"):
        problem(BlackBoxModel(frequencies, 3))
    with pytest.raises(ValueError, match="pairing: must be one of"):
        problem(BlackBoxModel(frequencies, 2), pairing="ear")
    with pytest.raises(ValueError, match="numbers"):
        problem(BlackBoxModel(frequencies, 2), fmu.ModalData([1.0, 2.0, 3.0]))


def test_named_matrices_want_their_parameters_in_order():
    swapped = PARAMETERS[::-1]
    with pytest.raises(ValueError, match=r"parameters: must be the model's, in its order \('k1', 'k2'\)"):
        fmu.UpdatingProblem.reduced(SEPARABLE, DATA, swapped)


def test_configuration_and_words():
    model = BlackBoxModel(frequencies, 2)
    assert repr(model) == "BlackBoxModel(frequencies, 2 parameters)"
    described = problem(model).configuration()["model"]
    assert described["function"] == "frequencies"
    assert described["pairing"] == "index"
    assert len(described["sha256"]) == 64
    assert problem(BlackBoxModel(np.sqrt, 2)).configuration()["model"]["sha256"] == ""
    assert "by MAC" in repr(problem(BlackBoxModel(everything, 2)))


SAMPLERS = {
    "mh": ("mh", 20),
    "slice": ("slice", 20),
    "hmc": (fmu.HamiltonianMonteCarlo(step_size=0.05, n_steps=5), 0),
    "emcee": ("emcee", 20),
}


@pytest.mark.parametrize(
    "name", ["hmc", *(pytest.param(name, marks=pytest.mark.validate) for name in ("mh", "slice", "emcee"))]
)
def test_every_sampler_runs_on_it_as_on_matrices(matrices, name):
    """The same chain, step by step: the samplers see a log-density alone."""
    sampler, warmup = SAMPLERS[name]
    steps = {"draws": 8, "warmup": warmup, "chains": 2, "seed": 3}
    of_function = fmu.sample(problem(BlackBoxModel(everything, 2)), sampler, **steps)
    of_matrices = fmu.sample(matrices, sampler, **steps)
    for parameter in ("k1", "k2"):
        expected = of_matrices["posterior"][parameter].to_numpy()
        assert_allclose(of_function["posterior"][parameter].to_numpy(), expected, rtol=1e-6)


def test_maxima_identifiability_and_verdict(matrices):
    posed = problem(BlackBoxModel(frequencies, 2))
    maxima, expected = (fmu.find_map(p, starts=3, seed=1) for p in (posed, matrices))
    assert_allclose(maxima[0].theta, expected[0].theta, rtol=1e-4)
    found, exact = (fmu.identifiability(p).singular_values for p in (posed, matrices))
    assert_allclose(found, exact, rtol=1e-6)
    trace = fmu.sample(posed, "mh", draws=20, warmup=20, chains=2, seed=1, maxima=maxima)
    assert fmu.diagnose(trace).verdict


@pytest.mark.parametrize(
    "function", [everything, lambda theta: {"frequencies": solved(theta)[0], "shapes": solved(theta)[1]}]
)
def test_errors_of_shapes(theta, function):
    """Shapes have errors as those of a structure do; their slopes are differences."""
    errors = [fmu.FrequencyErrors(sd=0.02), fmu.ShapeErrors(sd=0.05)]
    of_function, of_matrices = (
        fmu.UpdatingProblem(model, DATA, PARAMETERS, error=errors)
        for model in (BlackBoxModel(function, 2), SEPARABLE)
    )
    value, gradient = of_function.log_prob_and_grad(theta)
    exact, slope = of_matrices.log_prob_and_grad(theta)
    assert_allclose(value, exact, rtol=1e-9)
    assert_allclose(gradient, slope, rtol=1e-4, atol=1e-5 * np.abs(slope).max())
    assert (of_function.solves_per_gradient, of_matrices.solves_per_gradient) == (5, 1)
    assert_array_equal(of_function.log_prob(theta), [of_function.log_prob(row) for row in theta])


def test_errors_of_shapes_need_shapes():
    with pytest.raises(ValueError, match=r"^error: errors of shapes need a model that gives shapes"):
        fmu.UpdatingProblem(BlackBoxModel(frequencies, 2), DATA, PARAMETERS, error=fmu.ShapeErrors(sd=0.05))


def test_modes_that_are_paired_by_number_need_numbers_of_their_own():
    """By MAC, the numbers are not used."""
    data = fmu.ModalData(DATA.frequencies_hz, numbers=(2, 2), sensors=DATA.sensors, shapes=DATA.shapes)
    assert problem(BlackBoxModel(everything, 2), data).model.by_shape
    for function, settings in ((frequencies, {}), (everything, {"pairing": "index"})):
        with pytest.raises(ValueError, match=r"^numbers: must be distinct, one per mode, .* \(got \(2, 2\)\)$"):
            problem(BlackBoxModel(function, 2), data, **settings)


def test_lists_are_points_too():
    model = BlackBoxModel(frequencies, 2)
    point = START.tolist()
    assert_array_equal(model.answers([point])[0].frequencies, frequencies(START))
    assert model.reason_at(point) is None
    assert model.seconds_at(point) >= 0.0
    assert_array_equal(model.solve(point).theta, START)


def test_parameters_of_a_model_have_different_names():
    with pytest.raises(ValueError, match=r"parameters: must be distinct \(got 'k' more than once\)"):
        fmu.SeparableModel.from_terms(["k", "m", "k"], [(np.eye(2), "k")], [np.eye(2)])


@pytest.mark.parametrize(("kind", "gradients"), [("modes", 1), ("embedded", 1 + 2 * 2)])
def test_the_gradients_that_a_discrepancy_takes_of_a_function_are_counted(kind, gradients):
    """Scatter takes second derivatives, by differences of two gradients for each of two modes."""
    calls = []
    model = BlackBoxModel(lambda theta: calls.append(theta) or everything(theta), 2)
    discrepancy = fmu.Discrepancy(kind, prior_sd=0.1)
    posed = fmu.UpdatingProblem(
        model, DATA, PARAMETERS, error=fmu.FrequencyErrors(sd=0.1), discrepancy=discrepancy
    )
    assert posed.solves_per_gradient == gradients
    calls.clear()
    posed.log_prob_and_grad(np.append(1.1 * START, np.full(posed.ndim - 2, 0.05)))
    assert len(calls) == gradients
