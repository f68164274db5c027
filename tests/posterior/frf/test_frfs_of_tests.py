"""Frequency response functions of several tests: the sum of what each test says, and the page."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import fmu
from fmu.analysis.frf.predictions import frf_groups
from fmu.posterior.joint.modal_test import TestsError
from fmu.report.plots import plot_frf
from tests.gradients import assert_gradient
from tests.measured_frfs import (
    LINES,
    NAMES,
    POINTS,
    RATIOS,
    TRUTH,
    building,
    modes,
    parameters,
    ratios,
    receptances,
    simulate,
)

BASE = POINTS[1]
CHANNELS = {"gain_sd": {BASE: 0.1}, "delay_sd": {BASE: 1e-3}}
MODEL_SD = fmu.Parameter("error of the model", 0.02, 0.0, 0.5, fmu.HalfNormal(0.05))


def in_tests(varies=None, others=(), laden=None, **options):
    """Return the joint problem of two tests, "old" with fewer lines and "new" with other noise."""
    damping = fmu.ModalDamping(ratios())
    error = [
        fmu.FRFErrors(simulate(band=(2.0, 14.0)), damping, test="old", **options),
        fmu.FRFErrors(simulate(seed=1, noise=0.05), damping, test="new", **options),
    ]
    changes = {} if laden is None else {"masses": laden}
    tests = [fmu.Test("old", modes(), "sound"), fmu.Test("new", modes(), "later", **changes)]
    return fmu.JointProblem(building(), tests, parameters(), varies=varies, error=[*error, *others])


def singles(**options):
    """Return the problems of the two tests, each by itself."""
    return [
        fmu.UpdatingProblem(
            building(), modes(), parameters(), error=fmu.FRFErrors(data, fmu.ModalDamping(ratios()), **options)
        )
        for data in (simulate(band=(2.0, 14.0)), simulate(seed=1, noise=0.05))
    ]


def points(problem, n=3, spread=0.1):
    theta = problem.sample_prior(np.random.default_rng(3), n)
    return problem.start + spread * (theta - problem.start)


def test_the_density_of_tests_with_shared_parameters_is_the_sum():
    both, one_by_one = in_tests(), singles()
    assert both.names == ("k1", "k2", "k3", "zeta1", "zeta2", "zeta3")
    theta = points(both)
    assert_allclose(both.log_likelihood(theta), sum(p.log_likelihood(theta) for p in one_by_one), rtol=1e-12)
    assert both.log_likelihood_terms(theta).shape == (3, 2)
    assert_array_equal(both.log_prob(theta), [both.log_prob(one) for one in theta])


def test_each_test_has_its_own_values_channels_and_added_masses():
    both = in_tests({"k1": "test", "zeta2": "test"}, **CHANNELS)
    delays = ("delay of old: 0 x", "delay of new: 0 x")
    own = ("k1 [old]", "k1 [new]", "k2", "k3", "zeta1", "zeta2 [old]", "zeta2 [new]", "zeta3")
    assert both.names == (*own, *delays)
    theta = points(both)
    parts = [[0, 2, 3, 4, 5, 7, 8], [1, 2, 3, 4, 6, 7, 9]]
    expected = sum(p.log_likelihood(theta[:, own]) for p, own in zip(singles(**CHANNELS), parts, strict=True))
    assert_allclose(both.log_likelihood(theta), expected, rtol=1e-12)
    for (term, found), single, own in zip(both.responses_at(theta), singles(**CHANNELS), parts, strict=True):
        assert_array_equal(found, theta[:, own])
        assert_allclose(term.frfs(found), single.frfs(theta[:, own])[0], rtol=1e-12)


def test_an_added_mass_is_in_its_test_alone():
    plain, laden = in_tests(), in_tests(laden={1: 150.0})
    theta = np.r_[TRUTH, RATIOS]
    (old, new), (same, moved) = plain.frfs(theta), laden.frfs(theta)
    assert_array_equal(old, same)
    assert np.max(np.abs(moved - new)) > 0.1 * np.max(np.abs(new))


VARIES = {
    "shared": {},
    "by test": {"k1": "test", "zeta1": "group"},
    "damage": {"k2": fmu.Damage(), "zeta3": "test"},
}


@pytest.mark.parametrize("varies", VARIES.values(), ids=VARIES)
def test_gradients_are_exact(varies):
    problem = in_tests(varies, [fmu.FrequencyErrors(sd=0.1)], {1: 150.0}, model_sd=MODEL_SD, **CHANNELS)
    theta = points(problem)
    value, gradient = problem.log_prob_and_grad(theta)
    assert_allclose(value, problem.log_prob(theta), rtol=1e-12)
    assert_gradient(gradient, problem.log_prob, theta, 1e-6 * problem.scale, rtol=1e-5, of_largest=1e-6)
    scaled = np.abs(gradient * problem.scale).max()
    value, slope, information = problem.quadratic(theta)
    assert_allclose(value, problem.log_likelihood(theta), rtol=1e-12)
    assert_allclose(slope + problem.prior.log_pdf_gradient(theta), gradient, rtol=1e-9, atol=1e-9 * scaled)
    assert np.all(np.linalg.eigvalsh(information[:, :, :]) > 0.0)


def test_the_information_of_two_tests_is_the_sum():
    theta = np.r_[TRUTH, RATIOS][None]
    expected = sum(p.quadratic(theta)[2] for p in singles())
    assert_allclose(in_tests().quadratic(theta)[2], expected, rtol=1e-12)
    J = in_tests().sensitivity(theta)[0]
    # the damping of several tests is in the layout, so nothing is left to be profiled
    assert_allclose(J.T @ J, expected[0], rtol=1e-9, atol=1e-9 * np.abs(expected).max())


def test_what_contradicts_is_refused():
    damping, tests = fmu.ModalDamping(ratios()), [fmu.Test("a", modes()), fmu.Test("b", modes())]

    def joint(*named, **options):
        error = [fmu.FRFErrors(simulate(), damping, test=name) for name in named]
        return fmu.JointProblem(building(), tests, parameters(), error=error, **options)

    with pytest.raises(TestsError, match=r"error\.1\.test: must be the test in which .* a, b \(got none\)"):
        joint("a", None)
    with pytest.raises(TestsError, match=r"error\.1\.test: must not be that of another FRFErrors; .* \(got 'a'\)"):
        joint("a", "a")
    with pytest.raises(TestsError, match="error: frequency response functions must be given for every test"):
        joint("a")
    known = fmu.Discrepancy("modes", sd=0.02, correlation=0.0)
    with pytest.raises(ValueError, match=r"discrepancy: is for frequency response functions of a single test"):
        joint("a", "b", discrepancy=known)
    with pytest.raises(ValueError, match="test: must not be given where there is one test only"):
        fmu.UpdatingProblem(building(), modes(), parameters(), error=fmu.FRFErrors(simulate(), damping, test="a"))


def test_a_parameter_that_is_not_updated_keeps_its_value():
    own = fmu.FRFErrors(simulate(), fmu.ModalDamping(ratios()))
    given = [fmu.Parameter("k1", TRUTH[0], 0.6, 1.6, updated=False), *parameters()[1:]]
    fewer = fmu.UpdatingProblem(building(), modes(), given, error=own)
    every = fmu.UpdatingProblem(building(), modes(), parameters(), error=own)
    theta = np.r_[TRUTH, RATIOS]
    assert fewer.names == every.names[1:]
    assert_allclose(fewer.log_likelihood(theta[1:]), every.log_likelihood(theta), rtol=1e-12)
    assert_allclose(fewer.log_prob_and_grad(theta[1:])[1], every.log_prob_and_grad(theta)[1][1:], rtol=1e-9)
    assert_allclose(fewer.quadratic(theta[None, 1:])[2], every.quadratic(theta[None])[2][:, 1:, 1:], rtol=1e-9)


def test_a_weighed_mass_beside_frfs_counts():
    theta = np.r_[TRUTH, RATIOS]
    own = fmu.FRFErrors(simulate(), fmu.ModalDamping(ratios()))
    weights = [fmu.MassErrors(mass=3000.0 + off, sd=10.0) for off in (0.0, 20.0)]
    alone, right, wrong = (
        fmu.UpdatingProblem(building(), modes(), parameters(), error=[own, *others])
        for others in ([], weights[:1], weights[1:])
    )
    assert_allclose(right.log_likelihood(theta) - wrong.log_likelihood(theta), 2.0, rtol=1e-9)
    assert right.log_likelihood_terms(theta).shape == (2,)
    assert_allclose(right.quadratic(theta[None])[1], alone.quadratic(theta[None])[1], rtol=1e-9)


def _measured(theta, seed, noise=0.03, **options):
    """Return simulated FRFs of moduli, and their frequencies as modes."""
    rng, w = np.random.default_rng(seed), 2 * np.pi * LINES
    H = receptances(theta) * (1j * w) ** 2
    sd = noise * np.abs(H)
    values = H + sd * (rng.standard_normal(H.shape) + 1j * rng.standard_normal(H.shape))
    data = fmu.FRFData(LINES, values, ((2, "x"),) * 2, POINTS, "accelerance", sd, **options)
    return data, fmu.pick_modes(data, (1, 2, 3))


@pytest.fixture(scope="module")
def damaged():
    """Return the problem and the trace of a sound and a damaged test; the second storey lost 8 %."""
    (sound, its_modes), (later, other_modes) = (
        _measured(TRUTH, 0, use=(LINES < 5.0) | (LINES > 6.0)),
        _measured(TRUTH * [1.0, 0.92, 1.0], 1, band=(2.0, 14.0)),
    )
    damping = fmu.ModalDamping(ratios())
    error = [
        fmu.FRFErrors(sound, damping, test="may"),
        fmu.FRFErrors(later, damping, test="june", gain_sd={BASE: 0.1}, delay_sd={BASE: 1e-3}),
    ]
    tests = [fmu.Test("may", its_modes, "sound"), fmu.Test("june", other_modes, "damaged")]
    varies = {name: fmu.Damage() for name in NAMES}
    problem = fmu.JointProblem(building(), tests, parameters(), varies=varies, error=error)
    maxima = fmu.find_map(problem, starts=4)
    return problem, fmu.sample(problem, "mixture", draws=200, warmup=60, seed=1, maxima=maxima)


def test_a_loss_is_found_and_the_others_are_quiet(damaged):
    _, trace = damaged
    losses = [trace["posterior"][f"{name} loss [damaged]"].to_numpy().ravel() for name in NAMES]
    for found, truth in zip(losses, (0.0, 0.08, 0.0), strict=True):
        assert found.std() < 0.003
        assert abs(found.mean() - truth) < 4 * found.std()
    assert np.mean(losses[1] > 0.07) > 0.999
    diagnosis = fmu.diagnose(trace)
    assert diagnosis.converged
    assert "not contradicted" in str(diagnosis)


def test_the_trace_has_the_frfs_of_both_tests(damaged):
    problem, trace = damaged
    group = trace["frfs"].to_dataset()
    assert list(group["frf"].to_numpy()) == [
        f"{test}: {point} x / 2 x" for test in ("may", "june") for point in (2, 0)
    ]
    held = group["held_freedom"].to_numpy()
    assert held[0] == held[1] > 0 == held[2] == held[3]
    measured = group["measured"].sel(frf="june: 0 x / 2 x").to_numpy()
    inside = (LINES >= 2.0) & (LINES <= 14.0)
    assert_array_equal(np.isfinite(group["distance"].sel(frf="june: 0 x / 2 x")), inside)
    assert_array_equal(measured[:, 0], np.asarray(problem.likelihood.responses[1].data.values)[1].real)
    assert list(group["channel"].to_numpy())[-1] == "june: 0 x"
    gain = float(group["gain"][-1])
    assert 0.0 < abs(gain) < 5 * float(group["gain_sd"][-1])
    assert trace["log_likelihood"]["frfs"].shape[-1] == 2
    assert len(plot_frf(trace, "june: 0 x / 2 x")) == 3


def test_the_check_says_of_which_test_the_frfs_are(damaged):
    problem, _ = damaged
    found = fmu.check(problem, draws=50)
    assert found.parameters["changes"]["zeta2"] == "damping"
    assert found.parameters["changes"]["delay of june: 0 x"] == "channel"
    assert list(found.frfs.table().index)[2] == "june: 2 x / 2 x"
    said = " ".join(str(found).split())
    assert "june: Frequency response functions: 2 accelerances from 1 to 16 Hz, 192" in said
    assert said.count("The modes are no data") == 1
    assert "independent from line to line, from FRF to FRF and" in said


def test_lines_of_different_spectra_stand_side_by_side():
    error, tests = [], []
    for name, lines in (("a", LINES), ("b", np.linspace(2.0, 14.0, 50))):
        H = receptances(lines=lines) * (2j * np.pi * lines)
        data = fmu.FRFData(lines, H, ((2, "x"),) * 2, POINTS, "mobility", 0.05 * np.abs(H))
        error.append(fmu.FRFErrors(data, fmu.ModalDamping(ratios()), test=name))
        tests.append(fmu.Test(name, modes()))
    problem = fmu.JointProblem(building(), tests, parameters(), error=error)
    theta = np.tile(np.r_[TRUTH, RATIOS], (2, 3, 1))
    group = frf_groups(problem, theta, np.random.default_rng(0))["frfs"]
    assert group.sizes["line"] == len(np.union1d(LINES, np.linspace(2.0, 14.0, 50)))
    assert_array_equal(group["in_spectrum"].sum("line"), [120, 120, 50, 50])
    assert_array_equal(group["freedom"], [240, 240, 100, 100])
    assert set(group["response"].to_numpy()) == {"mobility"}


def test_moduli_that_scatter_over_the_tests_are_a_population():
    """Of four tests; the posterior of each test's value is that of the test alone, as the FRFs are accurate."""
    own = 1.1 + 0.05 * np.array([-1.2, 0.3, 1.1, -0.4])
    damping, error, tests = fmu.ModalDamping(ratios()), [], []
    for i, value in enumerate(own):
        data, its_modes = _measured(np.r_[value, TRUTH[1:]], i)
        error.append(fmu.FRFErrors(data, damping, test=f"t{i}"))
        tests.append(fmu.Test(f"t{i}", its_modes))
    varies = {"k1": fmu.Population(), "k2": "test"}
    problem = fmu.JointProblem(building(), tests, parameters(), varies=varies, error=error)
    trace = fmu.sample(problem, draws=40, warmup=20, seed=1)
    assert fmu.diagnose(trace).fit.against == ()
    found = trace["tests"]["k1"].to_numpy().reshape(-1, 4)
    assert np.all(np.abs(found.mean(axis=0) - own) < 4 * found.std(axis=0))
    assert np.all(found.std(axis=0) < 0.003)
    mean = trace["posterior"]["k1 mean"].to_numpy()
    assert abs(mean.mean() - own.mean()) < 2 * mean.std()
    errors = [fmu.FRFErrors(one.data, damping, test=one.test, delay_sd=1e-3) for one in error]
    with pytest.raises(TestsError, match="must have known errors beside a population"):
        fmu.JointProblem(building(), tests, parameters(), varies=varies, error=errors)
