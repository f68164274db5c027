"""Interfaces of error models and likelihoods, with the defaults that their implementations share."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from typing import Any, ClassVar, NamedTuple, Protocol, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fmu.arguments import ArgumentError
from fmu.fem.pairing.prediction import ModalPrediction
from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.data.stacked import Scatter
from fmu.posterior.errors.noise import NoiseIndex, Spread
from fmu.posterior.parameters import Parameter
from fmu.types import Chain, FloatArray, IntArray, Plain

LOG_2PI = float(np.log(2.0 * np.pi))


class ErrorModel(Protocol):
    """Settings of an error model."""

    @property
    def sd(self) -> ArrayLike | Parameter | None:
        """Standard deviation of the errors, or its Parameter if it is inferred; None to use any sd in the data."""
        ...

    def bind(self, data: ModalData, index: NoiseIndex) -> ErrorTerm:
        """Return the error model bound to `data`; raise ValueError if it is not of modes or does not fit `data`.

        `index` takes a parameter that the error model infers, and returns its index among all inferred ones.
        """
        ...

    def n_errors(self, data: ModalData) -> int:
        """Return the number of errors of this kind in the used modes of `data`."""
        ...

    def data_give_sd(self, data: ModalData) -> bool:
        """Return True if the data have standard deviations or a covariance of these errors, whatever `sd` is."""
        ...


class Evaluated(NamedTuple):
    """Log-densities of the modes under one error model, at n parameter vectors, and their derivatives.

    Derivatives are None if they were not requested or are zero.

    Attributes
    ----------
    terms : ndarray, shape (n, n_modes)
    by_frequency : ndarray, shape (n, n_modes), or None
        With respect to the mode's frequency after `ErrorTerm.project`, in 1/Hz; dimensionless if it is whitened.
    by_shape : ndarray, shape (n, n_sensors, n_modes), or None
        With respect to the components of the projected mode shape.
    by_noise : mapping of int to ndarray, shape (n, n_modes), or None
        With respect to each inferred error parameter, keyed by its index.
    by_frequency_variance, by_shape_variance : ndarray, shapes as by_frequency and by_shape, or None
        With respect to the variances of the computed frequencies and shapes, if the model is uncertain.
    """

    terms: FloatArray
    by_frequency: FloatArray | None = None
    by_shape: FloatArray | None = None
    by_noise: dict[int, FloatArray] | None = None
    by_frequency_variance: FloatArray | None = None
    by_shape_variance: FloatArray | None = None


class Residuals(NamedTuple):
    """Errors divided by their standard deviations, and derivatives with respect to frequencies and shapes.

    Attributes
    ----------
    values : ndarray, shape (n, n_modes, q)
        The q residuals of each mode.
    by_frequency : ndarray, shape (n, n_modes, q), or None
        In 1/Hz; dimensionless if `ErrorTerm.project` whitens the frequencies.
    by_shape : ndarray, shape (n, n_modes, q, n_sensors), or None
    """

    values: FloatArray
    by_frequency: FloatArray | None = None
    by_shape: FloatArray | None = None


class ErrorTerm:
    """An error model bound to data. Its terms are the log-densities of the measured modes.

    Attributes
    ----------
    spread : Spread, the error variances
    needs_shapes, of_frequencies : bool
        Whether these are errors in mode shapes, or in frequencies. Only errors in frequencies can be simulated.
    is_least_squares : bool
        Whether the log-density is −½ Σ r² plus a term that depends only on the standard deviations.
    is_chi_square : bool
        Whether a mode's squared `normal_scores` sum to a chi-square variable with `n_data` degrees of freedom.
    quantity : str
        Plural name of the quantities that have these errors.
    tests : RepeatedTests, StackedTests or None
        The repeated tests, if the standard deviations come only from their scatter.
    used : ndarray of int or None
        With `tests`: indices (from 0) of the modes in the likelihood, or None for all modes.
    has_own_sd : bool
        Whether a frequency error model gives or infers `sd`, so that it ignores the data's standard deviations.
    weights, nu : ndarray, shape (n_modes,), or None
        Weights w_i of frequency errors (variances sd²/w_i); degrees of freedom of shape sds from repeated tests.
    """

    spread: Spread
    needs_shapes: ClassVar[bool] = False
    of_frequencies: ClassVar[bool] = False
    is_least_squares: ClassVar[bool] = False
    is_chi_square: ClassVar[bool] = False
    quantity: ClassVar[str] = "other errors"
    tests: Scatter | None = None
    used: IntArray | None = None
    has_own_sd: bool = False
    weights: FloatArray | None = None
    nu: FloatArray | None = None

    @property
    def n_data(self) -> int:
        """Number of independent measured values per mode; by default, the number of residuals per mode."""
        return len(self.labels([""]))

    @property
    def is_known(self) -> bool:
        """Whether no error parameter is inferred; False for Student's t even with known parameters."""
        return not self.spread.sizes

    @property
    def couples_modes(self) -> bool:
        """Whether a mode's log-density also depends on other modes."""
        return False

    def among(self, used: IntArray | None) -> ErrorTerm:
        """Return the error model whose terms for the `used` modes (indices) sum to the modes' joint log-density.

        None selects all modes. The caller drops other terms. By default, a term depends on one measured mode only.
        """
        if self.tests is None:
            return self
        found = copy(self)
        found.used = used
        return found

    def normal_scores(self, z: FloatArray) -> FloatArray:
        """Convert errors divided by their sds, (..., n_modes), to normal scores. Gaussian errors are unchanged."""
        return z if self.tests is None else self.tests.normal_scores(z, self.used)

    def freedom(self, noise: FloatArray, mode: int) -> FloatArray:
        """Return the degrees of freedom of `given_others` for a mode, (n,), at `noise`; infinite if Gaussian."""
        nu = np.inf if self.tests is None else self.tests.freedom_given_others(self.used)[mode]
        return np.full(len(noise), nu)

    def standard_errors(self, rng: np.random.Generator, shape: tuple[int, ...], noise: FloatArray) -> FloatArray:
        """Draw errors divided by their sds, (n, n_modes); with `tests`, errors of the mean of new tests."""
        return rng.standard_normal(shape) if self.tests is None else self.tests.standard_errors(rng, shape[0])

    def project(self, seen: ModalPrediction) -> ModalPrediction:
        """Return the prediction in the form that `evaluate` and `residuals` need."""
        return seen

    def evaluate(self, seen: ModalPrediction, noise: FloatArray, gradient: bool) -> Evaluated:
        """Return the modes' log-densities at `seen` (from `project`) and inferred sds `noise`, (n, n_noise)."""
        raise NotImplementedError

    def residuals(self, seen: ModalPrediction, noise: FloatArray) -> Residuals:
        """Return the errors divided by their standard deviations, with derivatives; arguments as in `evaluate`."""
        raise NotImplementedError

    def residuals_within(self, seen: ModalPrediction, noise: FloatArray) -> Residuals:
        """Return `residuals` with derivatives projected onto the residuals' subspace; by default, unprojected."""
        return self.residuals(seen, noise)

    def change_of_slopes(
        self, seen: ModalPrediction, noise: FloatArray, by_slope: FloatArray
    ) -> tuple[FloatArray | None, FloatArray | None, FloatArray]:
        """Differentiate a function of the slopes in `residuals_within` with respect to the parameters.

        Parameters
        ----------
        seen, noise : as in `evaluate`, with derivatives
        by_slope : ndarray, shape (n, n_modes, q, n_parameters)
            Derivatives of the function with respect to each residual's slopes.

        Returns
        -------
        of_frequency, of_shape : ndarray, (n, n_modes, n_parameters) and (n, n_sensors, n_modes, n_parameters)
            Weights for the second derivatives of frequencies and shapes; None if these have no effect.
        direct : ndarray, shape (n, n_modes, n_parameters)
            The remainder: derivatives of the function while the slopes of all frequencies and shapes stay fixed.
        """
        raise NotImplementedError

    def simulate(self, rng: np.random.Generator, frequencies: FloatArray, noise: FloatArray) -> FloatArray:
        """Return simulated measurements, (n, n_modes), Hz, of computed frequencies; requires `of_frequencies`."""
        raise NotImplementedError

    def simulate_inferred(
        self, rng: np.random.Generator, frequencies: FloatArray, noise: FloatArray
    ) -> FloatArray:
        """Add random errors with inferred sds to frequencies, (n, n_modes), Hz. By default, nothing is added."""
        return frequencies

    def given_others(self, frequencies: FloatArray, noise: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return each frequency's mean and sd (for t errors, `gaussian_sd`) given the others, (n, n_modes), Hz."""
        raise NotImplementedError

    def labels(self, modes: Sequence[str]) -> list[str]:
        """Return the residuals' names, given the mode names. The residuals of a mode are adjacent."""
        raise NotImplementedError

    def information(self, noise: FloatArray, used: IntArray | None = None) -> FloatArray:
        """Return the Fisher information of the `used` or all modes on the inferred sds, (n, n_noise, n_noise)."""
        return self.spread.information(noise, used)

    def as_dict(self) -> dict[str, Plain]:
        """Return a dict of the error model's settings, with its name under the key ``error``."""
        raise NotImplementedError


class Likelihood:
    """The log-likelihood of the measurements as a function of theta.

    Here theta consists of the model's parameters (with several tests, the structural parameters in each test: see
    `fmu.posterior.joint.layout.Layout.of_model`), followed by the inferred error parameters. The derivatives of
    a value are with respect to the parameters in its own test, unless a `Chain` is given.

    Attributes
    ----------
    of_modes : bool
        Whether modes or FRFs have residuals, so that `quadratic`, `residuals_and_slopes` and `labels` exist.
    needs_shapes : bool
        Whether some of the errors are in mode shapes.
    simulates : bool
        Whether the likelihood defines a frequency distribution, so that measurements can be simulated.
    noise : tuple of Parameter
        Standard deviations and other error parameters that are inferred. They are the last parameters in theta.
    beta : ndarray, shape (n_modes,), or None
        β = 1/(2σ²) of each mode, without correlations, if `error` is set or the error is the modal residual.
    error : FrequencyTerm, CorrelatedFrequencyTerm or None
        The error model, if it is the only one and has absolute frequency errors with known standard deviations.
    correlated : CorrelatedFrequencyTerm or None
        The error model for frequencies whose errors have a covariance, even if there are other error models.
    terms_name : str
        Name of the terms in a trace.
    terms_of : tuple of ErrorTerm
        The error models; empty if the errors are not in measured quantities.
    chi_square : tuple of ErrorTerm
        The error models whose squared scores measure the model's fit; see `ErrorTerm.is_chi_square`.
    quantities : tuple of QuantityTerm
        Measured quantities other than modes.
    responses, every : tuple of FRFTerm, tuple of FRFsOfTest
        Measured frequency response functions, and the same with their tests.
    used : ndarray of int, shape (n_used,), or None
        Indices (from 0) of the measured modes whose terms make up the likelihood; None for all modes.
    has_discrepancy : bool
        Whether the model of the modes has a discrepancy.
    predictions_per_gradient : int
        Number of times that the modes and their derivatives are computed for one gradient.
    n_sizes : int or None
        Number of inferred discrepancy parameters, the last of `noise`; None without a discrepancy, or with FRFs.
    """

    of_modes: bool = False
    needs_shapes: bool = False
    simulates: bool = False
    noise: tuple[Parameter, ...] = ()
    beta: FloatArray | None = None
    error: Any = None
    correlated: Any = None
    terms_name: str
    terms_of: tuple[ErrorTerm, ...] = ()
    chi_square: tuple[ErrorTerm, ...] = ()
    quantities: tuple[Any, ...] = ()
    responses: tuple[Any, ...] = ()
    every: tuple[Any, ...] = ()
    used: IntArray | None = None
    has_discrepancy: bool = False
    predictions_per_gradient: int = 1
    n_sizes: int | None = None

    def using(self, used: IntArray | None) -> Self:
        """Return the likelihood of only the modes with indices `used`; None selects all modes."""
        other = copy(self)
        other.used = used
        return other

    def with_model(self, model: Any) -> Self:
        """Return the likelihood with another model of the same parameters and modes; by default, return `self`."""
        return self

    @property
    def frequency_term(self) -> ErrorTerm | None:
        """The first error model for frequencies; None if there is none."""
        return next((term for term in self.terms_of if term.of_frequencies), None)

    @property
    def n_noise(self) -> int:
        """Number of inferred parameters of the errors in modes, which come first in `noise`."""
        return len(self.noise)

    def easier(self) -> list[Likelihood]:
        """Return likelihoods with the same parameters but fewer maxima, the easiest first; by default, none."""
        return []

    def of_used[Values: np.generic](self, values: NDArray[Values], axis: int = -1) -> NDArray[Values]:
        """Select the values for the used modes from an array with a value for each measured mode along `axis`."""
        return values if self.used is None else np.take(values, self.used, axis)

    def terms(self, theta: FloatArray) -> FloatArray:
        """Return the log-likelihood of each used mode or other datum, (n, n_terms), at theta (n, ndim)."""
        raise NotImplementedError

    def observed(self, theta: FloatArray, gradient: bool = False) -> ModalPrediction:
        """Return the predicted modes at theta (n, ndim), with shapes if needed and derivatives if `gradient`."""
        raise NotImplementedError

    @property
    def by_frequencies(self) -> bool:
        """Whether the modes' log-likelihood depends on the model only through the computed frequencies."""
        return False

    def terms_of_frequencies(self, frequencies: FloatArray, theta: FloatArray) -> FloatArray:
        """Return the `terms` at theta, given the frequencies (n, n_modes); solve the model only if needed."""
        return self.terms(theta)

    def terms_and_misfit(
        self, theta: FloatArray, frequencies: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Return the modes' log-likelihood terms, and each mode's sum of squared normal scores.

        The shapes are (n, n_used) and (n, n_kinds, n_used), where the n_kinds error models are in `chi_square`.
        If the computed frequencies, (n, n_modes) in Hz, are given and sufficient, the model is not solved again.
        """
        terms = self.terms(theta)
        return terms, np.empty((len(terms), 0, terms.shape[1]))

    def terms_and_gradient(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the `terms`, (n, n_terms), and their gradients, (n, n_terms, ndim)."""
        raise NotImplementedError

    def quadratic(
        self, theta: FloatArray, chain: Chain | None = None
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the log-likelihood (n,), its gradient (n, ndim) and the information (n, ndim, ndim)."""
        raise NotImplementedError

    def residuals_and_slopes(self, theta: FloatArray, chain: Chain | None = None) -> tuple[FloatArray, FloatArray]:
        """Return residuals (n, n_residuals) and derivatives (n, n_residuals, n_structural); see `Chain`."""
        raise NotImplementedError

    @property
    def test_of_terms(self) -> IntArray:
        """Index of the test that each log-likelihood term belongs to, shape (n_terms,)."""
        raise NotImplementedError

    def labels(self, modes: tuple[str, ...]) -> tuple[str, ...]:
        """Return the residuals' names in the order of `residuals_and_slopes`, given the names of the modes."""
        raise NotImplementedError

    def in_standard_deviations(self, frequencies: FloatArray, error: FloatArray, theta: FloatArray) -> FloatArray:
        """Return errors in computed frequencies, (n_modes,), Hz, divided by measurement standard deviations."""
        raise NotImplementedError

    def simulate(
        self, rng: np.random.Generator, frequencies: FloatArray, noise: FloatArray | None = None
    ) -> FloatArray:
        """Return frequencies with measurement errors added, (n, n_modes), Hz; `noise` has the inferred sds.

        Raise ValueError if the likelihood does not define a frequency distribution.
        """
        raise ArgumentError("error", "must be a distribution of the frequencies to simulate them")

    def simulate_discrepancy(
        self, rng: np.random.Generator, frequencies: FloatArray, noise: FloatArray | None = None
    ) -> FloatArray:
        """Add random errors with inferred sds to frequencies, (n, n_modes), Hz. By default, nothing is added."""
        return frequencies

    def with_discrepancy(
        self, rng: np.random.Generator, frequencies: FloatArray, theta: FloatArray | None, given_data: bool = False
    ) -> FloatArray:
        """Add any discrepancy to frequencies, Hz, drawn from its posterior if `given_data`, else its prior."""
        return frequencies

    def why_not_finite(self, theta: FloatArray) -> str | None:
        """Return the reason why the log-likelihood is not finite at theta (ndim,), or None if it is finite."""
        raise NotImplementedError

    def as_dict(self) -> dict[str, Plain]:
        """Return the names and settings of the error models as a dict of plain Python types."""
        raise NotImplementedError
