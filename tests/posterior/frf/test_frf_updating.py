"""Updating from frequency response functions, from the search to the verdict."""

import re

import numpy as np
import pytest
import scipy.linalg

import fmu
from fmu.fem.frf.proportional import Source
from fmu.posterior.frf.damping import bind_damping
from tests.measured_frfs import (
    LINES,
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
from tests.shear_building import frequencies_hz, shear_building

TIP, BASE = POINTS


def update(data, draws=60, **options):
    own = fmu.FRFErrors(data, fmu.ModalDamping(ratios()), **options)
    problem = fmu.UpdatingProblem(building(), modes(), parameters(), error=own)
    maxima = fmu.find_map(problem, starts=4)
    return problem, fmu.sample(problem, "mixture", draws=draws, warmup=60, seed=1, maxima=maxima)


def scores(trace):
    """Return (mean − truth)/sd of each parameter."""
    names = ["k1", "k2", "k3", "zeta1", "zeta2", "zeta3"]
    draws = np.array([trace["posterior"][name].to_numpy().ravel() for name in names])
    return (draws.mean(axis=1) - np.r_[TRUTH, RATIOS]) / draws.std(axis=1)


@pytest.fixture(scope="module")
def plain():
    return update(simulate(), draws=200)


def test_moduli_and_damping_are_found_with_their_uncertainty(plain):
    problem, trace = plain
    assert np.all(np.abs(scores(trace)) < 4.0)
    summary = fmu.summary(trace)
    assert np.all(summary["sd"].to_numpy()[:3] < 0.01)  # the frequencies alone give 0.02
    diagnosis = fmu.diagnose(trace)
    assert diagnosis.converged
    assert "the model: not contradicted" in str(diagnosis)
    assert problem.data.use == (False,) * 3


def test_the_modes_of_such_a_problem_serve_another(plain):
    problem, _ = plain
    own = fmu.FRFErrors(simulate(), fmu.ModalDamping(ratios()))
    again = fmu.UpdatingProblem(building(), problem.data, parameters(), error=own)
    assert again.log_prob(np.r_[TRUTH, RATIOS]) == problem.log_prob(np.r_[TRUTH, RATIOS])


def test_the_trace_has_predicted_and_measured_frfs(plain):
    problem, trace = plain
    group = trace["frfs"].to_dataset()
    measured = np.asarray(simulate().values)
    assert np.allclose(group["measured"].to_numpy()[..., 0], measured.real, rtol=1e-12, atol=0)
    low, _, high = group["amplitude"].sel(kind="measurement").to_numpy()
    inside = np.mean((np.abs(measured) >= low) & (np.abs(measured) <= high))
    assert 0.84 < inside < 0.96  # 90 % of 240 lines
    assert np.all(group["frac"] > 0.99)
    assert trace["log_likelihood"]["frfs"].shape == trace["posterior"]["k1"].shape
    (found,) = problem.frfs(np.r_[TRUTH, RATIOS])
    assert found.shape == measured.shape


@pytest.fixture(scope="module")
def wrong_gain():
    return simulate(distort=lambda H, w: H * np.array([[1.0], [1.4]]))


def test_a_wrong_gain_is_found_and_the_moduli_are_right(wrong_gain):
    _, trace = update(wrong_gain, gain_sd={BASE: 0.5})
    assert np.all(np.abs(scores(trace)) < 4.0)
    group = trace["frfs"].to_dataset().sel(channel="0 x")
    assert abs(float(group["gain"]) - 0.4) < 5 * float(group["gain_sd"]) + 0.02
    assert "not contradicted" in str(fmu.diagnose(trace))


def test_a_wrong_gain_that_is_left_out_contradicts_the_model(wrong_gain):
    said = str(fmu.diagnose(update(wrong_gain)[1]))
    assert "contradicted by" in said
    assert "FRF 0 x / 2 x" in said
    gain = re.search(r"a gain of (\S+) would explain it: infer it by gain_sd", said)
    assert 1.3 < float(gain[1]) < 1.5


def test_a_reversed_sensor_is_named():
    against = fmu.diagnose(update(simulate(distort=lambda H, w: H * np.array([[1.0], [-1.0]])))[1]).fit.against
    (said,) = [sentence for sentence in against if sentence.startswith("FRF 0 x / 2 x")]
    assert "reversed polarity" in said


def test_a_wrong_model_is_not_blamed_on_a_channel():
    """FRFs that no stiffness gives: no gain and no delay makes up for that."""
    heavy = simulate(distort=lambda H, w: H / (1.0 + 0.3 * np.sin(w / 12.0)))
    against = fmu.diagnose(update(heavy)[1]).fit.against
    assert against
    assert not any("would explain" in sentence for sentence in against)


def test_a_delay_is_found_and_left_out_contradicts_the_model():
    delayed = simulate(distort=lambda H, w: H * np.exp(-1j * w * np.array([[0.0], [4e-3]])))
    _, trace = update(delayed, delay_sd={BASE: 5e-3})
    assert np.all(np.abs(scores(trace)) < 4.0)
    delay = trace["posterior"]["delay of 0 x"].to_numpy()
    assert abs(delay.mean() - 4e-3) < 4 * delay.std()
    said = str(fmu.diagnose(update(delayed)[1]))
    assert "contradicted by" in said
    found = re.search(r"a delay of (\S+) ms would explain it: infer it by delay_sd", said)
    assert 3.0 < float(found[1]) < 5.0


def test_the_search_finds_the_maximum_from_a_start_far_away():
    start = [fmu.Parameter(name, 0.7, 0.6, 1.6) for name in ("k1", "k2", "k3")]
    own = fmu.FRFErrors(simulate(noise=0.01), fmu.ModalDamping(ratios()))
    problem = fmu.UpdatingProblem(building(), modes(), start, error=own)
    best = fmu.find_map(problem).maxima[0]
    assert np.allclose(best.theta[:3], TRUTH, rtol=5e-3)
    assert best.log_prob > problem.log_prob(np.r_[TRUTH, RATIOS])


def test_two_maxima_are_found_where_a_gain_is_free():
    """Two storeys have the same frequencies at two pairs of stiffnesses; one FRF of unknown gain tells no more."""
    model = shear_building(("k1", "k2"), 2e6, 1000.0, dofs=[(0, "x"), (1, "x")])
    pairs = np.array([[1.2, 0.8], [1.6, 0.6]])
    f = frequencies_hz(model, pairs[0])[0]
    assert np.allclose(f, frequencies_hz(model, pairs[1])[0])
    lam, phi = scipy.linalg.eigh(model.K(pairs[0]).toarray(), model.M(pairs[0]).toarray())
    lines = np.linspace(2.0, 16.0, 60)
    w = 2 * np.pi * lines
    H = (phi[0] * phi[1])[None] @ (1 / (lam[:, None] - w**2 + 0.04j * np.sqrt(lam)[:, None] * w))
    rng, sd = np.random.default_rng(0), 0.05 * np.abs(H)
    values = H + sd * (rng.standard_normal(H.shape) + 1j * rng.standard_normal(H.shape))
    data = fmu.FRFData(lines, values, ((1, "x"),), ((0, "x"),), "receptance", sd)
    stiffness = [fmu.Parameter(name, 1.0, 0.4, 2.4) for name in ("k1", "k2")]
    measured = fmu.ModalData(f * [1.003, 0.998], sd_hz=0.01 * f, numbers=(1, 2))

    def search(**options):
        own = fmu.FRFErrors(data, fmu.ModalDamping(0.02), **options)
        return fmu.find_map(fmu.UpdatingProblem(model, measured, stiffness, pairing="index", error=own))

    found = search(gain_sd=1.0)
    assert np.allclose(sorted(one.theta[0] for one in found.maxima), pairs[:, 0], rtol=0.03)
    assert min(one.share for one in found.maxima) > 0.2
    known = search()
    assert np.allclose(known.maxima[0].theta, pairs[0], rtol=0.03)
    assert sum(one.share for one in known.maxima[1:]) < 1e-6


def test_frfs_and_modes_are_added_up():
    own = fmu.FRFErrors(simulate(), fmu.ModalDamping(ratios()))
    both = fmu.UpdatingProblem(building(), modes(), parameters(), error=[own, fmu.FrequencyErrors(sd=0.01)])
    alone = fmu.UpdatingProblem(building(), modes(), parameters(), error=own)
    of_modes = fmu.UpdatingProblem(building(), modes(), parameters(), error=fmu.FrequencyErrors(sd=0.01))
    theta = np.r_[TRUTH, RATIOS]
    together = alone.log_likelihood(theta) + of_modes.log_likelihood(theta[:3])
    assert np.isclose(both.log_likelihood(theta), together, rtol=1e-12)


def replaced(**options):
    return {"data": simulate(), "damping": fmu.ModalDamping(0.01)} | options


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"gain_sd": {(7, "x"): 0.1}}, "gain_sd: must name response channels among 2 x, 0 x"),
        ({"force_gain_sd": {(0, "x"): 0.1}}, "force_gain_sd: must name forces among 2 x"),
        ({"delay_sd": {(0, "y"): 0.1}}, "delay_sd: must name response channels"),
        ({"damping": []}, "damping: must have one damping model at least"),
        ({"damping": [fmu.ModalDamping(0.01), fmu.Dashpot((0, "x"), 5.0)]}, "modal ratios cannot be combined"),
        ({"damping": [fmu.ModalDamping(0.01)] * 2}, "must have one ModalDamping at most"),
        (
            {"damping": [fmu.ModalDamping(0.01), fmu.RayleighDamping(1.0), fmu.RayleighDamping(2.0)]},
            r"must have one RayleighDamping at most \(got 2\)",
        ),
        ({"damping": fmu.StructuralDamping(of={"k9": 0.1})}, "damping.of: must name parameters among k1, k2, k3"),
        ({"damping": fmu.DampingMatrix(np.eye(2))}, r"damping.matrix: must be of 3 rows"),
        ({"damping": fmu.ModalDamping(fmu.Parameter("z", 0.0, -1.0, 1.0))}, "damping.z.lower: must be at least 0"),
        ({"data": simulate(sd=None)}, "data: must have standard deviations; give sd or coherence"),
        ({"test": "a"}, "test: must not be given"),
    ],
)
def test_wrong_settings_say_what_is_wrong(options, message):
    with pytest.raises(ValueError, match=message):
        fmu.UpdatingProblem(building(), modes(), parameters(), error=fmu.FRFErrors(**replaced(**options)))


def test_stiffness_that_two_parameters_scale_has_one_loss_factor():
    model = fmu.SeparableModel([fmu.Term([[5.0]], (1, 1)), fmu.Term([[3.0]], (1, 0))], [fmu.Term([[2.0]], (0, 0))])

    def bound(**factors):
        return bind_damping(fmu.StructuralDamping(0.01, factors), model, ["E", "I"], {})

    with pytest.raises(ValueError, match=r"damping.of: must give .* one loss factor.* \(got those of E and I\)"):
        bound(I=0.03, E=0.02)
    assert bound(E=0.02, I=0.02).losses == {0: Source(0.02), 1: Source(0.02)}
    assert bound(I=0.03).losses == {1: Source(0.03)}


def test_modal_damping_must_have_a_ratio():
    with pytest.raises(ValueError, match=r"ratios: must have one damping ratio at least \(got none\)"):
        fmu.ModalDamping([])


def test_a_damping_matrix_must_be_symmetric_and_square():
    with pytest.raises(ValueError, match=r"matrix: must be symmetric and finite \(got asymmetry 2\)"):
        fmu.DampingMatrix([[1, 2], [0, 1]])
    with pytest.raises(ValueError, match="matrix: must be"):
        fmu.DampingMatrix([[1, 2]])


def test_a_drive_that_is_no_free_degree_of_freedom_is_named():
    data = fmu.FRFData(LINES, np.ones((1, len(LINES))) + 1j, ((9, "x"),), (POINTS[0],), "receptance", 0.1)
    with pytest.raises(ValueError, match=r"data.drives.0: must be a place .* free to move \(got 9 x\)"):
        fmu.UpdatingProblem(building(), modes(), parameters(), error=fmu.FRFErrors(**replaced(data=data)))


@pytest.mark.parametrize(
    ("responses", "drives", "lines"),
    [
        ((TIP,), (TIP,), LINES[40:41]),
        ((TIP,), (TIP,), LINES),
        ((TIP, BASE, TIP, BASE), (TIP, TIP, BASE, BASE), LINES[::4]),
    ],
    ids=["one line", "SISO", "MIMO"],
)
def test_one_line_one_frf_and_a_matrix_of_frfs(responses, drives, lines):
    rng = np.random.default_rng(2)
    H = np.concatenate(
        [receptances(lines=lines, points=(r,), drive=d) for r, d in zip(responses, drives, strict=True)]
    )
    sd = 0.03 * np.abs(H)
    values = H + sd * (rng.standard_normal(H.shape) + 1j * rng.standard_normal(H.shape))
    data = fmu.FRFData(lines, values, drives, responses, "receptance", sd)
    own = fmu.FRFErrors(data, fmu.ModalDamping(ratios()))
    problem = fmu.UpdatingProblem(building(), modes(), parameters(), error=own)
    theta = np.r_[TRUTH, RATIOS]
    expected = np.sum(-0.5 * np.abs((values - H) / sd) ** 2 - np.log(2 * np.pi * sd**2))
    assert np.isclose(problem.log_likelihood(theta), expected, rtol=1e-9)
    best = fmu.find_map(problem, starts=8).maxima[0]
    assert best.log_prob >= problem.log_prob(theta)


def test_lines_without_values_take_no_part():
    data = simulate()
    holes = np.array(data.values)
    holes[0, 10:20], holes[1, 5] = np.nan, 0.0
    some = fmu.FRFData(LINES, holes, data.drives, data.responses, data.kind, sd=np.asarray(data.sd))
    own = fmu.FRFErrors(some, fmu.ModalDamping(ratios()))
    problem = fmu.UpdatingProblem(building(), modes(), parameters(), error=own)
    assert problem.likelihood.responses[0].n_data == 2 * (2 * len(LINES) - 11)
    assert np.isfinite(problem.log_prob(np.r_[TRUTH, RATIOS]))


def test_a_function_and_two_sets_of_frfs_are_refused():
    own = fmu.FRFErrors(**replaced())
    black_box = fmu.BlackBoxModel(lambda theta: np.array([1.0, 2.0, 3.0]), 3)
    with pytest.raises(ValueError, match="need a SeparableModel"):
        fmu.UpdatingProblem(black_box, fmu.ModalData([1.0, 2.0, 3.0]), parameters(), error=own)
    with pytest.raises(ValueError, match="one FRFErrors at most"):
        fmu.UpdatingProblem(building(), modes(), parameters(), error=[own, own])
