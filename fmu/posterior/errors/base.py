"""What an error model and a likelihood are: the protocols, and what their implementations share."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from typing import Any, ClassVar, NamedTuple, Protocol, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fmu.arguments import ArgumentError
from fmu.fem.pairing.prediction import ModalPrediction
from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.data.repeated import RepeatedTests
from fmu.posterior.errors.noise import NoiseIndex, Spread
from fmu.posterior.parameters import Parameter
from fmu.types import FloatArray, IntArray, Plain

LOG_2PI = float(np.log(2.0 * np.pi))

type Chain = Callable[[FloatArray, IntArray], FloatArray]
"""From derivatives by the parameters of the structure in one test, (n, m, P), and the test of each of the m, to
derivatives by the parameters of all tests, (n, m, n_parameters)."""


class ErrorModel(Protocol):
    """Settings of an error model."""

    @property
    def sd(self) -> ArrayLike | Parameter | None:
        """Standard deviation of the errors, known or to be inferred; None if the data have it."""
        ...

    def bind(self, data: ModalData, index: NoiseIndex) -> ErrorTerm:
        """Return the error model of `data`.

        Parameters
        ----------
        data : ModalData
        index : callable
            Takes the Parameter of an inferred standard deviation, returns its number among those of the problem.

        Raises
        ------
        ValueError
            If the settings do not fit the data.
        """
        ...

    def n_errors(self, data: ModalData) -> int:
        """Return how many errors `data` have of this kind."""
        ...

    def data_give_sd(self, data: ModalData) -> bool:
        """Say whether `data` have the standard deviation of these errors, which `sd` would replace."""
        ...


class Evaluated(NamedTuple):
    """Log-densities of an error model at n parameter vectors, and their derivatives.

    Attributes
    ----------
    terms : ndarray, shape (n, n_modes)
    by_frequency : ndarray, shape (n, n_modes), or None
        Derivative of each term with respect to the frequency of its mode, 1/Hz.
    by_shape : ndarray, shape (n, n_sensors, n_modes), or None
        Derivative with respect to the components of its shape.
    by_noise : mapping of int to ndarray, shape (n, n_modes), or None
        Derivative with respect to each inferred standard deviation.
    by_frequency_variance, by_shape_variance : ndarray, of the shapes of by_frequency and by_shape, or None
        Derivatives with respect to the variances of the model's own errors.
    """

    terms: FloatArray
    by_frequency: FloatArray | None = None
    by_shape: FloatArray | None = None
    by_noise: dict[int, FloatArray] | None = None
    by_frequency_variance: FloatArray | None = None
    by_shape_variance: FloatArray | None = None


class Residuals(NamedTuple):
    """Errors divided by their standard deviations, and their derivatives.

    Attributes
    ----------
    values : ndarray, shape (n, n_modes, q)
    by_frequency : ndarray, shape (n, n_modes, q), or None
    by_shape : ndarray, shape (n, n_modes, q, n_sensors), or None
    """

    values: FloatArray
    by_frequency: FloatArray | None = None
    by_shape: FloatArray | None = None


class ErrorTerm:
    """An error model bound to data.

    Attributes
    ----------
    spread : Spread
        Variances of the errors.
    needs_shapes : bool
        Whether the errors are those of mode shapes.
    of_frequencies : bool
        Whether they are those of frequencies, which `simulate` can add.
    is_least_squares : bool
        Whether the log-density is −½ Σ r² plus what depends on the standard deviations alone.
    is_chi_square : bool
        Whether the sum of the squared residuals of a mode is chi-square distributed with `n_data` degrees of
        freedom where the model is right and the errors are as stated.
    quantity : str
        What the errors are of, in the plural.
    tests : RepeatedTests or None
        The tests whose scatter alone gives the standard deviations.
    """

    spread: Spread
    needs_shapes: ClassVar[bool] = False
    of_frequencies: ClassVar[bool] = False
    is_least_squares: ClassVar[bool] = False
    is_chi_square: ClassVar[bool] = False
    quantity: ClassVar[str] = "other errors"
    tests: RepeatedTests | None = None

    @property
    def n_data(self) -> int:
        """How many independent numbers were measured of each mode: by default, as many as there are residuals."""
        return len(self.labels([""]))

    @property
    def is_known(self) -> bool:
        """Whether no standard deviation is inferred."""
        return not self.spread.sizes

    @property
    def couples_modes(self) -> bool:
        """Whether the term of a mode depends on other modes too."""
        return False

    def among(self, used: IntArray | None) -> ErrorTerm:
        """Return the error model whose terms of the `used` modes, numbered from 0, are their joint log-density.

        The terms of the other modes are dropped. To be overridden where a term depends on the measurement of other
        modes.
        """
        return self

    def normal_scores(self, z: FloatArray, mode: int | None = None) -> FloatArray:
        """Return errors over their standard deviations, (..., n_modes) or of one mode, as normal scores.

        They are Gaussian, but for standard deviations that were estimated from a few tests.
        """
        return z if self.tests is None else self.tests.normal_scores(z, mode)

    def project(self, seen: ModalPrediction) -> ModalPrediction:
        """Return the prediction in the form that `evaluate` and `residuals`, and their derivatives, refer to."""
        return seen

    def evaluate(self, seen: ModalPrediction, noise: FloatArray, gradient: bool) -> Evaluated:
        """Return the terms, with their derivatives if `gradient`.

        Parameters
        ----------
        seen : ModalPrediction
            From `project`.
        noise : ndarray, shape (n, n_noise)
            The inferred standard deviations.
        gradient : bool
        """
        raise NotImplementedError

    def residuals(self, seen: ModalPrediction, noise: FloatArray) -> Residuals:
        """Return the errors divided by their standard deviations, with their derivatives; see `evaluate`."""
        raise NotImplementedError

    def simulate(self, rng: np.random.Generator, frequencies: FloatArray, noise: FloatArray) -> FloatArray:
        """Return measured frequencies (n, n_modes) for computed ones, Hz; see `of_frequencies`."""
        raise NotImplementedError

    def simulate_inferred(
        self, rng: np.random.Generator, frequencies: FloatArray, noise: FloatArray
    ) -> FloatArray:
        """Return frequencies (n, n_modes), Hz, with only the inferred errors added."""
        return frequencies

    def given_others(self, frequencies: FloatArray, noise: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return mean and standard deviation, (n, n_modes) each, of each measured frequency given the others, Hz.

        The computed frequencies are of shape (n, n_modes); see `of_frequencies`.
        """
        raise NotImplementedError

    def labels(self, modes: Sequence[str]) -> list[str]:
        """Return a name for each residual, mode by mode."""
        raise NotImplementedError

    def information(self, noise: FloatArray, used: IntArray | None = None) -> FloatArray:
        """Return Fisher's information of the `used` modes on the inferred deviations, (n, n_noise, n_noise)."""
        return self.spread.information(noise, used)

    def as_dict(self) -> dict[str, Plain]:
        """Return the name of the error model under ``error``, and its settings."""
        raise NotImplementedError


class Likelihood:
    """The log-likelihood of the measured modes as a function of theta.

    Here theta has the parameters of the model, and then the inferred standard deviations. Of several tests the
    former are those of the structure in each test (`fmu.posterior.joint.layout.Layout.of_model`), and derivatives
    are by the parameters in a value's own test, unless there is a `Chain`.

    Attributes
    ----------
    of_modes : bool
        Whether the errors are those of computed modes: then `quadratic`, `residuals_and_slopes`, `labels` and
        `in_standard_deviations` exist.
    needs_shapes : bool
        Whether errors of mode shapes are among them.
    simulates : bool
        Whether it is a distribution of the frequencies, so that measurements can be simulated.
    noise : tuple of Parameter
        Standard deviations to be inferred: the last parameters of the problem.
    beta : ndarray, shape (n_modes,), or None
        β of eq. (4), where that is all there is to know of the errors.
    error : FrequencyTerm, CorrelatedFrequencyTerm or None
        The errors, where they are absolute errors of the frequencies, known, and nothing else.
    correlated : CorrelatedFrequencyTerm or None
        The errors of the frequencies where they have a covariance, whatever else has errors.
    terms_name : str
        Name of the terms in a trace.
    terms_of : tuple of ErrorTerm
        The error models; none if the errors are not those of measured quantities.
    chi_square : tuple of ErrorTerm
        Those whose squared residuals tell whether the model fits, see `ErrorTerm.is_chi_square`.
    quantities : tuple of QuantityTerm
        Measured quantities that are not of modes (`fmu.posterior.errors.quantities`).
    used : ndarray of int, shape (n_used,), or None
        The modes whose terms make the likelihood, numbered from 0 among the measured ones; None for all of them.
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
    used: IntArray | None = None

    def using(self, used: IntArray | None) -> Self:
        """Return the likelihood of other modes of the same data."""
        other = copy(self)
        other.used = used
        return other

    def with_model(self, model: Any) -> Self:
        """Return the likelihood with another model of the same parameters and modes; itself if it has none."""
        return self

    def of_used[Values: np.generic](self, values: NDArray[Values], axis: int = -1) -> NDArray[Values]:
        """Return the values of the used modes, of an array with one for each measured mode along an axis."""
        return values if self.used is None else np.take(values, self.used, axis)

    def terms(self, theta: FloatArray) -> FloatArray:
        """Return the log-likelihood of each used mode, shape (n, n_used), at theta (n, ndim)."""
        raise NotImplementedError

    @property
    def by_frequencies(self) -> bool:
        """Whether the frequencies of the model are enough for the terms."""
        return False

    def terms_of_frequencies(self, frequencies: FloatArray, theta: FloatArray) -> FloatArray:
        """Return the terms where the model has the frequencies (n, n_modes), Hz, at theta.

        It is solved again only if they are not enough.
        """
        return self.terms(theta)

    def terms_and_misfit(
        self, theta: FloatArray, frequencies: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Return the terms, and the squared residuals by the models of `chi_square`, (n, n_kinds, n_used).

        Where the frequencies of the model, (n, n_modes) in Hz, are given and are enough, it is not solved again.
        """
        terms = self.terms(theta)
        return terms, np.empty((len(terms), 0, terms.shape[1]))

    def terms_and_gradient(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the terms and their gradients, shape (n, n_used, ndim)."""
        raise NotImplementedError

    def quadratic(
        self, theta: FloatArray, chain: Chain | None = None
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the log-likelihood (n,), its gradient (n, ndim) and the information (n, ndim, ndim)."""
        raise NotImplementedError

    def residuals_and_slopes(self, theta: FloatArray, chain: Chain | None = None) -> tuple[FloatArray, FloatArray]:
        """Return the residuals (n, n_residuals) and their derivatives (n, n_residuals, n_structural)."""
        raise NotImplementedError

    @property
    def test_of_terms(self) -> IntArray:
        """The test that each term belongs to, shape (n_terms,); there is one test only."""
        raise NotImplementedError

    def labels(self, modes: tuple[str, ...]) -> tuple[str, ...]:
        """Return a name for each row of `sensitivity`."""
        raise NotImplementedError

    def in_standard_deviations(self, frequencies: FloatArray, error: FloatArray, theta: FloatArray) -> FloatArray:
        """Return errors of computed frequencies, (n_modes,) in Hz, in standard deviations of their measurement."""
        raise NotImplementedError

    def simulate(
        self, rng: np.random.Generator, frequencies: FloatArray, noise: FloatArray | None = None
    ) -> FloatArray:
        """Return frequencies (n, n_modes) with measurement errors added, Hz; the inferred sds are (n, n_noise).

        Raises
        ------
        ValueError
            If it is not a distribution of the frequencies.
        """
        raise ArgumentError("error", "must be a distribution of the frequencies to simulate them")

    def simulate_discrepancy(
        self, rng: np.random.Generator, frequencies: FloatArray, noise: FloatArray | None = None
    ) -> FloatArray:
        """Return frequencies (n, n_modes), Hz, with only the inferred errors, of the model, added."""
        return frequencies

    def why_not_finite(self, theta: FloatArray) -> str | None:
        """Say why the terms are not finite at a theta, shape (ndim,); None where they are."""
        raise NotImplementedError

    def as_dict(self) -> dict[str, Plain]:
        """Return names and settings in plain Python types."""
        raise NotImplementedError


def mode_weights(weights: ArrayLike | None, n: int) -> FloatArray:
    """Return the weights of `n` modes, 1 if none are given; ValueError if they are not positive."""
    if weights is None:
        return np.ones(n)
    given = np.asarray(weights, dtype=float)
    if given.shape != (n,) or not np.all(np.isfinite(given) & (given > 0)):
        raise ArgumentError("weights", f"must be {n} positive numbers, one per mode", given.tolist())
    return given


def unit_shapes(data: ModalData, name: str) -> FloatArray:
    """Return the measured shapes scaled to unit length, (n_sensors, n_modes); ValueError if there are none."""
    if data.shapes is None:
        raise ArgumentError(name, "need measured shapes at the sensors", "none")
    shapes = np.asarray(data.shapes)
    if len(shapes) < 2:
        raise ArgumentError(name, "need shapes at two sensors or more", len(shapes))
    return np.asarray(shapes / np.linalg.norm(shapes, axis=0))


def checked_beta(beta: ArrayLike, n_modes: int) -> FloatArray:
    """Return β of every mode, shape (n_modes,); ValueError if one is not positive and finite."""
    array = np.array(beta, dtype=float)
    if array.ndim > 1 or (array.ndim == 1 and len(array) != n_modes):
        raise ArgumentError("beta", f"must be a number or {n_modes} numbers", f"shape {array.shape}")
    if not np.all(np.isfinite(array) & (array > 0)):
        raise ArgumentError("beta", "must be positive and finite", array.tolist())
    return np.broadcast_to(array, n_modes).copy()
