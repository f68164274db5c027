"""Frequency error models: eqs. (4) and (5) of Boulkaibet et al. (`fmu.paper.published`), and common variants."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from fmu.arguments import ArgumentError, check_arguments, takes_old_names
from fmu.fem.pairing.prediction import ModalPrediction
from fmu.posterior.data.covariance import checked_covariance, mode_weights, times
from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.data.stacked import Scatter, scatter_of
from fmu.posterior.errors.base import LOG_2PI, ErrorTerm, Evaluated, Residuals
from fmu.posterior.errors.noise import OLD_NAMES, NoiseIndex, Spread, checked_beta, require_sizes, spread
from fmu.posterior.parameters import Parameter
from fmu.types import FloatArray, IntArray, Plain

Kind = Literal["absolute", "relative", "eigenvalue"]


@takes_old_names(**OLD_NAMES)
@check_arguments
@dataclass(frozen=True)
class FrequencyErrors:
    """Gaussian frequency errors, independent from mode to mode unless `sd` defaults to a covariance in the data.

    Attributes
    ----------
    kind : {"absolute", "relative", "eigenvalue"}
        ε = f − f^m in Hz, ε = (f − f^m)/f^m, or ε = (f/f^m)² − 1, the relative eigenvalue error, where f is the
        computed and f^m the measured frequency. The last is normalised as a density of ε, the others of f^m in Hz.
    sd : float, array_like of shape (n_modes,), or Parameter, optional
        Standard deviation of ε: known, or inferred with its own prior. Defaults to the data's sd or covariance. A
        covariance requires absolute errors without weights and without `model_sd`.
    weights : array_like, shape (n_modes,), optional
        Weights w_i of the modes: the variance of ε_i is sd²/w_i.
    model_sd : Parameter, optional
        Standard deviation sd_d of the model error, to be inferred, in the unit of ε. The model error is
        independent from mode to mode and adds sd_d²/w_i to the variance of ε_i.

    Raises
    ------
    ValueError
        If `kind` is unknown, or a standard deviation or a weight is not positive and finite.

    Notes
    -----
    Model errors are rarely independent. A mass that was not modelled shifts many frequencies, and the parameters
    move further than their standard deviations suggest. If the prior of model_sd reaches zero (half-normal), the
    posterior may be hard to sample; a log-normal prior excludes zero. With as many parameters as frequencies, zero
    fits best: inferring model_sd requires more data than parameters, or an informative prior.
    """

    kind: Kind = "relative"
    sd: ArrayLike | Parameter | None = None
    weights: ArrayLike | None = None
    model_sd: Parameter | None = None

    def __post_init__(self) -> None:
        require_sizes(self.sd, self.weights)

    def bind(self, data: ModalData, index: NoiseIndex) -> ErrorTerm:
        """Return the error model bound to `data`; see `ErrorModel.bind`.

        Raise ValueError if standard deviations are missing, known standard deviations or weights do not fit the
        data, an inferred standard deviation has a negative lower bound or another parameter's name, or the data's
        covariance cannot be used.
        """
        measured = np.asarray(data.frequencies_hz)
        sd, tests = self.sd, scatter_of(data)
        if sd is None and data.covariance_hz2 is not None:
            if self.kind != "absolute" or self.weights is not None or self.model_sd is not None:
                raise ArgumentError(
                    "sd", "errors with a covariance must be absolute, without weights or a model_sd"
                )
            return CorrelatedFrequencyTerm(measured, np.asarray(data.covariance_hz2), tests=tests)
        if sd is None and data.sd_hz is not None:
            per_hz = {"absolute": 1.0, "relative": measured, "eigenvalue": 0.5 * measured}
            sd = np.asarray(data.sd_hz) / per_hz[self.kind]
        unit = measured if self.kind == "relative" else np.ones(len(measured))
        weights = mode_weights(self.weights, len(measured))
        size = unit / np.sqrt(weights)
        bound = FrequencyTerm(self.kind, measured, spread("frequency errors", sd, self.model_sd, size, index))
        bound.weights, bound.has_own_sd = weights, self.sd is not None
        if self.sd is None and self.model_sd is None and self.weights is None:
            bound.tests = tests
        return bound

    def n_errors(self, data: ModalData) -> int:
        """Return the number of used modes."""
        return sum(data.use)

    def data_give_sd(self, data: ModalData) -> bool:
        """Return True if `data` have standard deviations or a covariance for the frequencies."""
        return data.sd_hz is not None or data.covariance_hz2 is not None


@dataclass(frozen=True)
class BetaFrequencyErrors:
    """The paper's error model: absolute frequency errors with a trust β in the data.

    Attributes
    ----------
    beta : float or array_like, shape (n_modes,), optional
        β = 1/(2σ²), 1/Hz². Defaults to the data's uncertainty or, if the data have none, to β = 1 as in the paper.
    """

    beta: ArrayLike | None = None

    def bind(self, data: ModalData, index: NoiseIndex) -> ErrorTerm:
        """Return the error model bound to `data`; see `ErrorModel.bind`.

        Raise ValueError if `beta` is not positive and finite, has a wrong length, or is given although the data
        have standard deviations or a covariance.
        """
        known = data.sd_hz is not None or data.covariance_hz2 is not None
        if self.beta is None and known:
            return FrequencyErrors("absolute").bind(data, index)
        if known:
            own = "sd_hz" if data.covariance_hz2 is None else "covariance_hz2"
            raise ArgumentError("beta", f"must not be given, as the data have {own}", self.beta)
        measured = np.asarray(data.frequencies_hz)
        return FrequencyTerm.of_beta(measured, 1.0 if self.beta is None else self.beta)


class FrequencyTerm(ErrorTerm):
    """Independent Gaussian frequency errors: term i is log N(ε_i; 0, V_i).

    Here ε = f − f^m in Hz for absolute and relative errors, and ε = (f/f^m)² − 1 for eigenvalue errors. With known
    sds, term i is ½ log(β_i/π) − β_i ε_i² with β = 1/(2V): the paper's eqs. (4) and (5) with F = 1 value per mode.

    Parameters
    ----------
    kind : {"absolute", "relative", "eigenvalue"}
    measured : ndarray, shape (n_modes,), Hz
    spread : Spread
        Error variances V, in Hz² or, for eigenvalues, dimensionless.
    beta : ndarray, shape (n_modes,), optional
        1/(2V), if β is given instead of standard deviations.
    """

    of_frequencies = is_least_squares = is_chi_square = True
    quantity = "frequencies"
    covariance_hz2: FloatArray | None = None

    def __init__(self, kind: str, measured: FloatArray, spread: Spread, beta: FloatArray | None = None) -> None:
        self.kind, self.measured, self.spread = kind, np.array(measured), spread
        self._rows: tuple[FloatArray, FloatArray] | None = None
        if self.is_known:
            self.beta = 0.5 / spread.fixed**2 if beta is None else beta
            # shape (1, n_modes), like the frequencies at a single theta: NumPy is faster without broadcasting
            self._rows = 0.5 * np.log(self.beta / np.pi)[None], self.beta[None]

    @classmethod
    def of_beta(cls, measured: FloatArray, beta: ArrayLike = 1.0) -> FrequencyTerm:
        """Return the term for absolute errors with the paper's β in 1/Hz², one number or one number per mode.

        Raises
        ------
        ValueError
            If a β is not positive and finite, or there is neither one β nor one per mode.
        """
        known = checked_beta(beta, len(measured))
        return cls("absolute", measured, Spread(np.sqrt(0.5 / known), {}), known)

    @property
    def sd(self) -> FloatArray:
        """Standard deviations σ_i of the errors ε_i, shape (n_modes,), which must all be known."""
        return np.asarray(1.0 / np.sqrt(2.0 * self.beta))

    def log_prob_terms(self, frequencies: FloatArray) -> FloatArray:
        """Return each mode's log-density at frequencies (n, n_modes), Hz, if all standard deviations are known."""
        with np.errstate(over="ignore"):
            return self._known_terms(self.errors(frequencies)[0])

    def evaluate(self, seen: ModalPrediction, noise: FloatArray, gradient: bool) -> Evaluated:
        """Return the log-density of each mode; see `ErrorTerm.evaluate`."""
        error, slope = self.errors(seen.frequencies)
        if self._rows is not None:
            beta = self._rows[1]
            return Evaluated(self._known_terms(error), -2.0 * beta * error * slope if gradient else None)
        V = self.spread.variance(noise)
        terms = -0.5 * (error**2 / V + np.log(V) + LOG_2PI)
        if not gradient:
            return Evaluated(terms)
        by_V = 0.5 * (error**2 / V - 1.0) / V
        by_noise = {k: by_V * dV for k, dV in self.spread.slopes(noise).items()}
        return Evaluated(terms, -error / V * slope, None, by_noise)

    def residuals(self, seen: ModalPrediction, noise: FloatArray) -> Residuals:
        """Return the errors divided by their standard deviations; see `ErrorTerm.residuals`."""
        error, slope = self.errors(seen.frequencies)
        root = np.sqrt(2.0 * self.beta)[None] if self.is_known else self.spread.inverse_sd(noise)
        return Residuals((root * error)[..., None], np.broadcast_to(root * slope, error.shape)[..., None])

    def slope_and_curvature(self, frequencies: FloatArray, noise: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the residuals' derivatives ∂r/∂f in 1/Hz and ∂²r/∂f² in 1/Hz², shape (n, n_modes) each."""
        root = self.spread.inverse_sd(noise)
        bent = 2.0 / self.measured**2 if self.kind == "eigenvalue" else 0.0
        return root * self.errors(frequencies)[1], root * bent

    def change_of_slopes(
        self, seen: ModalPrediction, noise: FloatArray, by_slope: FloatArray
    ) -> tuple[FloatArray, None, FloatArray]:
        """Differentiate a function of the residuals' slopes; see `ErrorTerm.change_of_slopes`."""
        slope, bent = self.slope_and_curvature(seen.frequencies, noise)
        own, J = by_slope[:, :, 0], np.asarray(seen.frequency_slopes)
        return slope[..., None] * own, None, (bent * np.sum(own * J, axis=2))[..., None] * J

    def simulate(self, rng: np.random.Generator, frequencies: FloatArray, noise: FloatArray) -> FloatArray:
        """Return simulated measurements, (n, n_modes), in Hz. Eigenvalue errors below −0.99 are set to −0.99."""
        sd = self.sd if self.is_known else np.sqrt(self.spread.variance(noise))
        return self._add_errors(frequencies, sd * self.standard_errors(rng, frequencies.shape, noise))

    def _add_errors(self, frequencies: FloatArray, error: FloatArray) -> FloatArray:
        """Return measured frequencies with random errors: f + ε or, for eigenvalues, f/√(1 + max(ε, −0.99))."""
        if self.kind == "eigenvalue":
            # the measured frequency with this error ε, which exists only for ε above −1
            return np.asarray(frequencies / np.sqrt(1.0 + np.maximum(error, -0.99)))
        return np.asarray(frequencies + error)

    def given_others(self, frequencies: FloatArray, noise: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the mean and sd of each measured frequency, (n, n_modes), in Hz; see `ErrorTerm.given_others`.

        Eigenvalue errors are not Gaussian in f^m. Their sd in Hz is such that (f − f^m)/sd is ε divided by ε's sd.
        """
        sd = self.sd[None] if self.is_known else np.sqrt(self.spread.variance(noise))
        if self.kind == "eigenvalue":
            sd = sd * self.measured**2 / (self.measured + frequencies)
        if self.tests is not None:
            squares = ((frequencies - self.measured) / sd) ** 2
            sd = sd * self.tests.widened_given_others(squares, squares, self.used)
        return frequencies, np.broadcast_to(sd, frequencies.shape)

    def simulate_inferred(
        self, rng: np.random.Generator, frequencies: FloatArray, noise: FloatArray
    ) -> FloatArray:
        """Add only the random errors with inferred sds to frequencies, (n, n_modes), in Hz."""
        if not self.spread.sizes:
            return frequencies
        sd = np.sqrt(replace(self.spread, fixed=np.zeros_like(self.spread.fixed)).variance(noise))
        return self._add_errors(frequencies, sd * self.standard_errors(rng, frequencies.shape, noise))

    def labels(self, modes: Sequence[str]) -> list[str]:
        """Return the residuals' names, given the mode names; see `ErrorTerm.labels`."""
        return [f"{mode}, frequency" for mode in modes]

    def as_dict(self) -> dict[str, Plain]:
        """Return the error model's name and settings as a dict."""
        return {"error": f"{self.kind} frequency", "spread": self.spread.as_dict()}

    def _known_terms(self, error: FloatArray) -> FloatArray:
        assert self._rows is not None  # narrowed for the type checker
        normaliser, beta = self._rows
        return normaliser - beta * error**2

    def errors(self, f: FloatArray) -> tuple[FloatArray, FloatArray | float]:
        """Return the errors ε, (n, n_modes), in Hz (eigenvalue errors are dimensionless), and ∂ε/∂f."""
        # C order, so that the terms of a row are summed in the same order whatever the batch size
        f = np.ascontiguousarray(f)
        if self.kind == "eigenvalue":
            return (f / self.measured) ** 2 - 1.0, 2.0 * f / self.measured**2
        return f - self.measured, 1.0


class CorrelatedFrequencyTerm(ErrorTerm):
    """Gaussian errors ε = f − f^m in Hz (computed − measured) with covariance Σ: log P(D|θ) = log N(f^m; f, Σ).

    With Σ = LLᵀ (Cholesky) and z = L⁻¹ε the log-density is a sum over the modes,

    log P(D|θ) = Σ_i (−½ log 2π − log L_ii − ½ z_i²).

    Term i is the log-density of f_i^m given f_1^m … f_{i−1}^m. Each term depends on the mode order, but their sum
    does not. `project` turns frequencies into z.

    Parameters
    ----------
    measured : ndarray, shape (n_modes,), Hz
    covariance_hz2 : ndarray, shape (n_modes, n_modes), Hz²
    used : ndarray of int, optional
        Indices (from 0) of the modes in the likelihood. The covariances between these modes and the others are set
        to zero before L is computed: the used modes' terms sum to their marginal log-density.
    tests : RepeatedTests or StackedTests, optional
        If they gave the covariance.

    Raises
    ------
    ValueError
        If the covariance is not symmetric and positive definite, or has another shape.
    """

    of_frequencies = is_least_squares = is_chi_square = True
    quantity = "frequencies"
    kind = "absolute"

    def __init__(
        self,
        measured: FloatArray,
        covariance_hz2: FloatArray,
        used: IntArray | None = None,
        tests: Scatter | None = None,
    ) -> None:
        from scipy.linalg import solve_triangular

        self.measured, self.used, self.tests = np.array(measured), used, tests
        self.covariance_hz2 = checked_covariance(covariance_hz2, len(measured))
        self._root = self._root_of_all = np.linalg.cholesky(self.covariance_hz2)
        if used is not None:
            is_used = np.isin(np.arange(len(measured)), used)
            self._root = np.linalg.cholesky(np.where(is_used == is_used[:, None], self.covariance_hz2, 0.0))
        self._inverse_root = solve_triangular(self._root, np.eye(len(measured)), lower=True)
        self.spread = Spread(np.sqrt(np.diag(self.covariance_hz2)), {})
        self._normaliser = (-0.5 * np.log(2.0 * np.pi) - np.log(np.diag(self._root)))[None]

    @property
    def sd(self) -> FloatArray:
        """Marginal standard deviations σ_i of the errors, shape (n_modes,), Hz."""
        return self.spread.fixed

    @property
    def couples_modes(self) -> bool:
        """Always True, because a mode's log-density also depends on the modes before it."""
        return True

    @property
    def beta(self) -> FloatArray:
        """β_i = 1/(2σ_i²) of each mode, shape (n_modes,), 1/Hz²; it ignores the correlations."""
        return np.asarray(0.5 / np.diag(self.covariance_hz2))

    def among(self, used: IntArray | None) -> CorrelatedFrequencyTerm:
        """Return the error model with the modes that are not `used` marginalised out; None keeps all modes."""
        return CorrelatedFrequencyTerm(self.measured, self.covariance_hz2, used, self.tests)

    def project(self, seen: ModalPrediction) -> ModalPrediction:
        """Return the prediction with frequencies replaced by z = L⁻¹ε, and derivatives and variances to match."""
        slopes, variance = seen.frequency_slopes, seen.frequency_variance
        by_variance = seen.frequency_variance_slopes
        squares = self._inverse_root**2  # the model's own errors of z are correlated; only variances are used
        return replace(
            seen,
            frequencies=self._standardise(seen.frequencies),
            frequency_slopes=None if slopes is None else times(self._inverse_root, slopes, 1),
            frequency_variance=None if variance is None else times(squares, variance),
            frequency_variance_slopes=None if by_variance is None else times(squares, by_variance, 1),
        )

    def evaluate(self, seen: ModalPrediction, noise: FloatArray, gradient: bool) -> Evaluated:
        """Return the log-density of each mode; see `ErrorTerm.evaluate`. Infinite frequencies may give NaN."""
        z = seen.frequencies
        return Evaluated(self._normaliser - 0.5 * z**2, -z if gradient else None)

    def log_prob_terms(self, frequencies: FloatArray) -> FloatArray:
        """Return the log-density of each mode, (n, n_modes), at frequencies (n, n_modes), Hz."""
        with np.errstate(over="ignore", invalid="ignore"):
            return np.asarray(self._normaliser - 0.5 * self._standardise(frequencies) ** 2)

    def log_prob_given_others(self, frequencies: FloatArray) -> FloatArray:
        """Return the log-density of each used measured frequency given the other used ones, (…, n_modes).

        With g = Σ⁻¹ε and c_i = (Σ⁻¹)_ii it is log N(g_i/c_i; 0, 1/c_i) (Bürkner, Gabry & Vehtari 2021,
        Computational Statistics 36, 1243, eq. 12).
        """
        with np.errstate(over="ignore", invalid="ignore"):
            g = times(self._inverse_root.T, self._standardise(frequencies))
            c = np.sum(self._inverse_root**2, axis=0)
            return np.asarray(0.5 * np.log(c / (2.0 * np.pi)) - 0.5 * g**2 / c)

    def given_others(self, frequencies: FloatArray, noise: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the mean and sd of each used measured frequency given the other used ones, (n, n_modes), Hz."""
        c, z = np.sum(self._inverse_root**2, axis=0), self._standardise(frequencies)
        g = times(self._inverse_root.T, z)
        wider = 1.0 if self.tests is None else self.tests.widened_given_others(z**2, g**2 / c, self.used)
        return self.measured + g / c, np.broadcast_to(wider / np.sqrt(c), frequencies.shape)

    def residuals(self, seen: ModalPrediction, noise: FloatArray) -> Residuals:
        """Return the residuals z = L⁻¹ε; see `ErrorTerm.residuals`."""
        return Residuals(seen.frequencies[..., None], np.ones_like(seen.frequencies)[..., None])

    def simulate(self, rng: np.random.Generator, frequencies: FloatArray, noise: FloatArray) -> FloatArray:
        """Return simulated measurements, (n, n_modes), in Hz, of the computed frequencies."""
        z = self.standard_errors(rng, frequencies.shape, noise)
        return np.asarray(frequencies + times(self._root_of_all, z))

    def labels(self, modes: Sequence[str]) -> list[str]:
        """Return the residuals' names, given the mode names; see `ErrorTerm.labels`."""
        return [f"{mode}, frequency" for mode in modes]

    def as_dict(self) -> dict[str, Plain]:
        """Return the error model's name and settings as a dict."""
        return {"error": "frequency", "covariance_hz2": self.covariance_hz2.tolist()}

    def _standardise(self, frequencies: FloatArray) -> FloatArray:
        """Return the whitened errors z = L⁻¹ε, shape (…, n_modes)."""
        return times(self._inverse_root, frequencies - self.measured)
