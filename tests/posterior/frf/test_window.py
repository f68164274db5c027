"""FRFs of random tests with a window: the model's are smoothed as the measured ones."""

import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import scipy.signal
from numpy.testing import assert_allclose

import fmu
from fmu.analysis.trace.provenance import canonical_json
from fmu.posterior.assumptions import assumptions
from fmu.posterior.data.frf import estimates
from fmu.posterior.frf import errors
from fmu.posterior.frf.window import Window
from fmu.posterior.reduction.train_reduced import ReductionWarning
from tests.gradients import assert_gradient, differences
from tests.measured_frfs import LINES, RATIOS, TRUTH, building, modes, parameters, problem, ratios, simulate

THETA = np.r_[TRUTH * [1.01, 0.99, 1.02], RATIOS * 1.1]
WIDTH, ZETA, OMEGA = 1.5, 0.02, 2 * np.pi * 20.0  # s, and an oscillator of 1 kg


class Oscillator:
    def frfs(self, omega):
        return (1.0 / (OMEGA**2 - omega**2 + 2j * ZETA * OMEGA * omega))[None, None]


@pytest.mark.parametrize("name", ["hann", "blackman"])
def test_receptances_are_those_of_the_impulse_response_times_the_windows_autocorrelation(name):
    """The segment lasts 3.8 decay times."""
    n = 2**14
    t = WIDTH * (np.arange(n) + 0.5) / n
    w = scipy.signal.get_window(name, n)
    autocorrelation = scipy.signal.fftconvolve(w, w[::-1])[n - 1 :] / (w @ w)
    damped = OMEGA * np.sqrt(1.0 - ZETA**2)
    impulse = (
        np.exp(-ZETA * OMEGA * t)
        * np.sin(damped * t)
        / damped
        * np.interp(t, np.arange(n) * WIDTH / n, autocorrelation)
    )
    lines = 2 * np.pi * np.arange(5, 80, 2) / WIDTH
    expected = np.exp(-1j * np.outer(lines, t)) @ impulse * WIDTH / n
    found = Window(lines, 0, (name, WIDTH)).frfs(Oscillator(), slice(None))[0, 0]
    plain = Oscillator().frfs(lines)[0, 0]
    assert_allclose(found, expected, rtol=0, atol=2e-4 * np.abs(expected).max())
    assert np.abs(plain - expected).max() > 0.1 * np.abs(expected).max()


def test_accelerances_are_smoothed_in_their_own_unit():
    lines = 2 * np.pi * np.array([9.03, 20.1, 20.4])
    of = Window(lines, 2, ("boxcar", WIDTH))
    weights = of.weights.toarray()
    assert_allclose((weights / (of.omega / lines[:, None]) ** 2).sum(axis=1), 1.0, rtol=1e-12)
    blocks = [of.frfs(Oscillator(), slice(i, i + 1)) for i in range(3)]
    assert_allclose(np.concatenate(blocks, axis=2), of.frfs(Oscillator(), slice(None)), rtol=1e-12)


def smoothed(damping=None, scale="linear", discrepancy=(), **options):
    """Return the problem of FRFs with segments of 12 s, some of whose lines are used."""
    data = simulate(window=("hann", 12.0), use=(LINES < 7.0) | (LINES > 9.0))
    error = fmu.FRFErrors(data, damping or fmu.ModalDamping(ratios()), scale, **options)
    return fmu.UpdatingProblem(building(), modes(), parameters(), error=error, discrepancy=discrepancy)


@pytest.mark.parametrize(
    "case",
    [
        {},
        {"scale": "log", "delay_sd": 1e-4},
        {"damping": [fmu.RayleighDamping(0.1, 1e-4), fmu.Dashpot((2, "x"), fmu.Parameter("c", 500.0, 0.0, 5e3))]},
        {"discrepancy": fmu.Discrepancy("modes", sd=0.02, correlation=0.0)},
    ],
    ids=["modal", "log", "dashpot", "discrepancy"],
)
def test_gradient_and_information_of_smoothed_frfs(case):
    p = smoothed(**case)
    theta = np.array([one.start for one in p.parameters]) * 1.01
    theta[:3] = THETA[:3]
    step = 1e-5 * np.where(theta == 0.0, 1e-4, theta)
    assert_gradient(p.log_prob_and_grad(theta)[1], p.log_prob, theta, step, order=4, of_largest=1e-5)
    (term,) = p.likelihood.responses
    if case:
        return
    J = (
        differences(term.frfs, theta[None], step, order=4)[0]
        / np.asarray(term.data.sd)[:, term.data.used[0], None]
    )
    expected = np.einsum("flp,flq->pq", J.conj(), J).real
    assert_allclose(term.information(theta[None])[0], expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max())


def test_smoothing_is_among_the_assumptions():
    sentence = "The model's FRFs are smoothed by the hann window of segments of 12 s."
    for p, is_said in ((smoothed(), True), (problem(), False)):
        said = assumptions(json.loads(canonical_json(p.configuration())), None).sentences
        assert (sentence in said) == is_said


def test_errors_of_smoothed_frfs_are_bounded():
    """Of random errors, and of an error that is the same at all frequencies, which attains the bound."""
    lines = 2 * np.pi * np.arange(40, 50)
    of, u = Window(lines, 0, ("hann", 1.0)), np.random.default_rng(1).uniform(0.5, 2.0, (2, 10))
    for e in (np.ones((2, len(of.omega))), np.random.default_rng(2).standard_normal((2, len(of.omega)))):
        bound = np.sum((e / of.unit(u)) ** 2)
        assert np.sum((of.smooth(e) / u) ** 2) <= bound * (1.0 + 1e-12)
    u[1, 3] = np.inf
    assert_allclose(np.sum(of.unit(u) ** -2.0), np.sum(u**-2.0), rtol=1e-12)


def even(H, w):
    return 1.0


def records(n, n_records=1, noise=0.05, zeta=ZETA, shaper=even, seed=1, fs=256.0):
    """Return a random force (n_records, n), and the accelerations of an oscillator of 1 kg that goes on.

    Spectra of several records are computed together, in a tenth of the time of one record of the same length.
    """
    rng, w = np.random.default_rng(seed), 2 * np.pi * np.fft.rfftfreq(n * n_records, 1.0 / fs)
    H = -(w**2) / (OMEGA**2 - w**2 + 2j * zeta * OMEGA * w)
    force = np.fft.rfft(rng.standard_normal(n * n_records)) * shaper(H, w)
    response = np.fft.irfft(H * force) + noise * rng.standard_normal(n * n_records)
    return np.fft.irfft(force).reshape(n_records, n), response.reshape(n_records, 1, n)


POINT = {"sampling_hz": 256.0, "drives": (("top", "x"),), "responses": (("top", "x"),), "band": (5.0, 60.0)}


def zeta_away(data, zeta=ZETA, start=ZETA):
    """Return by how many standard deviations the damping ratio of the most probable oscillator is too high."""
    M = np.eye(1)
    model = fmu.SeparableModel.from_terms(["k"], [(OMEGA**2 * M, "k")], [M], dofs=[("top", "x")])
    damping, k = fmu.ModalDamping(fmu.Parameter("zeta", start, 1e-4, 0.2)), [fmu.Parameter("k", 1.0, 0.5, 1.5)]
    p = fmu.UpdatingProblem(model, fmu.ModalData([20.0]), k, error=fmu.FRFErrors(data, damping))
    (term,), theta = p.likelihood.responses, np.array([[1.0, zeta]])
    for _ in range(8):
        information = term.information(theta)[0]
        theta = theta + np.linalg.solve(information, term.terms_and_gradient(theta)[1][0])
    return (theta[0, 1] - zeta) * np.sqrt(1.0 / np.linalg.inv(information)[1, 1])


def test_damping_from_segments_of_five_decay_times():
    """The interval of a damping ratio of 2 % at 20 Hz: it was too high by more than three standard deviations."""
    force, response = records(50_000)
    data = fmu.FRFData.from_records(force[0], response[0], segment=512, **POINT)
    assert data.window == ("hann", 2.0)
    assert abs(zeta_away(data)) < 2.5
    assert zeta_away(replace(data, window=None)) > 3.0


def test_damping_from_records_of_a_continuous_force():
    """From 60 records of 10 decay times the damping ratio is too high by five standard deviations or more."""
    data = fmu.FRFData.from_records(*records(1024, 60), window="boxcar", **POINT)
    assert data.window is None
    (note,) = data.notes[:1]
    assert note.endswith('window=("boxcar", 4)).')
    assert zeta_away(data) > 5.0
    assert abs(zeta_away(replace(data, window=("boxcar", 4.0)))) < 2.5


def test_damping_from_segments_of_a_quarter_of_a_decay_time(monkeypatch):
    """With four frequencies per 1/T, the ratio is too high by 1.2 standard deviations."""
    zeta, tests = 0.005, []
    n = int(256.0 * 0.25 / (zeta * OMEGA))
    for seed in range(3):
        force, response = records(6000, 10, noise=0.02, zeta=zeta, seed=seed)
        tests.append(fmu.FRFData.from_records(force, response, segment=n, **POINT | {"band": (8.0, 50.0)}))
    away = [zeta_away(data, zeta, zeta) for data in tests]
    assert abs(np.mean(away)) < 5.0 / np.sqrt(3.0)
    monkeypatch.setattr(errors, "Window", partial(Window, per_line=32))
    assert_allclose(away, [zeta_away(data, zeta, zeta) for data in tests], rtol=0, atol=0.3)


def test_smoothing_is_exact_for_half_the_damping_of_the_start():
    data, m = simulate(window=("hann", 3.0)), []
    for ratio in (0.01, fmu.Parameter("z", 0.01, 0.0, 1.0), 0.005):
        error = fmu.FRFErrors(data, fmu.ModalDamping(ratio))
        (term,) = fmu.UpdatingProblem(building(), modes(), parameters(), error=error).likelihood.responses
        m.append(term.window.per_line)
        assert term.with_use(data.used).window.per_line == m[-1]
    assert 4 < m[0] < m[1] == m[2]


def test_impulse_responses_that_last_too_long_are_told():
    data = simulate(window=("hann", 12.0))
    with pytest.warns(ReductionWarning, match="cannot be smoothed exactly"):
        fmu.UpdatingProblem(
            building(),
            modes(),
            parameters(),
            error=fmu.FRFErrors(data, fmu.ModalDamping(fmu.Parameter("z", 1e-7, 0, 1))),
        )


def test_lines_of_a_file_with_six_digits_share_frequencies():
    lines = np.arange(15, 240) / 15.0
    rounded = np.array([float(f"{f:.6g}") for f in lines])
    exact = Window(2 * np.pi * lines, 2, ("hann", 15.0))
    for of in (Window(2 * np.pi * rounded, 2, ("hann", 15.0)), Window(2 * np.pi * lines, 2, ("hann", 15.0001))):
        assert len(of.omega) == len(exact.omega)
        found, expected = (one.frfs(Oscillator(), slice(None)) for one in (of, exact))
        assert_allclose(found, expected, rtol=0, atol=1e-3 * np.abs(expected).max())


def shaker(H, w):
    """Return the force of an exciter of 0.1 kg with a back-EMF of 25 N·s/m, over a white voltage."""
    mobility = np.divide(H, 1j * w, out=np.zeros(len(w), complex), where=w > 0.0)
    return 1.0 / (1.0 + (25.0 + 0.1j * w) * mobility)


def is_uneven(data):
    return any("the spectrum of the force changes" in note for note in data.notes)


@pytest.mark.parametrize("segment", [128, 512])
def test_a_force_that_drops_at_the_resonance_is_told(segment):
    """With segments of 1.3 decay times the damping is 3 standard deviations too high on average, of 5 not."""
    for of_force in (shaker, even):
        found = [records(10_000, 10, noise=0.02, shaper=of_force, seed=seed) for seed in range(5)]
        data = [fmu.FRFData.from_records(f, x, segment=segment, **POINT) for f, x in found]
        assert [is_uneven(one) for one in data] == [of_force is shaker] * 5
        if of_force is even or segment == 128:
            away = np.mean([zeta_away(one) for one in data])
            assert away > 5.0 / np.sqrt(5.0) if of_force is shaker else abs(away) < 5.0 / np.sqrt(5.0)


def test_every_place_where_the_force_changes_is_named():
    """Not only the largest change, as of the AC coupling of a sensor, which may be far from the resonances."""
    change = np.full(200, 0.01)
    change[[1, 2, 80, 82, 150]] = 3.0, 2.0, 1.1, 1.0, 1.2
    found = estimates.Estimate(
        np.arange(200) / 2.0, *[np.ones((1, 200))] * 2, 100.0, (), ("hann", 2.0), iter(()), change
    )
    (told,) = found.notes_on_force(np.ones(200, dtype=bool))
    assert told.startswith(
        "Near 0.5 Hz, 40 Hz and 75 Hz the spectrum of the force changes up to 20 times from one line"
    )
    (told,) = found.notes_on_force(np.ones(190, dtype=bool))  # without the ten lowest lines
    assert told.startswith("Near 40 Hz and 75 Hz the spectrum of the force changes up to 3.3 times from one line")
    assert found._replace(window=None).notes_on_force(np.ones(200, dtype=bool)) == []


@pytest.mark.parametrize(("window", "overlap"), [("boxcar", 0.0), ("boxcar", 0.5), ("hann", 0.5)])
def test_even_forces_are_told_at_most_as_often_as_the_probability_of_a_note(window, overlap, monkeypatch):
    """At 10 % at most five of 50 tests are expected; where all segments count as independent, 15 were told."""
    assert estimates._UNEVEN == 0.001
    monkeypatch.setattr(estimates, "_UNEVEN", 0.1)
    rng, told = np.random.default_rng(0), 0
    for _ in range(50):
        force, noise = rng.standard_normal((2, 2, 2500))
        settings = {"segment": 500, "overlap": overlap, "window": window}
        told += is_uneven(fmu.FRFData.from_records(force, (force + noise)[:, None], **settings, **POINT))
    assert told <= 8


def test_records_of_hits_bursts_and_periodic_forces_are_not_taken_as_continuous():
    rng, response = np.random.default_rng(0), np.random.default_rng(1).standard_normal((4, 1, 512))
    hits, bursts, noise = np.zeros((4, 512)), rng.standard_normal((4, 512)), 0.1 * rng.standard_normal((4, 512))
    hits[:, 20:25], bursts[:, 400:] = 1.0, 0.0
    for force, is_told in (
        (hits, 0),
        (bursts, 0),
        (np.tile(bursts[:, :256], 2)[:1] + noise, 0),
        (10.0 * noise, 1),
    ):
        data = fmu.FRFData.from_records(force + 0.01 * noise, response, window="boxcar", **POINT)
        assert any("up to the end of each record" in note for note in data.notes) == is_told


def test_h2_says_that_it_is_not_smoothed():
    force = np.random.default_rng(0).standard_normal(1000)
    point = ((1, "x"),)
    data = fmu.FRFData.from_records(force, force[None], 10.0, point, point, estimator="H2", segment=100)
    assert data.window is None
    assert any("With H2 the smoothing" in note for note in data.notes)
    other = simulate(window=("hann", 5.0))
    assert other.as_dict()["window"] == ["hann", 5.0]
    assert other.with_bands([(2.0, 8.0)]).window == ("hann", 5.0)
    with pytest.raises(ValueError, match="window: must be a window of scipy"):
        simulate(window=("round", 5.0))
