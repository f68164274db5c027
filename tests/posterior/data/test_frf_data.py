"""Measured FRFs: checks, units, uncertainty from coherence, hits and records, and resonances."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.signal
import scipy.stats

import fmu
from fmu.posterior.data.frf.estimates import independent_averages, independent_lines
from tests.oscillators import chain, measured, receptances

F = np.array([5.0, 10.0, 20.0])
H = np.array([[1 + 1j, 2.0, 3j], [1.0, 2 - 1j, 4.0]])
PAIRS = {"drives": ((1, "x"), (1, "x")), "responses": ((1, "x"), ("tip", "-z"))}
ROW, FULL = [(0, 0), (1, 0), (2, 0)], [(j, k) for j in range(3) for k in range(3)]


def made(**changes):
    return fmu.FRFData(**{"frequencies_hz": F, "values": H, **PAIRS, "kind": "mobility"} | changes)


def test_what_is_known_of_frfs():
    data = made(sd=0.1)
    assert (data.n_frfs, data.n_lines, data.power, data.notes) == (2, 3, 1, ())
    assert data.labels == ("1 x / 1 x", "tip -z / 1 x")
    assert data.used.all()
    assert data.standard_deviation.tolist() == [[0.1] * 3] * 2
    assert data.freedom == np.inf
    omega = 2.0 * np.pi * F
    values, sd = data.as_receptance()
    np.testing.assert_allclose(values * 1j * omega, H, rtol=1e-14)
    np.testing.assert_allclose(sd * omega, 0.1, rtol=1e-14)
    assert not data.values.flags.writeable


def test_identity_follows_the_numbers():
    one = made(sd=0.1).as_dict()
    assert one == made(sd=np.full((2, 3), 0.1)).as_dict()
    for other in (made(sd=0.2), made(sd=0.1, band=(4, 15)), made(sd=0.1, values=H * 1.5)):
        assert other.as_dict()["sha256"] != one["sha256"]


def test_lines_that_are_used():
    values = H.copy()
    values[0, 1], values[1, 2] = 0.0, np.nan
    data = made(values=values, band=(6.0, 30.0))
    assert data.used.tolist() == [[False, False, True], [False, True, False]]
    assert [note[:40] for note in data.notes] == [
        "The FRF 1 x / 1 x has no value (0 or NaN",
        "The FRF tip -z / 1 x has no value (0 or ",
    ]
    bands = [(4.0, 7.0), (9.0, 11.0)]
    assert data.with_bands(bands).used.tolist() == [[False] * 3, [False, True, False]]
    assert made().with_bands(bands).used.tolist() == [[True, True, False]] * 2
    assert data.without_lines(np.array([False, False, True])).used.tolist() == [[False] * 3, [False, True, False]]
    assert data.without_lines(data.used & (F > 15.0)).notes == data.notes
    at_zero = made(frequencies_hz=[0.0, 10.0, 20.0], sd=[[0.1], [0.2]], use=np.array([True, False, True]))
    assert (at_zero.n_lines, at_zero.used.tolist()) == (2, [[False, True]] * 2)
    assert at_zero.standard_deviation.tolist() == [[0.1, 0.1], [0.2, 0.2]]
    assert "0 Hz" in at_zero.notes[0]
    some = made(sd=[[0.0, 0.1, np.nan], [0.1] * 3])
    assert some.used.tolist() == [[False, True, False], [True] * 3]
    assert some.notes == ("2 of 6 values are not used: the sd of each is 0 or NaN.",)


def test_a_dynamic_stiffness_is_converted():
    data = made(kind="dynamic-stiffness", sd=0.1)
    assert data.kind == "receptance"
    np.testing.assert_allclose(data.values, 1.0 / H, rtol=1e-15)
    np.testing.assert_allclose(data.standard_deviation, 0.1 / np.abs(H) ** 2, rtol=1e-15)
    np.testing.assert_allclose(data.with_bands([(4.0, 15.0)]).values, 1.0 / H, rtol=1e-15)
    hits = H * (1.0 + 0.01 * np.arange(3)[:, None, None])
    mean = fmu.FRFData.from_hits(F, hits, **PAIRS, kind="dynamic-stiffness")
    np.testing.assert_allclose(mean.values, np.mean(1.0 / hits, axis=0), rtol=1e-14)
    for converted in (data, mean):
        assert any("converted to its reciprocal" in note for note in converted.notes)


def test_coherence_gives_the_standard_deviation():
    data = made(coherence=[[0.8, 1.0, 0.5], [0.0, 0.9, 0.9]], averages=10)
    np.testing.assert_allclose(
        data.standard_deviation[0], [np.sqrt(2 * 0.2 / (2 * 0.8 * 9)), 0.0, 3 / np.sqrt(18)]
    )
    assert data.used.tolist() == [[True, False, True], [False, True, True]]
    assert data.freedom == 18.0
    with pytest.raises(ValueError, match=r"sd: must be known .*; give coherence and averages"):
        _ = made().standard_deviation


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"frequencies_hz": [5.0, 20.0, 10.0]}, r"frequencies_hz.2: must ascend; .* \(got 10 Hz after 20 Hz\)"),
        ({"frequencies_hz": [5.0, np.nan, 10.0]}, r"frequencies_hz.1: must be finite and not negative"),
        ({"values": H.T}, r"values: must have shape \(n_frfs, 3\).*transpose them"),
        ({"values": H[0]}, r"values: .* put the values of one FRF in a list"),
        ({"values": "x"}, r"values: must be complex numbers"),
        ({"values": [H[0], [0, np.nan, 0]]}, r"values.1: .*delete the row of 'tip -z / 1 x' \(got 0 or NaN"),
        ({"drives": ((1, "x"),)}, r"drives: must be 2, one per FRF \(got 1\); repeat the point"),
        ({"drives": ((1, "x"), (1, "u"))}, r"drives.1.1: must be x, y, z, rx, ry or rz"),
        ({"responses": ((1, "x"), (1, "x"))}, r"responses: each pair .* \(got 1 x / 1 x\); average .*from_hits"),
        ({"kind": "inertance"}, r"kind: must be one of 'receptance', 'mobility'"),
        ({"sd": -1.0}, r"sd: must be positive and finite, or NaN \(got -1\)"),
        ({"sd": [1.0, 2.0]}, r"sd: must be a number or have shape \(2, 3\), FRFs x lines, or \(2, 1\)"),
        ({"sd": [[0.0, 1, 1], [np.nan] * 3], "band": (4, 6)}, r"sd: must give a standard deviation above 0"),
        ({"coherence": 95 * np.ones((2, 3)), "averages": 9}, r"coherence: .*; divide per cent by 100"),
        ({"coherence": np.ones((2, 3)), "averages": 9}, r"coherence: must give .* \(got 0, 1 or NaN\)"),
        ({"coherence": np.ones((2, 3))}, r"averages: must be given together with coherence"),
        ({"averages": 10}, r"coherence: must be given together with averages"),
        ({"averages": 1, "coherence": np.ones((2, 3))}, r"averages: must be .* above 1"),
        ({"use": [1, 0, 1]}, r"use: must be True or False"),
        ({"use": [True]}, r"use: must have shape \(3,\) or \(2, 3\)"),
        ({"use": [False] * 3}, r"use: must leave a line with a value"),
        ({"band": (50.0, 60.0)}, r"band: must leave a line .*; lines are 5 to 20 Hz"),
        ({"band": (50.0, 6.0)}, r"band: must have a lower frequency below its upper one"),
    ],
)
def test_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        made(**changes)


def test_one_line_and_many():
    one = fmu.FRFData([5.0], [[1j]], ((1, "x"),), ((1, "x"),), sd=0.1)
    assert (one.n_lines, len(one.pick_frequencies().frequencies_hz), one.doubts()) == (1, 0, ())
    many = measured(FULL, f=np.linspace(0.01, 60.0, 10_000), noise=0.05)
    np.testing.assert_allclose(many.pick_frequencies().frequencies_hz, np.sqrt(chain()[0]) / 2 / np.pi, rtol=1e-3)


def test_the_scatter_of_hits():
    rng = np.random.default_rng(1)
    f = np.linspace(1.0, 50.0, 2000)
    z = rng.standard_normal((2, 5, 1, 2000))
    hits = 1.0 + 2.0j + 0.3 * (z[0] + 1j * z[1])
    data = fmu.FRFData.from_hits(f, hits, ((1, "x"),), ((1, "x"),))
    assert (data.hits, data.freedom) == (5, 8.0)
    s2 = np.sum(np.abs(hits - hits.mean(axis=0)) ** 2, axis=0) / 8
    np.testing.assert_allclose(data.standard_deviation, np.sqrt(s2 / 5), rtol=1e-12)
    score = ((data.values - (1 + 2j)) / data.standard_deviation).real
    assert np.mean(np.abs(score) > 1.96) == pytest.approx(0.0857, abs=4 * np.sqrt(0.0857 * 0.9143 / 2000))  # ν = 8
    hits[:4, 0, 0], hits[3:, 0, 1] = np.nan, np.nan
    some = fmu.FRFData.from_hits(f, hits, ((1, "x"),), ((1, "x"),))
    assert (some.hits, some.used[0, :3].tolist()) == (3, [False, True, True])
    for wrong, message in (
        (hits[:1], "at least 2 hits"),
        (hits[0], "n_hits, n_frfs"),
        (np.ones((3, 1, 2000)), "differ"),
    ):
        with pytest.raises(ValueError, match=f"values: .*{message}"):
            fmu.FRFData.from_hits(f, wrong, ((1, "x"),), ((1, "x"),))


def test_independent_averages():
    """Welch's example: a Hann window at 50 % has 1 + 2/36 times the variance of as many independent segments."""
    hann = np.hanning(1001)[:-1]
    assert independent_averages(hann, 500, 10_000) == pytest.approx(10_000 / (1 + 2 / 36), rel=1e-3)
    assert independent_averages(hann, 1000, 7) == 7.0
    assert independent_averages(np.ones(100), 50, 10_000) == pytest.approx(10_000 / 1.5, rel=1e-3)


def oscillator_records(n, fs, seed, noise):
    """White noise and the acceleration of an oscillator of 20 Hz and 5 %, exact since the record is periodic."""
    rng = np.random.default_rng(seed)
    force = rng.standard_normal(n)
    f = np.fft.rfftfreq(n, 1 / fs)
    transfer = -((2 * np.pi * f) ** 2) * oscillator(f)
    clean = np.fft.irfft(np.fft.rfft(force) * transfer, n)
    return force, clean + noise * clean.std() * rng.standard_normal(n)


def oscillator(f):
    return receptances(f, np.array([(2 * np.pi * 20.0) ** 2]), np.array([[1.0]]), 0.05, [(0, 0)])[0]


@pytest.mark.parametrize("estimator", ["H1", "H2"])
def test_records_of_an_oscillator(estimator):
    """The error is within 1.96 sd at 95 % of the lines: of H1 with noise in the response, of H2 in the force."""
    fs, n = 200.0, 2**17
    force, response = oscillator_records(n, fs, 3, 0.3 if estimator == "H1" else 0.0)
    if estimator == "H2":
        force = force + 0.3 * np.random.default_rng(4).standard_normal(n)
    point = ((1, "x"),)
    data = fmu.FRFData.from_records(
        force, response[None], fs, point, point, estimator=estimator, segment=1024, band=(5.0, 80.0)
    )
    assert data.averages == pytest.approx(255 / (1 + 2 / 36), rel=1e-3)
    error = (data.values - -((2 * np.pi * data.frequencies_hz) ** 2) * oscillator(data.frequencies_hz))[data.used]
    score = error / data.standard_deviation[data.used]
    for part in (score.real, score.imag):
        assert np.mean(np.abs(part) < 1.96) == pytest.approx(0.95, abs=0.03)
        assert abs(part.mean()) < 0.25
    other = fmu.FRFData.from_records(
        force, response[None], fs, point, point, estimator="H2" if estimator == "H1" else "H1", segment=1024
    )
    ratio = np.median(np.abs(other.values[:, 30:400]) / np.abs(data.values[:, 30:400]))
    assert (ratio - 1.0) * (1 if estimator == "H1" else -1) > 0.05


@pytest.mark.parametrize("n", [3, 5, 10])
def test_few_averages_give_errors_with_students_distribution(n):
    """H1 of n averages, noise in the response: 95 % of the errors lie in the interval of 2 (n − 1) degrees."""
    rng = np.random.default_rng(n)
    lines = 20_000
    force, noise = ((rng.standard_normal((2, n, lines)) * [[[1.0]], [[1j]]]).sum(axis=0) for _ in range(2))
    true = 2.0 - 1.0j
    response = true * force + 1.5 * noise
    s_ff, s_xx = (np.mean(np.abs(x) ** 2, axis=0) for x in (force, response))
    s_fx = np.mean(force.conj() * response, axis=0)
    data = fmu.FRFData(
        np.arange(1.0, lines + 1.0), (s_fx / s_ff)[None], ((1, "x"),), ((1, "x"),),
        coherence=(np.abs(s_fx) ** 2 / (s_ff * s_xx))[None], averages=n,
    )  # fmt: skip
    score = (data.values[0] - true) / data.standard_deviation[0]
    limit = scipy.stats.t.isf(0.025, data.freedom)
    for part in (score.real, score.imag):
        assert np.mean(np.abs(part) < limit) == pytest.approx(0.95, abs=5.0 * np.sqrt(0.95 * 0.05 / lines))


def test_lines_of_a_window_are_kept_where_their_errors_are_independent():
    """A gain of 1 found from all lines together errs as their standard deviations say, over 120 records."""
    rng, point, z = np.random.default_rng(0), ((1, "z"),), []
    for _ in range(120):
        force, noise = rng.standard_normal((2, 4096))
        data = fmu.FRFData.from_records(force, force[None] + 0.5 * noise, 1024.0, point, point, segment=512)
        nu, V, gain = data.freedom, data.standard_deviation[0, 1:-1] ** 2, 1.0
        for _ in range(15):
            e = data.values[0, 1:-1] - gain
            gain += np.sum(e.real / (nu * V + np.abs(e) ** 2)) / np.sum(1.0 / (nu * V + np.abs(e) ** 2))
        z.append((gain - 1.0) * np.sqrt((nu - 2.0) / (nu + 2.0) * np.sum(1.0 / V)))
    assert np.mean(np.square(z)) == pytest.approx(1.0, abs=5.0 * np.sqrt(2.0 / 120))
    assert data.n_lines == 128
    assert data.notes[0].startswith("One of 2 lines is kept: the window 'hann' correlates")
    settings = {"sampling_hz": 1024.0, "drives": point, "responses": point, "segment": 512}
    every = fmu.FRFData.from_records(force, force[None], use=np.ones(257, dtype=bool), **settings)
    boxcar = fmu.FRFData.from_records(force, force[None] + noise, window="boxcar", **settings)
    apart = fmu.FRFData.from_records(force, force[None] + noise, window="boxcar", overlap=0.0, **settings)
    assert every.n_lines == apart.n_lines == 256
    assert boxcar.n_lines == 128
    assert not any("is kept" in note for note in every.notes + apart.notes)
    for window, step in {"boxcar": 1, "hann": 2, "hamming": 2, "blackman": 3, "flattop": 4}.items():
        assert independent_lines(scipy.signal.get_window(window, 1000), 1000, 10) == step


@pytest.mark.parametrize(
    ("window", "overlap"), [("boxcar", 0.5), ("boxcar", 0.75), ("hann", 0.5), ("flattop", 0.75), ("boxcar", 0.0)]
)
def test_errors_at_the_lines_that_are_kept_are_uncorrelated(window, overlap):
    """Segments that overlap by a half correlate errors at adjacent lines by 0.13 with a boxcar."""
    rng, point, r, n = np.random.default_rng(0), ((1, "z"),), 0.0, 0
    settings = {"segment": 2048, "overlap": overlap, "window": window}
    for _ in range(10):
        force, noise = rng.standard_normal((2, 4, 8192))
        response = (force + 0.1 * noise)[:, None]
        data = fmu.FRFData.from_records(force, response, 1024.0, point, point, **settings)
        error = (data.values[0] - 1.0) / data.standard_deviation[0] / np.sqrt(2.0)
        r, n = r + np.sum(np.real(error[1:] * error[:-1].conj())), n + data.n_lines - 1
    assert abs(r / n) < 0.05 + 5.0 / np.sqrt(n)


def test_records_of_hits():
    """Ten hits with a decayed response: the FRF is exact to the noise, with ten averages."""
    fs, n = 200.0, 2048
    f = np.fft.rfftfreq(n, 1 / fs)
    transfer = -((2 * np.pi * f) ** 2) * oscillator(f)
    rng = np.random.default_rng(5)
    force = np.zeros((10, n))
    force[:, 20:23] = rng.uniform(50.0, 150.0, (10, 1)) * np.array([0.5, 1.0, 0.5])
    response = np.fft.irfft(np.fft.rfft(force) * transfer, n)[:, None]
    response += 0.02 * response.std() * rng.standard_normal(response.shape)
    data = fmu.FRFData.from_records(
        force, response, fs, ((1, "x"),), ((1, "x"),), window="boxcar", band=(5.0, 60.0)
    )
    assert data.averages == 10.0
    error = (data.values - transfer[1:])[data.used] / data.standard_deviation[data.used]
    assert 0.8 < np.sqrt(np.mean(np.abs(error) ** 2) / 2.0) < 1.4
    np.testing.assert_allclose(data.pick_frequencies().frequencies_hz, 20.0, rtol=0.01)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"response": np.ones(64)}, r"response: must have shape \(n_frfs, 64\) \(got \(64,\)\)"),
        ({"response": np.ones((1, 60))}, r"response: must have shape"),
        ({"force": np.ones((2, 2, 2))}, r"force: must have shape"),
        ({"force": np.zeros(64)}, r"force: must not be zero"),
        ({"force": np.full(64, np.nan)}, r"force: must be finite"),
        ({"segment": 100}, r"segment: must be from 4 samples to the 64 of a record"),
        ({"segment": 64}, r"segment: must give at least two averages"),
        ({"overlap": 1.0}, r"overlap: must be a finite number of at least 0 and below 1"),
        ({"window": "round"}, r"window: must be a window of scipy.signal.get_window"),
        (
            {"window": "exponential"},
            r"window: must not be exponential: .*RayleighDamping\(alpha=2/τ\) to the damping",
        ),
        (
            {"force": np.eye(8, 64), "response": np.ones((8, 1, 64))},
            r"window: must be \"boxcar\" for records of hits",
        ),
        (
            {"force": np.eye(1, 64, 30).repeat(8, 0), "response": np.ones((8, 1, 64))},
            r"window: must be \"boxcar\"",
        ),
        ({"estimator": "H3"}, r"estimator: must be one of 'H1', 'H2'"),
        ({"kind": "dynamic-stiffness"}, r"kind: must be \"receptance\""),
    ],
)
def test_records_refused(changes, message):
    point = ((1, "x"),)
    arguments = {"force": np.arange(64.0), "response": np.ones((1, 64)), "sampling_hz": 100.0}
    with pytest.raises(ValueError, match=message):
        fmu.FRFData.from_records(**arguments | {"drives": point, "responses": point} | changes)


@pytest.mark.parametrize("k", range(3))
@pytest.mark.parametrize("pairs", [ROW, FULL], ids=["row", "full"])
def test_resonances_of_a_chain(k, pairs):
    found = measured(pairs, k).pick_frequencies()
    np.testing.assert_allclose(found.frequencies_hz, np.sqrt(chain()[0]) / 2 / np.pi, rtol=1e-6)
    np.testing.assert_allclose(found.damping, [0.01, 0.02, 0.01], rtol=1e-3)
    noisy = measured(pairs, k, noise=0.05, seed=k).pick_frequencies()
    np.testing.assert_allclose(noisy.frequencies_hz, np.sqrt(chain()[0]) / 2 / np.pi, rtol=1e-3)
    np.testing.assert_allclose(noisy.damping, [0.01, 0.02, 0.01], rtol=0.1)
    assert len(measured(pairs, k).pick_frequencies(2).frequencies_hz) == 2
    assert len(measured(pairs, k, band=(20.0, 60.0)).pick_frequencies().frequencies_hz) == 2


def test_curves_that_cross_and_directions_with_a_minus():
    """Where the curves of two modes cross there is no third one; a reversed direction changes no resonance."""
    for seed in (2, 5):
        data = measured(FULL, noise=0.02, seed=seed, f=np.linspace(0.2, 60.0, 1500))
        assert len(data.pick_frequencies().frequencies_hz) == 3
    responses = (*data.responses[:4], (1, "-x"), *data.responses[5:])
    sign = np.where(np.arange(9) == 4, -1.0, 1.0)[:, None]
    turned = fmu.FRFData(data.frequencies_hz, sign * data.values, data.drives, responses, sd=data.sd)
    assert turned.pick_frequencies().damping.tolist() == data.pick_frequencies().damping.tolist()


def test_two_modes_that_overlap():
    """Three half bandwidths apart, of one drive: each is found to a half bandwidth, ζf = 0.1 Hz."""
    f = np.linspace(5.0, 15.0, 1000)
    pairs, shapes = [(0, 0), (1, 0)], np.array([[1.0, 0.8], [0.5, -1.0]])
    values = receptances(f, (2 * np.pi * np.array([10.0, 10.3])) ** 2, shapes, np.array([0.01, 0.01]), pairs)
    data = fmu.FRFData(f, values, ((0, "y"), (0, "y")), ((0, "y"), (1, "y")), "receptance")
    np.testing.assert_allclose(data.pick_frequencies().frequencies_hz, [10.0, 10.3], rtol=0, atol=0.1)


def test_two_modes_within_a_bandwidth():
    """Two drives separate two modes 0.2 % apart of 1 % damping; one drive does not."""
    f = np.linspace(5.0, 15.0, 400)
    shapes = np.array([[1.0, 0.3], [-0.3, 1.0]])
    pairs = [(j, k) for j in range(2) for k in range(2)]
    values = receptances(f, (2 * np.pi * np.array([10.0, 10.02])) ** 2, shapes, np.array([0.01, 0.01]), pairs)
    points = [tuple((pair[end], "y") for pair in pairs) for end in (1, 0)]
    data = fmu.FRFData(f, values, *points, "receptance")
    np.testing.assert_allclose(data.pick_frequencies().frequencies_hz, [10.0, 10.02], rtol=3e-4)
    row = fmu.FRFData(f, values[::2], points[0][::2], points[1][::2], "receptance")
    assert len(row.pick_frequencies().frequencies_hz) == 1


def test_lines_at_the_edges_of_a_band_may_be_rounded():
    f = np.array([0.999994, 1.0, 2.0, 16.0001, 16.001])
    data = fmu.FRFData(f, np.ones((1, 5)), ((1, "x"),), ((1, "x"),), sd=0.1, band=(1.0, 16.0))
    assert data.used[0].tolist() == [True, True, True, True, False]
    assert replace(data, band=None).with_bands([(1.0, 16.0)]).used.tolist() == data.used.tolist()
