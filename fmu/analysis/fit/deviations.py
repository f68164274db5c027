"""Whether measured standard deviations are far below the misfit of a model that is nearly right."""

from __future__ import annotations

from typing import TYPE_CHECKING

from fmu.analysis.fit.checks import noise_sd
from fmu.analysis.trace.misfit import GROUP
from fmu.analysis.trace.reading import has
from fmu.numbers import names_in_words, share, significant

if TYPE_CHECKING:
    import xarray as xr

FAR = 4.0
"""Misfits of so many standard deviations have a probability of 6e-5 each if the deviations are right."""
NEAR = 0.01
"""A misfit above this share of its frequency is the model's, whatever the deviations are."""


def deviation_warnings(trace: xr.DataTree) -> list[str]:
    """Return a warning if modes have a measured standard deviation that may be too small.

    The deviations that an identification gives are of the scatter within one record. What changes between records
    (temperature, level of vibration) and the bias of the identification are not in them. So a mode is named whose
    posterior mean is more than `FAR` of them away from what was measured, and yet within `NEAR` of its frequency.
    Inferred deviations, and those of repeated tests, are never named.
    """
    if not has(trace, "observed_data", "frequency") or not has(trace, "posterior_predictive", "model_frequency"):
        return []
    observed = trace["observed_data"]
    if "tests" in observed or "of_test" in observed or has(trace, GROUP, "noise_isf"):
        return []
    means = trace["posterior_predictive"]["model_frequency"].mean(("chain", "draw"))
    named = []
    for mode, measured in zip(observed["mode"].to_numpy(), observed["frequency"].to_numpy(), strict=True):
        sd, misfit = noise_sd(trace, mode), abs(float(means.sel(mode=mode)) - float(measured))
        if 0.0 < FAR * sd < misfit < NEAR * measured:
            off = f"{significant(misfit, 2)} Hz or {share(misfit / float(measured))}"
            named.append(f"mode {mode} ({significant(sd, 1)} Hz, misfit {off})")
    if not named:
        return []
    return [
        f"identified deviations may be too small: {names_in_words(named)}. They are of one record, without what "
        "changes between records (temperature, level of vibration) and the bias of the identification. Repeat the "
        "test, or infer them: [[error]] with [[noise]]."
    ]
