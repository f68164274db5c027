"""Doubts about measured FRFs: kind, polarity, position and reciprocity, and errors that they have in common."""

import re
from dataclasses import replace

import numpy as np
import pytest

import fmu
from fmu.posterior.data.frf import correlation
from fmu.posterior.data.frf.correlation import correlation_of_errors
from tests.oscillators import KINDS, chain, measured, receptances

ROW, FULL = [(0, 0), (1, 0), (2, 0)], [(j, k) for j in range(3) for k in range(3)]


def oscillator(f):
    return receptances(f, np.array([(2 * np.pi * 20.0) ** 2]), np.array([[1.0]]), 0.05, [(0, 0)])[0]


@pytest.mark.parametrize("noise", [0.0, 0.05])
@pytest.mark.parametrize("free", [False, True])
@pytest.mark.parametrize("pairs", [ROW, FULL], ids=["row", "full"])
def test_a_wrong_kind_is_told(pairs, free, noise):
    for k, true in enumerate(KINDS):
        for said in KINDS:
            told = measured(pairs, k, free=free, noise=noise, seed=k, said=said).doubts()
            assert len(told) == (said != true)
            if told:
                assert told[0].startswith(f"The FRFs are said to be {said}, but ")
                assert told[0].endswith(f"They look like {true}.")


@pytest.mark.parametrize("k", range(3))
def test_lines_above_the_first_mode_raise_no_doubt(k):
    """The slope below the first resonance in the range is then neither of a supported nor of a free structure."""
    f = np.linspace(14.0, 60.0, 500)
    for pairs in (ROW, FULL, ROW[1:]):
        assert measured(pairs, k, f=f, noise=0.03).doubts() == ()
        assert measured(pairs, k, noise=0.03, band=(20.0, 60.0)).doubts() == ()


def test_a_reversed_channel_is_told():
    data = measured(ROW, noise=0.02)
    reverse = np.array([[-1.0], [1.0], [1.0]])
    settings = {"drives": data.drives, "responses": data.responses, "sd": data.sd}
    told = fmu.FRFData(data.frequencies_hz, reverse * data.values, **settings).doubts()
    assert len(told) == 1
    assert "FRF 0 x / 0 x is of a driving point, but its phase is reversed" in told[0]
    turned = settings | {"responses": ((0, "-x"), *data.responses[1:])}
    assert fmu.FRFData(data.frequencies_hz, reverse * data.values, **turned).doubts() == ()
    delayed = data.values * np.exp(-2j * np.pi * data.frequencies_hz * 0.01)
    assert "the sign of the power changes" in fmu.FRFData(data.frequencies_hz, delayed, **settings).doubts()[0]


@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_reciprocal_frfs_that_differ_are_told(noise):
    data = measured(FULL, noise=noise)
    assert data.doubts() == ()
    gain = np.ones((9, 1))
    gain[FULL.index((1, 0))] = 1.2
    told = fmu.FRFData(data.frequencies_hz, gain * data.values, data.drives, data.responses, sd=data.sd).doubts()
    assert len(told) == 1
    assert told[0].startswith("The reciprocal FRFs 0 x / 1 x and 1 x / 0 x differ by 1")
    assert ("times what their standard deviations explain" in told[0]) == bool(noise)


@pytest.mark.parametrize("n", [3, pytest.param(5, marks=pytest.mark.validate), 10])
def test_reciprocal_frfs_of_few_hits_are_doubted_only_if_they_differ(n):
    """20 pairs with 1600 lines, the second of which has three times the noise: none differs by chance."""
    rng, f = np.random.default_rng(n), np.linspace(1.0, 50.0, 1600)
    H = oscillator(f)
    for gain in (1.0, 1.0 + 0.5 / np.sqrt(n)):
        told = 0
        for _ in range(20):
            z = rng.standard_normal((2, n, 2, len(f)))
            hits = np.array([[gain], [1.0]]) * H * (1.0 + np.array([[0.05], [0.15]]) * (z[0] + 1j * z[1]))
            data = fmu.FRFData.from_hits(f, hits, ((1, "z"), (2, "z")), ((2, "z"), (1, "z")), "receptance")
            told += any("reciprocal" in sentence for sentence in data.doubts())
        assert told == (0 if gain == 1.0 else 20)


@pytest.mark.parametrize("n", [2, 3, 10])
@pytest.mark.parametrize("ratio", [1.0, 3.0])
def test_how_many_times_reciprocal_frfs_differ_more_than_explained(n, ratio):
    """Their means have a further error of ten times their standard deviation."""
    rng, f = np.random.default_rng(n), np.linspace(1.0, 50.0, 1600)
    H, sd = oscillator(f), 0.001 * np.array([[1.0], [ratio]])
    z = rng.standard_normal((2, n, 2, len(f)))
    more = rng.standard_normal((2, 2, len(f))) * 10.0 / np.sqrt(n)
    hits = H * (1.0 + sd * (z[0] + 1j * z[1] + more[0] + 1j * more[1]))
    told = fmu.FRFData.from_hits(f, hits, ((1, "z"), (2, "z")), ((2, "z"), (1, "z")), "receptance").doubts()
    times = float(re.search(r"([\d.]+) times what their", " ".join(told)).group(1))
    assert times == pytest.approx(np.sqrt(101.0), rel=0.15)


def hits_with_common_errors(own, common, seed, n=5):
    """Return FRFs of a row of three responses over n hits: errors of each, and errors that they have in common."""
    data, rng = measured(ROW), np.random.default_rng(seed)
    z, alike = (rng.standard_normal((2, n, frfs, data.n_lines)) for frfs in (3, 1))
    hits = data.values * (1.0 + own * (z[0] + 1j * z[1]) + common * (alike[0] + 1j * alike[1]))
    return fmu.FRFData.from_hits(data.frequencies_hz, hits, data.drives, data.responses)


def test_errors_that_the_frfs_of_a_force_have_in_common_are_told():
    """The correlation is ρ = common²/(own² + common²), and three FRFs err as √(1 + 2 ρ) shows."""
    for own, common in ((0.01, 0.05), (0.03, 0.04)):
        data = hits_with_common_errors(own, common, 1)
        rho = common**2 / (own**2 + common**2)
        assert data.correlation == pytest.approx(rho, abs=0.05)  # of five hits it is a little too small
        (told,) = data.doubts()
        assert "The errors of FRFs of one force are not independent" in told
        times = float(re.search(r"about ([\d.]+) times too small", told).group(1))
        assert times == pytest.approx(np.sqrt(1.0 + 2.0 * rho), rel=0.05)
    assert replace(data, sd=2.0 * data.standard_deviation, correlation=0.0).doubts() == ()
    assert data.without_lines(data.frequencies_hz > 30.0).doubts()
    apart = tuple((i, "x") for i in range(3))  # a force at each point: other hits
    hits = data.values * (1.0 + 0.03 * np.random.default_rng(2).standard_normal((5, 1, data.n_lines)))
    assert fmu.FRFData.from_hits(data.frequencies_hz, hits, apart, data.drives).correlation == 0.0


def test_independent_errors_of_hits_are_not_told():
    assert (
        sum(bool(hits_with_common_errors(0.05, 0.0, seed, n).correlation) for n in (3, 10) for seed in range(40))
        == 0
    )


def test_noise_of_the_force_in_records_is_told():
    """Noise v of the force's power leaves residuals of v/(1 + v) of the power of all responses."""
    rng, n = np.random.default_rng(0), 2**15
    f = np.fft.rfftfreq(n, 1 / 200.0)
    H = receptances(f, *chain(), np.array((0.05, 0.05, 0.05)), ROW) * (2j * np.pi * f) ** 2
    force = rng.standard_normal(n)
    clean = np.fft.irfft(np.fft.rfft(force) * H, n)
    noise = np.fft.irfft(np.fft.rfft(0.25 * rng.standard_normal(clean.shape)) * H, n)
    points = tuple((i, "x") for i in range(3))
    settings = {"segment": 2048, "band": (3.0, 80.0)}
    for of_force, expected in ((0.0, 0.0), (0.5, 0.2 / (0.2 + 0.25**2))):
        measured_force = force + of_force * rng.standard_normal(n)
        data = fmu.FRFData.from_records(measured_force, clean + noise, 200.0, points[:1] * 3, points, **settings)
        assert data.correlation == pytest.approx(expected, abs=0.05)
        assert any("not independent" in told for told in data.doubts()) == (of_force > 0.0)


@pytest.mark.parametrize(("n", "share"), [(3, 0.005), (10, 0.005)])
@pytest.mark.parametrize("band", [(3.0, 60.0), None])
def test_noise_at_low_lines_is_no_slope(band, n, share):
    """A flat noise hides the accelerance at the lowest lines, where some values still exceed 4 of their sds."""
    f, rng = np.linspace(0.1, 60.0, 600), np.random.default_rng(3)
    exact = measured([(0, 0)], f=f).values
    flat = share * np.sqrt(np.mean(np.abs(exact) ** 2))
    told = 0
    for _ in range(40):
        z = rng.standard_normal((3, n, len(f))) + 1j * rng.standard_normal((3, n, len(f)))
        force, response = z[0], exact * z[0] + flat * z[1]
        power, cross = np.mean(np.abs(force) ** 2, axis=0), np.mean(force.conj() * response, axis=0)
        coherence = np.abs(cross) ** 2 / power / np.mean(np.abs(response) ** 2, axis=0)
        point = ((0, "x"),)
        settings = {"coherence": coherence[None], "averages": n, "band": band}
        told += any(
            "said to be" in said
            for said in fmu.FRFData(f, (cross / power)[None], point, point, **settings).doubts()
        )
    assert told == 0


def test_few_hits_are_told():
    data = measured(ROW, noise=0.05)
    assert data.doubts() == ()
    z = np.random.default_rng(0).standard_normal((2, 3, *data.values.shape))
    hits = data.values * (1.0 + 0.05 * (z[0] + 1j * z[1]))
    told = fmu.FRFData.from_hits(data.frequencies_hz, hits, data.drives, data.responses).doubts()
    assert len(told) == 1
    assert told[0].startswith("The standard deviations have 4 degrees of freedom only")


def hits_with_gains(gain, own, seed, n=10, pairs=ROW, lines=slice(None), of_lines=None):
    """Return FRFs over n hits with gains that differ from hit to hit, and own errors, correlated over lines."""
    data, rng = measured(pairs), np.random.default_rng(seed)
    H = data.values[:, lines]
    z = rng.standard_normal((2, n, *H.shape))
    z = z[0] + 1j * z[1]
    if of_lines is not None:
        z = np.stack([np.convolve(row, of_lines, "same") for row in z.reshape(-1, H.shape[1])])
    hits = H * (1.0 + gain * rng.standard_normal((n, 1, 1)) + own * z.reshape(n, *H.shape))
    return fmu.FRFData.from_hits(data.frequencies_hz[lines], hits, data.drives, data.responses)


@pytest.mark.parametrize("own", [0.005, 0.01, 0.02])
def test_hits_whose_gains_differ_are_told(own):
    """Of a single FRF too. The gain of the mean of ten hits errs by 2 %/√10."""
    rho = 0.02**2 / (0.02**2 + 2.0 * own**2)
    for pairs in (ROW[:1], ROW):
        found, least = [], []
        for seed in range(20):
            data = hits_with_gains(0.02, own, seed, pairs=pairs)
            (told,) = data.doubts()
            assert "not independent from line to line" in told
            assert "times too small" not in told
            found.append(data.correlation_of_lines)
            least.append(float(re.search(r"force_gain_sd to FRFErrors, ([\d.]+) at least", told).group(1)))
        assert np.mean(found) == pytest.approx(rho, abs=0.1)
        assert np.mean(least) == pytest.approx(0.02 / np.sqrt(10.0), rel=0.2)
    kept = data.without_lines(data.frequencies_hz > 30.0)
    assert kept.correlation_of_lines == data.correlation_of_lines


@pytest.mark.parametrize("gain", [0.0, 0.02])
def test_records_of_hits_whose_gains_differ_are_told(gain):
    """The hits come at different times."""
    rng, n, points = np.random.default_rng(0), 2**11, tuple((i, "x") for i in range(3))
    f = np.fft.rfftfreq(n, 1 / 200.0)
    H = receptances(f, *chain(), np.array((0.05, 0.05, 0.05)), ROW) * (2j * np.pi * f) ** 2
    force = np.zeros((10, n))
    force[range(10), rng.integers(0, 200, 10)] = 1.0
    response = np.fft.irfft(np.fft.rfft(force)[:, None] * H, n) * (1.0 + gain * rng.standard_normal((10, 1, 1)))
    response += 2e-4 * rng.standard_normal(response.shape)
    settings = {"window": "boxcar", "band": (3.0, 60.0)}
    data = fmu.FRFData.from_records(force, response, 200.0, points[:1] * 3, points, **settings)
    assert any("from line to line" in told for told in data.doubts()) == (gain > 0.0)


def test_noise_of_the_force_is_told_beside_gains_that_differ():
    data = replace(measured(ROW, noise=0.02), correlation=0.9, correlation_of_lines=0.2)
    gains, common = data.doubts()
    assert "from line to line" in gains
    assert "times too small" in common
    assert len(replace(data, correlation_of_lines=0.88).doubts()) == 1


@pytest.mark.parametrize("n", [2, 3, 10])
@pytest.mark.parametrize("of_lines", [None, (0.5, 1.0, 0.5)], ids=["independent", "neighbours"])
def test_gains_that_do_not_differ_are_told_as_often_as_the_share_of_false_alarms(n, of_lines, monkeypatch):
    """Not of neighbours either that a Hann window correlates. At 10 % at most five of 50 are expected."""
    assert correlation._FALSE_ALARMS == 0.001
    monkeypatch.setattr(correlation, "_FALSE_ALARMS", 0.1)
    told = sum(
        hits_with_gains(0.0, 0.02, seed, n, ROW[:2], slice(0, None, 2), of_lines).correlation_of_lines > 0.0
        for seed in range(50)
    )
    assert told <= 11


def test_nor_where_one_hit_is_noisier_than_the_others():
    """About ten of 400 were told without Satterthwaite's degrees of freedom; one is expected with them."""
    rng, told = np.random.default_rng(0), 0
    noise = np.where(np.arange(10) == 0, 5.0, 1.0)[:, None]
    for _ in range(400):
        residuals = noise * (rng.standard_normal((10, 100)) + 1j * rng.standard_normal((10, 100)))
        residuals -= residuals.mean(axis=0)
        told += correlation_of_errors([residuals], np.ones((1, 100), dtype=bool), [0], 10.0).of_lines > 0.0
    assert told <= 4
