"""Parameters from a file: every prior is the one that Python builds, or a mistake with its place."""

import numpy as np
import pytest

import fmu
from fmu.config import ConfigurationError, load

LAST = """\
lower = 5000.0
upper = 9000.0
prior = { distribution = "normal", mean = 7850.0, sd = 500.0 }
"""

PRIORS = {
    "": ("lower = 1.0\nupper = 9e3", fmu.Uniform(), 1.0, 9e3),
    "uniform": ("lower = 1.0\nupper = 9e3", fmu.Uniform(), 1.0, 9e3),
    "normal, mean = 7e3, sd = 500": ("lower = 1.0", fmu.Normal(500.0, mean=7e3), 1.0, np.inf),
    "truncated-normal, sd = 500.0": ("lower = 7e3\nupper = 8e3", fmu.Normal(500.0), 7e3, 8e3),
    "half-normal, sd = 900.0, at = 7000.0": ("", fmu.HalfNormal(900.0, 7e3), 7e3, np.inf),
    "half-normal, sd = 9e3": ("lower = 1.0", fmu.HalfNormal(9e3), 1.0, np.inf),
    "log-normal, mode = 7800.0, sd = 900.0": ("", fmu.LogNormal.from_mode(7800.0, 900.0), 0.0, np.inf),
    "log-normal, mean = 7800, sd = 900": ("", fmu.LogNormal.from_mean(7800.0, 900.0), 0.0, np.inf),
    "log-normal, median = 7800.0, sigma = 0.1": ("upper = 9e3", fmu.LogNormal(7800.0, 0.1), 0.0, 9e3),
    "beta, a = 2.0, b = 3.0, low = 7e3, high = 9e3": ("", fmu.ScaledBeta(2.0, 3.0, 7e3, 9e3), 7e3, 9e3),
    "beta, a = 2.0, b = 3.0, low = 0.0, high = 9e3": ("", fmu.ScaledBeta(2.0, 3.0, 0.0, 9e3), 0.0, 9e3),
    "beta, mean = 7800, sd = 200, low = 7e3, high = 9e3": (
        "lower = 7500.0",
        fmu.ScaledBeta.from_mean(7800.0, 200.0, 7e3, 9e3),
        7500.0,
        9e3,
    ),
}


def table(words):
    """TOML of a prior from its distribution and settings."""
    distribution, *settings = words.split(", ")
    return f"prior = {{ {', '.join([f'distribution = "{distribution}"', *settings])} }}\n" if words else ""


@pytest.mark.parametrize("words", PRIORS)
def test_a_prior_of_a_file_is_that_of_python(words, frame_text, tmp_path):
    bounds, prior, lower, upper = PRIORS[words]
    (tmp_path / "portal.toml").write_text(frame_text.replace(LAST, f"{bounds}\n{table(words)}"))
    problem = load(tmp_path / "portal.toml")
    assert problem.parameters[1] == fmu.Parameter("rho beam", 7850.0, lower, upper, prior)
    assert (problem.lower[1], problem.upper[1]) == (lower, upper)
    assert np.isfinite(problem.log_prob(problem.start))


BROKEN = {
    "gauss": (
        "",
        "prior.distribution: must be one of uniform, normal, truncated-normal, half-normal, log-normal, beta",
    ),
    "normal": ("lower = 1.0", "prior.sd: is missing"),
    "normal, sd = 1.0, sigma = 2.0": ("lower = 1.0", "prior.sigma: is not a known key"),
    "normal, sd = 1.0": ("", "lower: must be positive, as the property is (got None)"),
    "truncated-normal, sd = 1.0": ("", "1.prior: a truncated normal needs lower or upper"),
    "half-normal, sd = -1.0": ("", "prior.sd: must be greater than 0 (got -1.0)"),
    "half-normal, sd = 1e4": ("", "lower: must be positive, as the property is (got None)"),
    "half-normal, sd = 1.0, at = 8e3": ("", "1.start: must be finite and within [8000, inf] (got 7850)"),
    "half-normal, sd = 1.0, at = 9e3": (
        "upper = 8e3",
        "1.prior: must have probability between the bounds (got none)",
    ),
    "log-normal, mode = 1.0": (
        "",
        "prior: must have either mode and sd, or mean and sd, or median and sigma",
    ),
    "log-normal, mode = 1.0, mean = 2.0, sd = 1.0": ("", "prior: must have either mode and sd"),
    "log-normal, median = 1.0, sd = 1.0": ("", "prior: must have either mode and sd"),
    "log-normal, median = 0.0, sigma = 1.0": ("", "prior.median: must be greater than 0 (got 0.0)"),
    "beta, a = 1.0, b = 1.0": ("", "1.start: must be finite and within [0, 1] (got 7850)"),
    "beta, low = 0.0, high = 9e3": ("", "prior: must have either a and b, or mean and sd"),
    "beta, a = 1.0, sd = 1.0, low = 0.0, high = 9e3": ("", "prior: must have either a and b, or mean and sd"),
    "beta, a = 1.0, b = 1.0, low = 9.0, high = 9.0": ("", "prior.high: must exceed low 9 (got 9)"),
    "beta, mean = 5.0, sd = 1.0, low = 6.0, high = 9e3": ("", "prior.mean: must lie between low 6 and high 9000"),
    "beta, mean = 5.0, sd = 5.0, low = 0.0, high = 10.0": ("", "prior.sd: must be below 5, the limit for"),
    "beta, a = 1.0, b = 2.0, low = 0.0, high = 9e3": (
        "",
        "lower: must be positive, as the property is (got None)",
    ),
}


@pytest.mark.parametrize("words", BROKEN)
def test_a_broken_prior(words, frame_text, tmp_path):
    bounds, expected = BROKEN[words]
    (tmp_path / "portal.toml").write_text(frame_text.replace(LAST, f"{bounds}\n{table(words)}"))
    with pytest.raises(ConfigurationError) as caught:
        load(tmp_path / "portal.toml")
    assert expected in str(caught.value)
    assert all(line.startswith("  parameters.1") for line in str(caught.value).splitlines()[1:])


def test_a_prior_without_its_distribution(frame_text, tmp_path):
    (tmp_path / "portal.toml").write_text(frame_text.replace(LAST, "prior = { sd = 1.0 }\n"))
    with pytest.raises(ConfigurationError, match=r"parameters\.1\.prior\.distribution: is missing"):
        load(tmp_path / "portal.toml")
