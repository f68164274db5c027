"""Log-likelihood of the measured modes as a sum over error models with known or inferred standard deviations."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from copy import copy
from typing import Self

import numpy as np

from fmu.fem.pairing.failed_solves import why_no_frequencies
from fmu.fem.pairing.modal_model import ModalModel
from fmu.fem.pairing.prediction import ModalPrediction
from fmu.numbers import names_in_words
from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.errors.base import ErrorModel, Evaluated, Likelihood
from fmu.posterior.errors.frequency import BetaFrequencyErrors, CorrelatedFrequencyTerm, FrequencyTerm
from fmu.posterior.errors.noise import numbering
from fmu.posterior.errors.quantities import QuantityTerm
from fmu.posterior.errors.slopes import (
    chain_prediction,
    gradient_of_terms,
    nan_unless_finite,
    residuals_of_term,
    without_shapes,
)
from fmu.posterior.errors.surrogate_variance import evaluated_with_variance, sensitivity_to_model
from fmu.posterior.parameters import Parameter
from fmu.types import Chain, FloatArray, IntArray, Plain


class ModalLikelihood(Likelihood):
    """The log-likelihood as a sum over independent error models.

    Parameters
    ----------
    model : ModalModel
        Its parameters come first in theta. It must compute shapes if an error model needs them.
    data : ModalData
    errors : sequence of ErrorModel
    quantities : sequence of QuantityTerm
        Measured quantities other than modes. Their terms follow the modes' terms.

    Raises
    ------
    ValueError
        If there is no error model, an error model cannot be bound to the data, the model does not compute the
        required shapes, or two different inferred error parameters share a name.
    """

    of_modes = True

    def __init__(
        self,
        model: ModalModel,
        data: ModalData,
        errors: Sequence[ErrorModel],
        quantities: Sequence[QuantityTerm] = (),
    ) -> None:
        if not errors:
            raise ValueError("error: at least one error model is needed (got none)")
        self.model, self.n_structural = model, model.n_parameters
        noise: list[Parameter] = []
        self.terms_of = tuple(error.bind(data, numbering(noise)).among(data.used) for error in errors)
        self.chi_square = tuple(term for term in self.terms_of if term.is_chi_square)
        self.quantities = tuple(quantities)
        self.used = data.used
        self.noise = tuple(noise)
        self.needs_shapes = any(term.needs_shapes for term in self.terms_of)
        if self.needs_shapes and not model.gives_shapes:
            raise ValueError(f"error: errors of shapes need a model that gives shapes (got {model.name})")
        self.simulates = self.frequency_term is not None
        only = self.terms_of[0] if len(self.terms_of) == 1 else None
        if isinstance(only, FrequencyTerm | CorrelatedFrequencyTerm) and only.is_known and only.kind == "absolute":
            self.error = only
        self._is_of_beta = isinstance(errors[0], BetaFrequencyErrors)
        self.beta = None if self.error is None else self.error.beta
        self.terms_name = "modes" if self.error is None else "frequency"
        self._fast = self._choose_fast_path()

    def using(self, used: IntArray | None) -> Self:
        """Return the likelihood of the quantities and the modes with indices `used`; None selects all modes."""
        other = super().using(used)
        other.terms_of = tuple(term.among(used) for term in self.terms_of)
        if self.chi_square:
            other.chi_square = tuple(term for term in other.terms_of if term.is_chi_square)
        if self.error is not None:
            other.error = other.terms_of[0]
        other._fast = other._choose_fast_path()
        return other

    def with_model(self, model: ModalModel) -> Self:
        """Return the likelihood with another model of the same parameters and modes, such as a surrogate."""
        other = copy(self)
        other.model = model
        other._fast = other._choose_fast_path()
        return other

    def _choose_fast_path(self) -> FrequencyTerm | CorrelatedFrequencyTerm | None:
        """Return `error`, whose terms need frequencies alone; None if noise is inferred or the model uncertain."""
        return None if self.model.is_uncertain or self.noise else self.error

    @property
    def correlated(self) -> CorrelatedFrequencyTerm | None:
        """The frequency error model that has a covariance matrix; None if no frequency error model has one."""
        return next((term for term in self.terms_of if isinstance(term, CorrelatedFrequencyTerm)), None)

    def terms(self, theta: FloatArray) -> FloatArray:
        """Return the log-likelihood of each used mode and each quantity, (n, n_terms), at theta (n, ndim)."""
        if self._fast is None:
            return self.terms_of_observed(self.observed(theta), theta)
        terms = self.of_used(self._fast.log_prob_terms(self.model.frequencies(theta)))
        return np.asarray(terms if not self.quantities else self._with_quantities(terms, theta))

    def terms_of_observed(self, seen: ModalPrediction, theta: FloatArray) -> FloatArray:
        """Return the `terms` at theta (n, ndim), given the predicted modes there."""
        parts = self._parts(seen, theta, gradient=False)[1]
        return self._with_quantities(self.of_used(np.asarray(sum(part.terms for part in parts))), theta)

    @property
    def by_frequencies(self) -> bool:
        """Whether the modes' log-likelihood depends on the model only through the computed frequencies."""
        return not (self.needs_shapes or self.model.is_uncertain)

    def terms_and_misfit(
        self, theta: FloatArray, frequencies: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Return the modes' `terms`, (n, n_used), and `misfit`, (n, n_kinds, n_used); see `Likelihood`."""
        is_enough = self.by_frequencies and frequencies is not None
        seen = without_shapes(np.asarray(frequencies)) if is_enough else self.observed(theta)
        squares = self.misfit(seen, theta)
        return self.terms_of_observed(seen, theta)[:, : squares.shape[-1]], squares

    def misfit(self, seen: ModalPrediction, theta: FloatArray) -> FloatArray:
        """Return squared normal scores, summed for each `chi_square` model and used mode, (n, n_kinds, n_used)."""
        noise, found = theta[:, self.n_structural :], np.empty((len(theta), 0, seen.frequencies.shape[1]))
        for term in self.chi_square:
            r = np.moveaxis(term.residuals(term.project(seen), noise).values, 1, 2)
            squares = np.sum(term.normal_scores(r) ** 2, axis=1)
            found = np.concatenate([found, squares[:, None]], axis=1)
        return self.of_used(found)

    def terms_and_gradient(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the `terms` and their gradients, (n, n_terms, ndim); for several tests see `Likelihood`."""
        seen = self.observed(theta, True)
        if self._fast is None:
            return self._terms_and_gradient(seen, theta)
        view = self._fast.project(seen)
        with np.errstate(invalid="ignore", over="ignore"):
            part = self._fast.evaluate(view, theta[:, self.n_structural :], gradient=True)
            slopes = np.asarray(part.by_frequency)[..., None] * np.asarray(view.frequency_slopes)
        return self._with_quantities_and_slopes(self.of_used(part.terms), self.of_used(slopes, 1), theta)

    def terms_of_frequencies(self, frequencies: FloatArray, theta: FloatArray) -> FloatArray:
        """Return the log-likelihood terms at theta, given the computed frequencies; see `Likelihood`."""
        if not self.by_frequencies:
            return self.terms(theta)
        return self.terms_of_observed(without_shapes(frequencies), theta)

    def sensitivity_to_model(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the sensitivity of the log-likelihood to an uncertain model's errors, at theta (n, ndim).

        The arrays from `fmu.posterior.errors.surrogate_variance.sensitivity_to_model`, (n, n_modes) for
        frequencies and (n, n_sensors, n_modes) for shapes, are summed over the error models; unused modes have 0.
        """
        seen, noise = self.observed(theta), theta[:, self.n_structural :]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            found = [sensitivity_to_model(term, seen, noise) for term in self.terms_of]
        of_frequency, of_shape = (np.asarray(sum(parts)) for parts in zip(*found, strict=True))
        if self.used is not None:
            unused = np.setdiff1d(np.arange(self.model.n_modes), self.used)
            of_frequency[:, unused], of_shape[:, :, unused] = 0.0, 0.0
        return of_frequency, of_shape

    def residuals_and_slopes(self, theta: FloatArray, chain: Chain | None = None) -> tuple[FloatArray, FloatArray]:
        """Return the residuals of the used modes and quantities, and their derivatives; see `Likelihood`."""
        return self._all_residuals_and_slopes(self._observed_slopes(theta, chain), theta, chain)

    def terms_and_residuals(
        self, seen: ModalPrediction, theta: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return `terms` and `residuals_and_slopes` at theta (n, ndim), given the modes and their derivatives."""
        return self.terms_of_observed(seen, theta), *self._all_residuals_and_slopes(seen, theta, None)

    def labels(self, modes: tuple[str, ...]) -> tuple[str, ...]:
        """Return the residuals' names in the order of `residuals_and_slopes`, given the names of the modes."""
        modes = tuple(map(str, self.of_used(np.array(modes))))
        others = tuple(label for term in self.quantities for label in term.labels)
        if self.error is not None:
            return modes + others
        return tuple(label for term in self.terms_of for label in term.labels(modes)) + others

    def in_standard_deviations(self, frequencies: FloatArray, error: FloatArray, theta: FloatArray) -> FloatArray:
        """Return absolute errors in computed frequencies, (n_modes,), divided by measurement standard deviations.

        Return 0 for modes that are not used, and for all modes if there is no error model for frequencies.

        Parameters
        ----------
        frequencies, error : ndarray, shape (n_modes,), Hz
        theta : ndarray, shape (ndim,)
            Supplies the inferred standard deviations.
        """
        if self.frequency_term is None:
            return np.zeros(len(frequencies))
        seen = without_shapes(frequencies[None], np.diag(error)[None])
        slopes = self._residuals_and_slopes(seen, theta[None, self.n_structural :])[1]
        return np.asarray(np.linalg.norm(slopes[0], axis=0))

    def simulate(
        self, rng: np.random.Generator, frequencies: FloatArray, noise: FloatArray | None = None
    ) -> FloatArray:
        """Return frequencies (n, n_modes), Hz, with random errors from the first error model for frequencies.

        Raises
        ------
        ValueError
            If there is no error model for frequencies, or error parameters are inferred and `noise` is None.
        """
        if self.frequency_term is None:
            raise ValueError("error: must be a distribution of the frequencies to simulate them")
        return self.frequency_term.simulate(rng, frequencies, self._given_noise(frequencies, noise))

    def simulate_discrepancy(
        self, rng: np.random.Generator, frequencies: FloatArray, noise: FloatArray | None = None
    ) -> FloatArray:
        """Return frequencies (n, n_modes), Hz, plus only the random errors with inferred sds.

        Nothing is added if there is no error model for frequencies. Otherwise, raise ValueError if error
        parameters are inferred and `noise` (n, n_noise) is not given.
        """
        if self.frequency_term is None:
            return frequencies
        return self.frequency_term.simulate_inferred(rng, frequencies, self._given_noise(frequencies, noise))

    def quadratic(
        self, theta: FloatArray, chain: Chain | None = None
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the log-likelihood (n,), its gradient (n, ndim) and the information (n, ndim, ndim).

        The information on the model's parameters is JᵀJ, where J is the Jacobian of the residuals. The information
        on the inferred standard deviations is Fisher's.
        """
        seen = self._observed_slopes(theta, chain)
        r, J = self._all_residuals_and_slopes(seen, theta, chain)
        is_plain = not (self.noise or self.model.is_uncertain)
        if is_plain and all(term.is_least_squares for term in self.terms_of):
            value, gradient = self.terms_of_observed(seen, theta).sum(axis=1), -np.einsum("nr,nrk->nk", r, J)
        else:
            terms, slopes = self._terms_and_gradient(seen, theta, chain)
            value, gradient = terms.sum(axis=1), slopes.sum(axis=1)
        return value, gradient, self._information(J, theta)

    def why_not_finite(self, theta: FloatArray) -> str | None:
        """Return the reason why the log-likelihood is not finite at theta (ndim,), or None if it is finite."""
        found = why_no_frequencies(self.model, theta[: self.model.n_parameters])
        if found is not None:
            return found
        with np.errstate(all="ignore"):
            for name, terms in self._terms_by_error(theta[None]):
                bad = np.flatnonzero(~np.isfinite(terms[0]))
                if len(bad):
                    what = "has no value (NaN)" if np.isnan(terms[0, bad[0]]) else "overflows"
                    mode = bad[0] if self.used is None else self.used[bad[0]]
                    return f"the log-likelihood is not finite: {name} error of mode {mode + 1} {what}"
            for term in self.quantities:
                if not np.all(np.isfinite(term.terms(theta[None, : self.n_structural]))):
                    return f"the log-likelihood is not finite: {names_in_words(term.labels)} has no value"
        return None

    def as_dict(self) -> dict[str, Plain]:
        """Return the names and settings of the error models as a dict of plain Python types."""
        found = self._of_modes_as_dict()
        return found | ({"quantities": [term.as_dict() for term in self.quantities]} if self.quantities else {})

    def _of_modes_as_dict(self) -> dict[str, Plain]:
        if self.error is not None and self._is_of_beta:
            if self.error.covariance_hz2 is not None:
                return self.error.as_dict()
            return {"error": "frequency", "beta": self.error.beta.tolist()}
        return {"errors": [term.as_dict() for term in self.terms_of], "noise": [p.name for p in self.noise]}

    def _terms_by_error(self, theta: FloatArray) -> list[tuple[str, FloatArray]]:
        """Return each error model's name and its log-likelihood terms, (n, n_used), as a list of pairs."""
        parts = self._parts(self.observed(theta, False), theta, gradient=False)[1]
        described = self._of_modes_as_dict()
        dicts = [described] if "error" in described else [term.as_dict() for term in self.terms_of]
        names = [str(one["error"]) for one in dicts]
        return [(name, self.of_used(part.terms)) for name, part in zip(names, parts, strict=True)]

    def _given_noise(self, frequencies: FloatArray, noise: FloatArray | None) -> FloatArray:
        if noise is None and self.noise:
            raise ValueError("theta: must be given where standard deviations are inferred (got None)")
        return np.empty((len(frequencies), 0)) if noise is None else noise

    def observed(self, theta: FloatArray, gradient: bool = False) -> ModalPrediction:
        """Return the predicted modes, with derivatives if `gradient`, and shapes if errors or model need them."""
        structural = theta[:, : self.n_structural]
        if self.needs_shapes or self.model.is_uncertain:
            return self.model.observed(structural, gradient)
        if gradient:
            return without_shapes(*self.model.frequencies_and_gradient(structural))
        return without_shapes(self.model.frequencies(structural))

    def _parts(
        self, seen: ModalPrediction, theta: FloatArray, gradient: bool
    ) -> tuple[list[ModalPrediction], list[Evaluated]]:
        """Return the projected prediction and the evaluated terms of each error model, as two lists."""
        noise = theta[:, self.n_structural :]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            views = [term.project(seen) for term in self.terms_of]
            parts = [
                term.evaluate(view, noise, gradient)
                if view.frequency_variance is None
                else evaluated_with_variance(term, view, noise, gradient)
                for term, view in zip(self.terms_of, views, strict=True)
            ]
        return views, parts

    def _observed_slopes(self, theta: FloatArray, chain: Chain | None) -> ModalPrediction:
        """Return the modes and derivatives for the parameters of their test or, given a `chain`, of all tests."""
        seen = self.observed(theta, True)
        return seen if chain is None else chain_prediction(seen, chain, self.model.test_of_modes)

    def _terms_and_gradient(
        self, seen: ModalPrediction, theta: FloatArray, chain: Chain | None = None
    ) -> tuple[FloatArray, FloatArray]:
        views, parts = self._parts(seen, theta, gradient=True)
        with np.errstate(invalid="ignore", over="ignore"):
            pairs = zip(parts, views, strict=True)
            each = [gradient_of_terms(*pair, self.n_structural, len(self.noise)) for pair in pairs]
            slopes = nan_unless_finite(np.asarray(sum(each)))
        terms = self.of_used(np.asarray(sum(part.terms for part in parts)))
        return self._with_quantities_and_slopes(terms, self.of_used(slopes, 1), theta, chain)

    def _with_quantities(self, terms: FloatArray, theta: FloatArray) -> FloatArray:
        """Return the modes' log-likelihood terms (n, n_used) followed by the quantities' terms."""
        if not self.quantities:
            return terms
        structural = theta[:, : self.n_structural]
        return np.concatenate([terms, *(term.terms(structural) for term in self.quantities)], axis=1)

    @property
    def test_of_terms(self) -> IntArray:
        """Index of the test that each log-likelihood term belongs to, shape (n_terms,)."""
        of_quantities = [np.full(len(term.labels), term.test) for term in self.quantities]
        return np.concatenate([self.of_used(self.model.test_of_modes), *of_quantities])

    @property
    def test_of_residuals(self) -> IntArray:
        """Index of the test that each residual of `residuals_and_slopes` belongs to, shape (n_residuals,)."""
        modes = self.of_used(self.model.test_of_modes)
        found = [np.repeat(modes, len(term.labels([""]))) for term in self.terms_of]
        return np.concatenate([*found, *(np.full(len(term.labels), term.test) for term in self.quantities)])

    def _with_quantities_and_slopes(
        self, terms: FloatArray, slopes: FloatArray, theta: FloatArray, chain: Chain | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Return the log-likelihood terms of modes, then of quantities, and their gradients (n, n_terms, ndim)."""
        if not self.quantities:
            return terms, slopes
        parts = [slopes]
        for r, J in self._residuals_of_quantities(theta, chain):
            part = np.zeros((*r.shape, slopes.shape[-1]))
            part[..., : J.shape[-1]] = -r[..., None] * J
            parts.append(part)
        return self._with_quantities(terms, theta), np.concatenate(parts, axis=1)

    def _all_residuals_and_slopes(
        self, seen: ModalPrediction, theta: FloatArray, chain: Chain | None
    ) -> tuple[FloatArray, FloatArray]:
        """Return the residuals of modes and quantities, and their derivatives."""
        found = [self._residuals_and_slopes(seen, theta[:, self.n_structural :])]
        r, J = zip(*found, *self._residuals_of_quantities(theta, chain), strict=True)
        return np.concatenate(r, axis=1), np.concatenate(J, axis=1)

    def _residuals_of_quantities(
        self, theta: FloatArray, chain: Chain | None
    ) -> Iterator[tuple[FloatArray, FloatArray]]:
        """Yield the residuals (n, q) and their derivatives for each of `quantities`."""
        for term in self.quantities:
            r, J = term.residuals_and_slopes(theta[:, : self.n_structural])
            yield r, J if chain is None else chain(J, np.full(r.shape[1], term.test))

    def _residuals_and_slopes(self, seen: ModalPrediction, noise: FloatArray) -> tuple[FloatArray, FloatArray]:
        values, slopes = [], []
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            for term in self.terms_of:
                if term.needs_shapes and seen.shape_slopes is None:
                    continue
                r, J = (self.of_used(part, 1) for part in residuals_of_term(term, seen, noise))
                values.append(r.reshape(len(r), -1))
                slopes.append(J.reshape(*values[-1].shape, J.shape[-1]))
        return np.concatenate(values, axis=1), np.concatenate(slopes, axis=1)

    def _information(self, J: FloatArray, theta: FloatArray) -> FloatArray:
        n, s = J.shape[-1], theta[:, self.n_structural :]
        information = np.zeros((len(theta), n + s.shape[1], n + s.shape[1]))
        information[:, :n, :n] = np.einsum("nrk,nrl->nkl", J, J)
        if self.noise:
            with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
                information[:, n:, n:] = sum(term.information(s, self.used) for term in self.terms_of)
        return information
