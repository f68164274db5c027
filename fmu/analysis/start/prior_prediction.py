"""Predict the measured frequencies from the prior."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from fmu.analysis.prediction import central_sd
from fmu.numbers import fixed, given, significant, with_sd
from fmu.tables import data_frame
from fmu.types import BoolArray, FloatArray

if TYPE_CHECKING:
    import pandas as pd

    from fmu.posterior.problem import UpdatingProblem


FAR = 2.0
"""Number of standard deviations beyond which a measurement is far from its prior prediction."""
INTERVAL = 0.9
DRAWS = 200
_NEAR, _SPREAD = 1.25, 1.5
"""Largest factors by which the ratio of computed to measured frequencies differs from 2π and between modes, if
frequencies are in rad/s."""


@dataclass(frozen=True, eq=False)
class PriorPrediction:
    """Frequencies at draws from the prior, compared with the measured frequencies, Hz.

    All statistics of the prediction are NaN if the model was solved at fewer than two draws.

    Attributes
    ----------
    labels : tuple of str
    measured : ndarray, shape (n_modes,)
    frequencies : ndarray, shape (n, n_modes)
        Computed frequencies at the draws for which the model did not fail.
    noise_sd : ndarray, shape (n_modes,)
        Standard deviation of the measurement error and any model discrepancy. NaN if there is no error model of
        frequencies, or if errors have to be simulated and the model failed at every draw.
    failed : int
        Number of draws at which the model did not compute finite frequencies for all modes.
    """

    labels: tuple[str, ...]
    measured: FloatArray
    frequencies: FloatArray
    noise_sd: FloatArray
    failed: int

    @property
    def _drawn(self) -> FloatArray:
        """The computed frequencies, or NaNs of shape (2, n_modes) if there are fewer than two draws."""
        too_few = len(self.frequencies) < 2
        return np.full((2, len(self.measured)), np.nan) if too_few else self.frequencies

    @property
    def mean(self) -> FloatArray:
        """Prior mean of the computed frequencies, Hz, shape (n_modes,)."""
        return np.asarray(self._drawn.mean(axis=0))

    @property
    def sd(self) -> FloatArray:
        """Standard deviation of the predicted measurement, Hz, shape (n_modes,).

        It includes the measurement error, unless `noise_sd` is NaN.
        """
        return np.asarray(np.hypot(self._drawn.std(axis=0, ddof=1), np.nan_to_num(self.noise_sd)))

    @property
    def interval(self) -> FloatArray:
        """Ends of the central 90 % intervals of the computed frequencies, Hz, shape (2, n_modes)."""
        return np.asarray(np.quantile(self._drawn, [0.5 - INTERVAL / 2, 0.5 + INTERVAL / 2], axis=0))

    @property
    def distance(self) -> FloatArray:
        """Measured frequency minus the mean prediction, in standard deviations, shape (n_modes,)."""
        return np.asarray((self.measured - self.mean) / self.sd)

    @property
    def is_far(self) -> BoolArray:
        """Mask of the measured frequencies more than `FAR` sd from their prediction, shape (n_modes,).

        It is False throughout if there are fewer than two draws.
        """
        return np.asarray(~(np.abs(self.distance) <= FAR) & (len(self.frequencies) > 1))

    @property
    def doubts(self) -> list[str]:
        """Sentences on failed draws and on measured frequencies far from the prior prediction."""
        said = []
        if self.failed:
            said.append(f"The model failed at {self.failed} of {self.failed + len(self.frequencies)} prior draws.")
        if len(self.frequencies) < 2:
            return said
        for k in np.flatnonzero(self.is_far):
            side = "above" if self.distance[k] > 0 else "below"
            said.append(
                f"Mode {self.labels[k]}: measured at {given(self.measured[k])} Hz, "
                f"{fixed(abs(self.distance[k]), 1)} sd {side} the prior prediction "
                f"({with_sd(self.mean[k], self.sd[k])} Hz). Possible causes: wrong pairing, bounds too "
                f"narrow, incomplete model."
            )
        return [*said, *self._unit_doubts()]

    def _unit_doubts(self) -> list[str]:
        """Return a sentence if all frequencies are far, and off by one factor of about 2π or 1/(2π)."""
        ratios = self.mean / self.measured
        ratio = float(np.median(ratios))
        turn = 2 * np.pi if ratio > 1 else 1 / (2 * np.pi)
        is_one_factor = np.max(ratios) < _SPREAD * np.min(ratios) and 1 / _NEAR < ratio / turn < _NEAR
        if not (np.all(self.is_far) and is_one_factor):
            return []
        name = "2π" if ratio > 1 else "1/(2π)"
        return [
            f"The computed frequencies are {significant(ratio, 2)} times the measured ones, about {name}: is one "
            "of them in rad/s? Both must be in Hz."
        ]

    def sentences(self) -> list[str]:
        """Return `doubts`, followed by one more sentence if no measured frequency is far from its prediction.

        This sentence is left out if the model was solved at fewer than two draws.
        """
        said = self.doubts
        if len(self.frequencies) > 1 and not np.any(self.is_far):
            far = int(np.argmax(np.abs(self.distance)))
            said.append(
                "The prior covers the measured frequencies: each lies within "
                f"{fixed(abs(self.distance[far]), 1)} sd of its prior prediction (mode {self.labels[far]} is "
                "the farthest)."
            )
        return said

    def table(self) -> pd.DataFrame:
        """Return a table with one row per mode.

        The columns are ``measured``, ``mean``, ``sd`` and the interval ends, all in Hz, and ``distance`` in
        standard deviations.
        """
        lower, upper = self.interval
        columns = {
            "measured": self.measured,
            "mean": self.mean,
            "sd": self.sd,
            "eti90_lb": lower,
            "eti90_ub": upper,
        }
        return data_frame(columns | {"distance": self.distance}, "mode", self.labels)


def prior_prediction(problem: UpdatingProblem, draws: int = DRAWS, seed: int = 1) -> PriorPrediction:
    """Predict the measured frequencies from the prior.

    Parameters
    ----------
    problem : UpdatingProblem
    draws : int
        Number of draws from the prior, at least 2.
    seed : int

    Returns
    -------
    PriorPrediction

    Raises
    ------
    ValueError
        If `draws` is less than 2.
    """
    if draws < 2:
        raise ValueError(f"draws: must be at least 2 (got {draws})")
    rng = np.random.default_rng(seed)
    theta = problem.sample_prior(rng, draws)
    frequencies = problem.frequencies(theta)
    finite = np.all(np.isfinite(frequencies), axis=1)
    measured = np.asarray(problem.data.frequencies_hz, dtype=float)
    noise = _noise_sd(problem, frequencies[finite], theta[finite], rng)
    labels = tuple(map(str, problem.data.labels))
    return PriorPrediction(labels, measured, frequencies[finite], noise, int(np.sum(~finite)))


def _noise_sd(
    problem: UpdatingProblem, frequencies: FloatArray, theta: FloatArray, rng: np.random.Generator
) -> FloatArray:
    """Return the standard deviations of the frequency errors, (n_modes,), Hz.

    If they are known in Hz, the known values are returned. Otherwise they are computed from errors simulated at
    the prior draws `theta`, by `central_sd` for repeated tests, and are NaN if the error model has no frequency
    errors or no draw was solved.
    """
    if problem.likelihood.error is not None:
        return np.asarray(problem.likelihood.error.sd)
    if len(frequencies) and problem.likelihood.simulates:
        noise = problem.simulate_data(rng, frequencies, theta) - frequencies
        if problem.data.tests is not None:
            return central_sd(noise[None])
        return np.asarray(np.sqrt(np.mean(noise**2, axis=0)))
    return np.full(frequencies.shape[1], np.nan)
