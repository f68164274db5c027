"""Test whether repeated tests are independent, as the standard error of their mean assumes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fmu.analysis.permutation import adjusted_probabilities, correlation_with, in_random_orders, lag_one
from fmu.analysis.prediction import measured_tests
from fmu.numbers import fixed, share, significant, whole
from fmu.posterior.data.repeated import RepeatedTests
from fmu.types import BoolArray, FloatArray

if TYPE_CHECKING:
    import xarray as xr


FALSE_ALARMS = 0.005
"""Largest probability of a warning for any mode, if the tests are independent."""
_MOST_CORRELATED = 0.98


@dataclass(frozen=True, eq=False)
class Repeatability:
    """Lag-1 autocorrelation and trend of repeated tests, in the order in which they were made.

    Attributes
    ----------
    labels : tuple of str
        Labels of the modes.
    n : ndarray, shape (n_modes,)
        Number of tests that found each mode.
    autocorrelation : ndarray, shape (n_modes,)
        Lag-1 autocorrelation r_1 of the frequencies that consecutive tests measured; 0 if all are equal.
    trend : ndarray, shape (n_modes,)
        Correlation of the frequency with the number of the test; 0 if all frequencies are equal.
    drift : ndarray, shape (n_modes,)
        Change from first to last test along the least-squares line, relative to the mean.
    resembles : ndarray of bool, shape (n_modes,)
        Whether each mode's autocorrelation is too large for independent tests.
    drifts : ndarray of bool, shape (n_modes,)
        Whether each mode's trend is too large, in either direction, for independent tests.
    all_resemble : bool
        Whether the mean autocorrelation over all modes is too large for independent tests.
    """

    labels: tuple[str, ...]
    n: NDArray[np.int64]
    autocorrelation: FloatArray
    trend: FloatArray
    drift: FloatArray
    resembles: BoolArray
    drifts: BoolArray
    all_resemble: bool

    @property
    def effective(self) -> FloatArray:
        """Number of independent tests that would give the same standard error of the mean, (n_modes,), at least 1.

        For an autoregressive series of order 1 it is n (1 − ρ)/(1 + ρ). Here ρ is r_1 corrected for its bias in
        short series to first order in 1/n, (r_1 + 1/n)/(1 − 3/n) (Marriott & Pope 1954, Biometrika 41, 390–402).
        In this correction n is at least 4. The corrected ρ is limited to 0 ≤ ρ ≤ 0.98, so the result never exceeds
        n.
        """
        n = np.maximum(self.n, 4)
        rho = np.clip((self.autocorrelation + 1.0 / n) / (1.0 - 3.0 / n), 0.0, _MOST_CORRELATED)
        return np.asarray(np.maximum(self.n * (1.0 - rho) / (1.0 + rho), 1.0))

    def doubts(self) -> list[str]:
        """Return a sentence on each mode whose tests drift or are correlated, followed by one on the remedy.

        If no single mode is listed, there may be a sentence on all modes together. The list is empty if there are
        no doubts.
        """
        said = [self._of_mode(int(k)) for k in np.flatnonzero(self.resembles | self.drifts)]
        if not said and self.all_resemble:
            n, effective = self.n.mean(), self.effective.mean()
            said.append(
                "Consecutive tests are correlated when all modes are considered together (mean lag-1 "
                f"autocorrelation {fixed(self.autocorrelation.mean(), 2)}). {_worth(n, effective)}"
            )
        if said:
            said.append(
                "Find out what changed between the tests (temperature, mass, joints). Then average the tests of "
                "each block or day into one row of tests, as such means are nearly independent; or keep only "
                "the tests of one state of the structure; or give frequencies with an sd that covers the change."
            )
        return said

    def _of_mode(self, k: int) -> str:
        what = []
        if self.resembles[k]:
            rho = fixed(self.autocorrelation[k], 2)
            what.append(f"consecutive tests are correlated (lag-1 autocorrelation {rho})")
        if self.drifts[k]:
            way = "rises" if self.drift[k] > 0 else "falls"
            what.append(
                f"the frequency {way} by {share(abs(self.drift[k]))} from the first test to the last "
                f"(correlation with the test order {fixed(self.trend[k], 2)})"
            )
        return f"Mode {self.labels[k]}: {' and '.join(what)}. {_worth(self.n[k], self.effective[k])}"


def _worth(n: float, effective: float) -> str:
    ratio = np.sqrt(n / effective)
    return (
        f"The {whole(n)} tests are worth about {significant(effective, 2)} independent ones: the sd of "
        f"their mean, s/√n, is too small by a factor of about {significant(ratio, 2)}."
    )


def repeatability(tests: ArrayLike, labels: tuple[str, ...]) -> Repeatability:
    """Test repeated tests for drift and correlation, by permutation.

    If the tests are independent, all orders of the tests are equally probable. The statistics are r_1 of each
    mode, the mean of r_1 over the modes, and the absolute correlation of each mode with the order. Each is
    standardised by its mean and standard deviation over random orders. All modes are permuted together, since they
    may depend on each other. A statistic is significant if it exceeds the largest of all statistics in at
    least 99.5 % of the random orders.

    Independent tests of any distribution are then called dependent in at most 0.5 % of problems (Westfall & Young
    1993, *Resampling-based multiple testing*, section 2.3). With five tests or fewer, nothing can be significant.
    An autoregression of 0.7 in one mode is detected with a probability of 1/7 by ten tests, and of 5/6 by thirty.

    Parameters
    ----------
    tests : array_like, shape (n_tests, n_modes), Hz
        Measured frequencies, NaN where a test missed a mode.
    labels : tuple of str
        Labels of the modes.

    Raises
    ------
    ValueError
        If `tests` are not valid repeated tests (`fmu.posterior.data.repeated.RepeatedTests`).
    """
    values = np.array(RepeatedTests(tests, "pooled").frequencies_hz)  # a mode's own values may be equal
    present = ~np.isnan(values)
    mean = np.nanmean(values, axis=0)
    differ = np.nanmax(values, axis=0) > np.nanmin(values, axis=0)
    z = np.where(present & differ, values - mean, 0.0)
    statistics = in_random_orders(z, present, _statistics)
    given, n_modes = statistics[0], z.shape[1]
    two_sided = np.arange(len(given)) > n_modes
    told = adjusted_probabilities(statistics, two_sided) <= FALSE_ALARMS
    t = np.arange(len(z), dtype=float)
    return Repeatability(
        labels=labels,
        n=present.sum(axis=0),
        autocorrelation=given[:n_modes],
        trend=given[n_modes + 1 :],
        drift=np.array(
            [
                np.polyfit(t[at], values[at, k], 1)[0] * (t[at][-1] - t[at][0]) / mean[k]
                for k, at in enumerate(present.T)
            ]
        ),
        resembles=told[:n_modes],
        drifts=told[n_modes + 1 :],
        all_resemble=bool(told[n_modes]),
    )


def repeatability_warnings(trace: xr.DataTree) -> list[str]:
    """Return `Repeatability.doubts` for the tests in a trace, or an empty list if tests were not repeated."""
    tests = measured_tests(trace)
    if tests is None:
        return []
    return repeatability(tests, tuple(map(str, trace["observed_data"]["mode"].to_numpy()))).doubts()


def _statistics(z: FloatArray, present: BoolArray) -> FloatArray:
    """Return r_1 of each mode, the mean r_1, and the correlations with the order, (n_orders, 2 n_modes + 1).

    The sequences `z` (n_orders, n_tests, n_modes) are centred, and zero where a test missed a mode.
    """
    with np.errstate(invalid="ignore"):  # 0/0 for a mode whose values are equal
        r = np.nan_to_num(lag_one(z, present))
        trend = np.nan_to_num(correlation_with(np.arange(z.shape[1], dtype=float), z, present))
    return np.concatenate([r, r.mean(axis=1, keepdims=True), trend], axis=1)
