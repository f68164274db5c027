"""The likelihood of a model whose frequencies have errors of their own, with variances that depend on theta."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fmu.arguments import ArgumentError
from fmu.fem.pairing.modal_model import ModalModel
from fmu.fem.pairing.prediction import ModalPrediction
from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.discrepancy.embedded import Discrepancy
from fmu.posterior.errors.base import LOG_2PI, Chain, ErrorModel, ErrorTerm, Evaluated
from fmu.posterior.errors.frequency import FrequencyTerm
from fmu.posterior.errors.likelihood import ModalLikelihood
from fmu.posterior.errors.noise import numbering
from fmu.posterior.errors.quantities import QuantityTerm
from fmu.posterior.errors.slopes import without_shapes
from fmu.posterior.errors.surrogate_variance import evaluated_with_variance, residuals_with_variance
from fmu.posterior.parameters import Parameter
from fmu.types import FloatArray, Plain


class DiscrepantLikelihood(ModalLikelihood):
    """A `ModalLikelihood` in which the variances of a `Discrepancy` are added to those of the frequency errors.

    The density is exact for Gaussian errors of given variances, their determinant included. Errors of shapes are
    as without a discrepancy.

    Parameters
    ----------
    model, data, errors, quantities
        As in `ModalLikelihood`.
    discrepancies : sequence of Discrepancy
    parameters : sequence of Parameter
        Parameters of the model.

    Raises
    ------
    ValueError
        In the cases listed for `ModalLikelihood`, if no error model is of frequencies, their errors are correlated
        or not Gaussian, or a discrepancy does not fit the parameters.
    """

    def __init__(
        self,
        model: ModalModel,
        data: ModalData,
        errors: Sequence[ErrorModel],
        quantities: Sequence[QuantityTerm],
        discrepancies: Sequence[Discrepancy],
        parameters: Sequence[Parameter],
    ) -> None:
        super().__init__(model, data, errors, quantities)
        if self.frequency_term is None:
            raise ArgumentError("discrepancy", "needs errors of frequencies, as fmu.FrequencyErrors", "none")
        for term in self.terms_of:
            if type(term) is not FrequencyTerm and (term.of_frequencies or not term.needs_shapes):
                rule = "needs Gaussian errors of the frequencies that are independent from mode to mode"
                raise ArgumentError("discrepancy", rule, str(term.as_dict()["error"]))
            if term.tests is not None:
                term.tests = None  # the scatter of tests no longer gives all of the variance
        noise = list(self.noise)
        names = [one.name for one in discrepancies if one.tau is None]
        if len(set(names)) < len(names):
            raise ArgumentError("discrepancy.name", "must be different for each discrepancy", names[-1])
        self.scatters = tuple(one.bind(parameters, numbering(noise)) for one in discrepancies)
        self.noise = tuple(noise)
        self.error, self.beta, self._fast, self.terms_name = None, None, None, "modes"

    has_discrepancy = True

    @property
    def by_frequencies(self) -> bool:
        """Whether the frequencies of the model are enough for the terms: the variances need their gradients."""
        return False

    def observed(self, theta: FloatArray, gradient: bool = False) -> ModalPrediction:
        """Return the predicted modes with the variances of the discrepancy; see `ModalLikelihood`."""
        structural, noise = theta[:, : self.n_structural], theta[:, self.n_structural :]
        steps = self.scatters[0].steps(structural)
        exact = self.model.sensitivities(structural, steps) if gradient else None
        if self.needs_shapes or self.model.is_uncertain:
            seen = self.model.observed(structural, True)
        elif exact is not None:
            seen = without_shapes(exact.frequencies, exact.gradient)
        else:
            seen = without_shapes(*self.model.frequencies_and_gradient(structural))
        curvature = None if exact is None else exact.curvature
        J = np.asarray(seen.frequency_slopes)
        with np.errstate(invalid="ignore", over="ignore"):
            found = [one.variance(structural, noise, J, curvature) for one in self.scatters]
        value, by_noise = sum(v.value for v in found), np.asarray(sum(v.by_noise for v in found))
        slopes = np.asarray(sum(v.by_theta for v in found)) if gradient else None  # type: ignore[misc]
        if seen.frequency_variance is not None:
            value = value + seen.frequency_variance
        if slopes is not None and seen.frequency_variance_slopes is not None:
            slopes = slopes + seen.frequency_variance_slopes
        return replace(
            seen,
            frequency_variance=np.asarray(value),
            frequency_variance_slopes=slopes,
            frequency_variance_by_noise=by_noise,
        )

    def variance(self, theta: FloatArray) -> FloatArray:
        """Return the variances of the model's own errors at theta (n, ndim), shape (n, n_modes), Hz²."""
        return np.asarray(self.observed(theta).frequency_variance)

    def with_discrepancy(
        self, rng: np.random.Generator, frequencies: FloatArray, theta: FloatArray | None
    ) -> FloatArray:
        """Return computed frequencies with the model's own errors added; see `Likelihood`."""
        if theta is None:
            raise ValueError("theta: must be given where the model has a discrepancy (got None)")
        sd = np.sqrt(self.variance(theta))
        return np.asarray(frequencies + sd * rng.standard_normal(frequencies.shape))

    def misfit(self, seen: ModalPrediction, theta: FloatArray) -> FloatArray:
        """Return the sums of squared residuals, in standard deviations that include the model's own errors."""
        noise, found = theta[:, self.n_structural :], np.empty((len(theta), 0, seen.frequencies.shape[1]))
        for term in self.chi_square:
            view = term.project(seen)
            r = residuals_with_variance(term.residuals(view, noise), view).values
            found = np.concatenate([found, np.sum(r**2, axis=2)[:, None]], axis=1)
        return self.of_used(found)

    def quadratic(
        self, theta: FloatArray, chain: Chain | None = None
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the log-likelihood, its gradient and the information; see `ModalLikelihood`.

        The information is Fisher's: JᵀJ of the residuals, and ½ WᵀW with W_i = (∂V_i/∂θ, ∂V_i/∂τ, …)/V_i.
        """
        seen = self._observed_slopes(theta, chain)
        J = self._all_residuals_and_slopes(seen, theta, chain)[1]
        terms, slopes = self._terms_and_gradient(seen, theta, chain)
        n, noise = J.shape[-1], theta[:, self.n_structural :]
        information = np.zeros((len(theta), slopes.shape[-1], slopes.shape[-1]))
        information[:, :n, :n] = np.einsum("nrk,nrl->nkl", J, J)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            for term in self.terms_of:
                if isinstance(term, FrequencyTerm):
                    W = self.of_used(_relative_slopes(term, seen, noise), 1)
                    information += 0.5 * np.einsum("nmk,nml->nkl", W, W)
                elif self.noise:
                    information[:, n:, n:] += term.information(noise, self.used)
        return terms.sum(axis=1), slopes.sum(axis=1), information

    def as_dict(self) -> dict[str, Plain]:
        """Return a dict of names and settings in plain Python types."""
        return super().as_dict() | {"discrepancy": [one.as_dict() for one in self.scatters]}

    def _parts(
        self, seen: ModalPrediction, theta: FloatArray, gradient: bool
    ) -> tuple[list[ModalPrediction], list[Evaluated]]:
        noise = theta[:, self.n_structural :]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            return [seen] * len(self.terms_of), [_evaluate(term, seen, noise, gradient) for term in self.terms_of]


def _evaluate(term: ErrorTerm, seen: ModalPrediction, noise: FloatArray, gradient: bool) -> Evaluated:
    """Return the terms of an error model, with the model's own errors in the variances; see `ErrorTerm`."""
    if not isinstance(term, FrequencyTerm):
        if seen.shape_variance is None:
            return term.evaluate(seen, noise, gradient)
        return evaluated_with_variance(term, seen, noise, gradient)
    error, slope = term.errors(seen.frequencies)
    V = _total_variance(term, seen, noise)
    terms = -0.5 * (error**2 / V + np.log(V) + LOG_2PI)
    if not gradient:
        return Evaluated(terms)
    by_V = 0.5 * (error**2 / V - 1.0) / V
    by_noise = {k: by_V * dV for k, dV in term.spread.slopes(noise).items()}
    added = by_V * slope**2
    for k in range(noise.shape[1]):
        by_noise[k] = by_noise.get(k, 0.0) + added * np.asarray(seen.frequency_variance_by_noise)[..., k]
    by_frequency = -error / V * slope + by_V * _curvature(term, seen)
    return Evaluated(terms, by_frequency, None, by_noise, added)


def _total_variance(term: FrequencyTerm, seen: ModalPrediction, noise: FloatArray) -> FloatArray:
    """Return the variances of ε, (n, n_modes): of the measurement, and of the model's own errors."""
    slope = term.errors(seen.frequencies)[1]
    return np.asarray(term.spread.variance(noise) + slope**2 * np.asarray(seen.frequency_variance))


def _curvature(term: FrequencyTerm, seen: ModalPrediction) -> FloatArray:
    """Return the derivative of (∂ε/∂f)² v by f, (n, n_modes): of eigenvalues, ε = (f/f^m)² − 1, it is not 0."""
    if term.kind != "eigenvalue":
        return np.zeros_like(seen.frequencies)
    slope = term.errors(seen.frequencies)[1]
    return np.asarray(4.0 * slope / term.measured**2 * np.asarray(seen.frequency_variance))


def _relative_slopes(term: FrequencyTerm, seen: ModalPrediction, noise: FloatArray) -> FloatArray:
    """Return W = ∂V/∂(parameters, noise) / V, shape (n, n_modes, p + n_noise)."""
    slope = np.broadcast_to(term.errors(seen.frequencies)[1], seen.frequencies.shape)[..., None]
    J, by_theta = np.asarray(seen.frequency_slopes), np.asarray(seen.frequency_variance_slopes)
    by_noise = slope**2 * np.asarray(seen.frequency_variance_by_noise)
    for k, dV in term.spread.slopes(noise).items():
        by_noise[..., k] += dV
    of_theta = slope**2 * by_theta + _curvature(term, seen)[..., None] * J
    total = _total_variance(term, seen, noise)[..., None]
    return np.concatenate([of_theta, by_noise], axis=2) / total
