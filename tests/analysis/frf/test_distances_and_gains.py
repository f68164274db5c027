"""Distances of measured FRFs from the model, and gains of channels, as traces keep them."""

import numpy as np
import pytest

import fmu
from fmu.analysis.frf.predictions import frf_groups
from fmu.report.plots.frf.functions import LARGE
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

AT = np.tile(np.r_[TRUTH, RATIOS], (1, 4, 1))


def group_of(data, *settings, **options):
    own = fmu.FRFErrors(data, fmu.ModalDamping(ratios()), *settings, **options)
    problem = fmu.UpdatingProblem(building(), modes(), parameters(), error=own)
    return frf_groups(problem, AT, np.random.default_rng(0))["frfs"]


@pytest.mark.parametrize("n", [3, 10])
def test_noise_alone_exceeds_the_dashed_line_at_one_value_in_a_hundred(n):
    """With standard deviations from n hits, at the true parameters."""
    rng, H, found = np.random.default_rng(1), receptances(), []
    for _ in range(10):
        noise = rng.standard_normal((2, n, *H.shape))
        hits = H + 0.05 * np.abs(H) * (noise[0] + 1j * noise[1])
        data = fmu.FRFData.from_hits(LINES, hits, ((2, "x"),) * 2, POINTS, "receptance")
        found.append(group_of(data)["distance"].to_numpy())
    beyond = np.array(found) > LARGE
    assert abs(beyond.sum() - 0.01 * beyond.size) < 5 * np.sqrt(0.01 * 0.99 * beyond.size)


@pytest.mark.parametrize("scale", ["linear", "log"])
@pytest.mark.parametrize("gain", [0.6, 1.4])
def test_a_gain_is_a_factor_of_the_amplitude(scale, gain):
    """Least squares of both parts at the true parameters; the prior is wide."""
    data = simulate(noise=0.01, distort=lambda H, w: H * np.array([[1.0], [gain]]))
    group = group_of(data, scale, gain_sd={POINTS[1]: 10.0})
    one = group.sel(channel="0 x")
    sd = gain * 0.01 / np.sqrt(len(LINES))
    assert abs(1.0 + float(one["gain"]) - gain) < 5 * sd
    np.testing.assert_allclose(one["gain_sd"], sd, rtol=0.03)
    assert float(group["gain"].sel(channel="2 x")) == float(group["gain_sd"].sel(channel="2 x")) == 0.0
