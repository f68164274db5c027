"""Heavy-tailed frequency errors. They give little weight to a mode that contradicts the other modes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from annotated_types import Ge
from numpy.typing import ArrayLike as ArrayLike  # check_arguments reads the inherited annotations in this module
from scipy.special import digamma, gammaln, ndtri, polygamma, stdtr

from fmu.arguments import ArgumentError, check_arguments, require, takes_old_names
from fmu.fem.pairing.prediction import ModalPrediction
from fmu.numbers import given
from fmu.posterior.data.estimated_sd import gaussian_sd
from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.errors.base import ErrorTerm, Evaluated, Residuals
from fmu.posterior.errors.frequency import FrequencyErrors, FrequencyTerm
from fmu.posterior.errors.frequency import Kind as Kind
from fmu.posterior.errors.noise import OLD_NAMES, NoiseIndex
from fmu.posterior.parameters import Parameter, parameter_in, value_and_parameter
from fmu.types import FloatArray, IntArray, Plain

LEAST_FREEDOM = 1.0


@takes_old_names(**OLD_NAMES)
@check_arguments
@dataclass(frozen=True)
class StudentErrors(FrequencyErrors):
    """Independent frequency errors with Student's t distribution in place of a Gaussian.

    An error of many σ, for example from a misidentified mode, is then improbable but possible, and has little
    influence on the parameters (Lange, Little & Taylor 1989, *J. Am. Stat. Assoc.* 84, 881–896). Correctly
    measured modes lose some weight too: their information is (ν + 1)/(ν + 3) times the information with Gaussian
    errors.

    Attributes
    ----------
    freedom : float or Parameter
        Degrees of freedom ν, at least 1: known, or to be inferred. With ν = 4, an error beyond 3σ has a
        probability of 4 %, and an error beyond 10σ of 0.06 %. From ν = 30 on the distribution is nearly Gaussian.
    kind, sd, weights, model_sd
        As in `fmu.FrequencyErrors`, but for the scale σ. By default, σ is the data's standard deviation. The
        distribution's own standard deviation is σ √(ν/(ν − 2)) for ν > 2, otherwise infinite.

    Raises
    ------
    ValueError
        If `freedom` is a number below 1, or a standard deviation or a weight is not positive and finite.
    """

    freedom: float | Parameter = 4.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if parameter_in(self.freedom) is None:
            require("freedom", self.freedom, Annotated[float, Ge(LEAST_FREEDOM)])

    def bind(self, data: ModalData, index: NoiseIndex) -> ErrorTerm:
        """Return the error model bound to `data`; see `ErrorModel.bind`.

        Raises
        ------
        ValueError
            If `freedom` may be below 1, the data's covariance would be used, or for a reason given in
            `FrequencyErrors.bind`.
        """
        freedom, parameter = value_and_parameter(self.freedom)
        least = freedom if parameter is None else parameter.lower
        if not least >= LEAST_FREEDOM:
            name = "freedom" if parameter is None else f"{parameter.name}.lower"
            raise ArgumentError(name, f"must be at least {given(LEAST_FREEDOM)}, as degrees of freedom", least)
        gaussian = super().bind(data, index)
        if not isinstance(gaussian, FrequencyTerm):
            raise ArgumentError("freedom", "Student's errors are independent, and the data have a covariance")
        if parameter is not None:
            return StudentTerm(gaussian, np.nan, index(parameter))
        return StudentTerm(gaussian, freedom)


class StudentTerm(FrequencyTerm):
    """Independent errors with Student's t distribution: term i is log t_ν(ε_i/√V_i) − ½ log V_i.

    Parameters
    ----------
    gaussian : FrequencyTerm
        The same errors with a Gaussian distribution.
    freedom : float
        Degrees of freedom ν if known, otherwise NaN.
    number : int, optional
        Index of ν among the inferred error parameters, if ν is inferred.
    """

    is_least_squares = False

    def __init__(self, gaussian: FrequencyTerm, freedom: float, number: int | None = None) -> None:
        self._freedom, self._number = freedom, number
        super().__init__(gaussian.kind, gaussian.measured, gaussian.spread)
        self.weights, self.has_own_sd = gaussian.weights, gaussian.has_own_sd
        self.is_chi_square = number is None  # type: ignore[misc]

    @property
    def is_known(self) -> bool:
        """Always False, because the errors are not Gaussian with known standard deviations."""
        return False

    def normal_scores(self, z: FloatArray) -> FloatArray:
        """Convert errors divided by their scales to normal scores; NaN if ν is inferred.

        The scores are Φ⁻¹(F(z)), where F is Student's distribution function.
        """
        return np.asarray(-np.sign(z) * ndtri(stdtr(self._freedom, -np.abs(z))))

    def freedom(self, noise: FloatArray, mode: int) -> FloatArray:
        """Return ν at `noise` (n, n_noise), shape (n,), the same for all modes."""
        return self._nu(noise)[:, 0]

    def given_others(self, frequencies: FloatArray, noise: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return each measured frequency's mean and the sd of an equivalent Gaussian, (n, n_modes) each, in Hz.

        The Gaussian has the same central 95 % interval (`gaussian_sd`); see `ErrorTerm.given_others`.
        """
        mean, scale = super().given_others(frequencies, noise)
        return mean, scale * gaussian_sd(self._nu(noise))

    def evaluate(self, seen: ModalPrediction, noise: FloatArray, gradient: bool) -> Evaluated:
        """Return the log-density of each mode; see `ErrorTerm.evaluate`."""
        error, slope = self.errors(seen.frequencies)
        V, nu = self.spread.variance(noise), self._nu(noise)
        square = error**2 / V
        shrunk = np.log1p(square / nu)
        normaliser = gammaln(0.5 * (nu + 1.0)) - gammaln(0.5 * nu) - 0.5 * np.log(np.pi * nu)
        terms = normaliser - 0.5 * np.log(V) - 0.5 * (nu + 1.0) * shrunk
        if not gradient:
            return Evaluated(terms)
        weight = (nu + 1.0) / (nu + square)
        by_V = 0.5 * (weight * square - 1.0) / V
        by_noise = {k: by_V * dV for k, dV in self.spread.slopes(noise).items()}
        if self._number is not None:
            by_nu = digamma(0.5 * (nu + 1.0)) - digamma(0.5 * nu) - 1.0 / nu - shrunk + weight * square / nu
            by_noise[self._number] = 0.5 * by_nu
        return Evaluated(terms, -weight * error / V * slope, None, by_noise)

    def residuals(self, seen: ModalPrediction, noise: FloatArray) -> Residuals:
        """Return the residuals; see `ErrorTerm.residuals`.

        Their derivatives J are scaled so that JᵀJ is the Fisher information.
        """
        error, slope = self.errors(seen.frequencies)
        root, nu = self.spread.inverse_sd(noise), self._nu(noise)
        slopes = np.sqrt((nu + 1.0) / (nu + 3.0)) * root * slope
        return Residuals((root * error)[..., None], np.broadcast_to(slopes, error.shape)[..., None])

    def information(self, noise: FloatArray, used: IntArray | None = None) -> FloatArray:
        """Return the Fisher information on error parameters, (n, n_noise, n_noise), from all or the `used` modes.

        See Lange, Little & Taylor (1989), section 5. The terms that couple scales and degrees of freedom are
        neglected.
        """
        nu = self._nu(noise)[:, 0]
        found = self.spread.information(noise, used) * (nu / (nu + 3.0))[:, None, None]
        if self._number is not None:
            each = polygamma(1, 0.5 * nu) - polygamma(1, 0.5 * (nu + 1.0))
            each = 0.25 * each - (nu + 5.0) / (2.0 * nu * (nu + 1.0) * (nu + 3.0))
            n = len(self.measured) if used is None else len(used)
            found[:, self._number, self._number] += n * np.maximum(each, 0.0)
        return found

    def standard_errors(self, rng: np.random.Generator, shape: tuple[int, ...], noise: FloatArray) -> FloatArray:
        """Return random errors divided by their scales: values of Student's t."""
        return np.asarray(rng.standard_t(self._freedom if self._number is None else self._nu(noise), shape))

    def as_dict(self) -> dict[str, Plain]:
        """Return the error model's name and settings as a dict."""
        if self._number is None:
            return {**super().as_dict(), "freedom": self._freedom}
        return {**super().as_dict(), "freedom_inferred": self._number}

    def _nu(self, noise: FloatArray) -> FloatArray:
        """Return the degrees of freedom ν, shape (n, 1)."""
        if self._number is None:
            return np.full((len(noise), 1), self._freedom)
        return noise[:, self._number, None]
