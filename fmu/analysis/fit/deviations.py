"""Warn if measured standard deviations are far smaller than the misfit of a nearly correct model."""

from __future__ import annotations

from typing import TYPE_CHECKING

from fmu.analysis.prediction import noise_sd
from fmu.analysis.trace.misfit import GROUP
from fmu.analysis.trace.reading import has
from fmu.numbers import names_in_words, share, significant

if TYPE_CHECKING:
    import xarray as xr

FAR = 4.0
"""Misfit in standard deviations that causes a warning; if they are correct, its probability is 6e-5."""
NEAR = 0.01
"""Fraction of the frequency above which a misfit is attributed to the model, whatever the standard deviations
are."""


def deviation_warnings(trace: xr.DataTree) -> list[str]:
    """Return a list with a warning if the measured standard deviations of some modes may be too small.

    Standard deviations from modal identification describe the scatter within one record. They include neither
    changes between records (temperature, level of vibration) nor the bias of the identification. The warning names
    each mode whose posterior mean frequency differs from the measured one by more than `FAR` standard deviations,
    but by less than the fraction `NEAR` of the frequency. There is no warning with inferred standard deviations,
    repeated tests or several tests.
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
        "test, or infer them: [[error]] with [[noise]]"
    ]
