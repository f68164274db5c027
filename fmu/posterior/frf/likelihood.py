"""The likelihood of frequency response functions, alone or together with measured modes."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from typing import Any, Self

import numpy as np

from fmu.fem.pairing.prediction import ModalPrediction
from fmu.posterior.errors.base import Chain, ErrorTerm, Likelihood
from fmu.posterior.frf.term import FRFTerm
from fmu.posterior.parameters import Parameter
from fmu.types import FloatArray, IntArray, Plain

_WIDER = (1.0, 0.3, 0.1, 0.03, 0.01)
"""Relative errors of the FRFs in the successive searches for maxima, before the search with the errors given."""
_WORTHWHILE = 0.5
"""Multiple of the relative noise of the data below which a wider error does not help."""
FRFS = "FRFs"
"""Label of the residuals of frequency response functions."""


class FRFLikelihood(Likelihood):
    """The sum of the log-likelihood of the modes and of the log-densities of FRFs.

    Parameters
    ----------
    of_modes : Likelihood
        The likelihood of the modes; of no mode where the FRFs are the only data.
    responses : sequence of FRFTerm
    n_structural : int
        Number of parameters of the structure.

    Attributes
    ----------
    modal : Likelihood
        The likelihood of the modes.
    responses : tuple of FRFTerm

    Notes
    -----
    The parameters that are inferred for the FRFs follow those of the errors of modes. What is not said here is as
    in the likelihood of the modes.
    """

    of_modes = True

    def __init__(self, modal: Likelihood, responses: Sequence[FRFTerm], n_structural: int) -> None:
        self.modal, self.responses, self.n_structural = modal, tuple(responses), n_structural
        inferred: list[Parameter] = []
        for term in self.responses:
            inferred += term.inferred
        self.noise = (*modal.noise, *inferred)
        self._n_modal = n_structural + len(modal.noise)
        self._adopt()

    def _adopt(self) -> None:
        """Take over what the likelihood of the modes says of the modes."""
        modal = self.modal
        self.needs_shapes, self.simulates, self.has_discrepancy = (
            modal.needs_shapes, modal.simulates, modal.has_discrepancy,
        )  # fmt: skip
        self.terms_of, self.chi_square, self.quantities = modal.terms_of, modal.chi_square, modal.quantities
        self.correlated, self.used = modal.correlated, modal.used
        self.terms_name = "modes"
        if self.is_of_frfs_alone:
            self.terms_of = self.chi_square = ()

    @property
    def is_of_frfs_alone(self) -> bool:
        """Whether no measured mode is used."""
        return self.modal.used is not None and len(self.modal.used) == 0

    @property
    def frequency_term(self) -> ErrorTerm | None:
        """The first error model of frequencies; None if there is no such error model."""
        return self.modal.frequency_term

    @property
    def n_noise(self) -> int:
        """Number of inferred standard deviations of errors of modes, the first of `noise`."""
        return len(self.modal.noise)

    def using(self, used: IntArray | None) -> Self:
        """Return the likelihood of the modes with the indices `used`, and of the same FRFs; None for all modes."""
        return self._with(self.modal.using(used))

    def with_model(self, model: Any) -> Self:
        """Return the likelihood with another model of the modes."""
        return self._with(self.modal.with_model(model))

    def _with(self, modal: Likelihood, responses: Sequence[FRFTerm] | None = None) -> Self:
        other = copy(self)
        other.modal = modal
        if responses is not None:
            other.responses = tuple(responses)
        other._adopt()
        return other

    def easier(self) -> list[Likelihood]:
        """Return likelihoods of the same parameters with fewer maxima, the easiest first.

        The first is of all modes alone. In the others the FRFs have a further relative error, which decreases.
        Narrow resonances that do not overlap tell nothing of the way to each other; wide errors let them overlap.
        """
        noise = min(term.relative_noise for term in self.responses)
        wider = [relative for relative in _WIDER if relative > _WORTHWHILE * noise]
        every = self.modal.using(None)
        stages: list[Likelihood] = [self._with(every, ())]
        for relative in wider:
            stages.append(self._with(every, [term.widen(relative) for term in self.responses]))
        return stages

    def _of_modes(self, theta: FloatArray) -> FloatArray:
        return theta[:, : self._n_modal]

    def terms(self, theta: FloatArray) -> FloatArray:
        """Return the log-likelihood of each used mode, and of the FRFs of each test, (n, n_terms)."""
        return self._with_responses(self._modal_terms(theta), theta)

    def _modal_terms(self, theta: FloatArray) -> FloatArray:
        if self.is_of_frfs_alone:
            return np.empty((len(theta), 0))
        return self.modal.terms(self._of_modes(theta))

    def _with_responses(self, terms: FloatArray, theta: FloatArray) -> FloatArray:
        return np.concatenate([terms, *(term.terms(theta)[:, None] for term in self.responses)], axis=1)

    def terms_and_gradient(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the terms and their gradients, shape (n, n_terms, ndim)."""
        values, slopes = [], []
        if not self.is_of_frfs_alone:
            terms, slope = self.modal.terms_and_gradient(self._of_modes(theta))
            whole = np.zeros((*terms.shape, theta.shape[1]))
            whole[..., : slope.shape[-1]] = slope
            values, slopes = [terms], [whole]
        for term in self.responses:
            value, gradient = term.terms_and_gradient(theta)
            values.append(value[:, None])
            slopes.append(gradient[:, None])
        return np.concatenate(values, axis=1), np.concatenate(slopes, axis=1)

    def observed(self, theta: FloatArray, gradient: bool = False) -> ModalPrediction:
        """Return the predicted modes at theta (n, ndim) that the error models need."""
        return self.modal.observed(self._of_modes(theta), gradient)

    def terms_of_frequencies(self, frequencies: FloatArray, theta: FloatArray) -> FloatArray:
        """Return the terms at theta, given the frequencies of the model there; see `Likelihood`."""
        return self._with_responses(self.modal.terms_of_frequencies(frequencies, self._of_modes(theta)), theta)

    def terms_and_misfit(
        self, theta: FloatArray, frequencies: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Return the terms and the squared residuals of the modes; see `Likelihood`."""
        if self.is_of_frfs_alone:
            return np.zeros((len(theta), 0)), np.zeros((len(theta), 0, 0))
        return self.modal.terms_and_misfit(self._of_modes(theta), frequencies)

    @property
    def by_frequencies(self) -> bool:
        """Whether the frequencies of the model are enough for the terms of the modes."""
        return self.is_of_frfs_alone or self.modal.by_frequencies

    def quadratic(
        self, theta: FloatArray, chain: Chain | None = None
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the log-likelihood (n,), its gradient (n, ndim) and the information (n, ndim, ndim)."""
        n, ndim = theta.shape
        value, gradient, information = np.zeros(n), np.zeros((n, ndim)), np.zeros((n, ndim, ndim))
        if not self.is_of_frfs_alone:
            m = self._n_modal
            value, gradient[:, :m], information[:, :m, :m] = self.modal.quadratic(self._of_modes(theta), chain)
        for term in self.responses:
            one, slope = term.terms_and_gradient(theta)
            value, gradient, information = value + one, gradient + slope, information + term.information(theta)
        return value, gradient, information

    def residuals_and_slopes(self, theta: FloatArray, chain: Chain | None = None) -> tuple[FloatArray, FloatArray]:
        """Return residuals (n, n_residuals) and their derivatives (n, n_residuals, n_structural).

        The FRFs have as many residuals as the structure has parameters: with J the square root of their
        information on these parameters, given the best values of all others, the residuals are −J⁻ᵀ times the
        gradient.
        """
        values, slopes = [], []
        if not self.is_of_frfs_alone:
            r, J = self.modal.residuals_and_slopes(self._of_modes(theta), chain)
            values, slopes = [r], [J]
        for term in self.responses:
            gradient, information = term.terms_and_gradient(theta)[1], term.information(theta)
            found = [_whiten(*pair, self.n_structural) for pair in zip(gradient, information, strict=True)]
            r, J = (np.stack(part) for part in zip(*found, strict=True))
            values.append(r)
            slopes.append(J)
        return np.concatenate(values, axis=1), np.concatenate(slopes, axis=1)

    @property
    def test_of_terms(self) -> IntArray:
        """Index of the test that each term belongs to, shape (n_terms,)."""
        of_modes = np.zeros(0, dtype=np.int64) if self.is_of_frfs_alone else self.modal.test_of_terms
        return np.concatenate([of_modes, np.zeros(len(self.responses), dtype=np.int64)])

    def labels(self, modes: tuple[str, ...]) -> tuple[str, ...]:
        """Return the names of the residuals, in the order of `residuals_and_slopes`, given the labels of modes."""
        of_modes = () if self.is_of_frfs_alone else self.modal.labels(modes)
        return of_modes + (FRFS,) * (self.n_structural * len(self.responses))

    def in_standard_deviations(self, frequencies: FloatArray, error: FloatArray, theta: FloatArray) -> FloatArray:
        """Return errors of computed frequencies, (n_modes,) in Hz, in standard deviations of their measurement."""
        if self.is_of_frfs_alone:
            return np.zeros(len(frequencies))
        return self.modal.in_standard_deviations(frequencies, error, theta[: self._n_modal])

    def simulate(
        self, rng: np.random.Generator, frequencies: FloatArray, noise: FloatArray | None = None
    ) -> FloatArray:
        """Return frequencies (n, n_modes), Hz, with measurement errors added."""
        return self.modal.simulate(rng, frequencies, noise)

    def simulate_discrepancy(
        self, rng: np.random.Generator, frequencies: FloatArray, noise: FloatArray | None = None
    ) -> FloatArray:
        """Return frequencies (n, n_modes), Hz, with only the inferred errors (of the model) added."""
        return self.modal.simulate_discrepancy(rng, frequencies, noise)

    def with_discrepancy(
        self, rng: np.random.Generator, frequencies: FloatArray, theta: FloatArray | None, given_data: bool = False
    ) -> FloatArray:
        """Return frequencies with the model's errors at theta added, if it has any: anew, or given the data."""
        return self.modal.with_discrepancy(rng, frequencies, theta, given_data)

    def why_not_finite(self, theta: FloatArray) -> str | None:
        """Return the reason why the terms are not finite at theta, shape (ndim,); None if they are finite."""
        found = None if self.is_of_frfs_alone else self.modal.why_not_finite(theta[: self._n_modal])
        if found is None and not all(np.isfinite(term.terms(theta[None])[0]) for term in self.responses):
            found = "the log-likelihood is not finite: the FRFs have no value"
        return found

    def as_dict(self) -> dict[str, Plain]:
        """Return a dict of names and settings in plain Python types."""
        return self.modal.as_dict() | {
            "responses": [term.as_dict() for term in self.responses],
            "inferred": [p.name for term in self.responses for p in term.inferred],
        }


def _whiten(gradient: FloatArray, information: FloatArray, n: int) -> tuple[FloatArray, FloatArray]:
    """Return n residuals and their derivatives by n parameters, given the best values of the other parameters."""
    other = information[n:, n:]
    if len(other):
        gain = np.linalg.lstsq(other, information[n:, :n], rcond=None)[0]
        gradient, information = (
            gradient[:n] - gain.T @ gradient[n:],
            information[:n, :n] - information[:n, n:] @ gain,
        )
    scale = np.sqrt(np.maximum(np.diag(information), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    root = np.sqrt(np.maximum(values, 0.0))
    J = root[:, None] * vectors.T * scale
    with np.errstate(divide="ignore", invalid="ignore"):
        r = np.where(root > 1e-7, -(vectors.T @ (gradient / scale)) / root, 0.0)
    return r, J
