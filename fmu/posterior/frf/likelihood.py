"""Likelihood of frequency response functions, alone or together with measured modes."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from typing import Any, NamedTuple, Self

import numpy as np

from fmu.fem.pairing.prediction import ModalPrediction
from fmu.posterior.errors.base import ErrorTerm, Likelihood
from fmu.posterior.errors.likelihood import ModalLikelihood
from fmu.posterior.frf.term import FRFTerm
from fmu.posterior.parameters import Parameter
from fmu.types import Chain, FloatArray, IntArray, Plain

_WIDER = (1.0, 0.3, 0.1, 0.03, 0.01)
"""Relative errors of the FRFs in the successive searches for maxima, before the search with the given errors."""
_WORTHWHILE = 0.5
"""Multiple of the relative noise of the data below which a wider error does not help."""
FRFS = "FRFs"
"""Label of the residuals of frequency response functions."""


class FRFsOfTest(NamedTuple):
    """The FRFs of one test, as functions of the parameters in all tests.

    Attributes
    ----------
    term : FRFTerm
    test : int
        Index of the test.
    structural : ndarray of int, shape (s,)
        Indices of the first s parameters in `term` among the structural parameters. The remaining parameters in
        `term` are inferred in addition to the structural ones.
    columns : ndarray of int, shape (n_own,)
        Index of each parameter in `term` in the likelihood's theta.
    slopes : ndarray of int, shape (n_own,)
        Position of each parameter in `term` in a list of the test's structural parameters followed by the other
        inferred parameters. Derivatives have this order.
    """

    term: FRFTerm
    test: int
    structural: IntArray
    columns: IntArray = np.empty(0, dtype=np.int64)
    slopes: IntArray = np.empty(0, dtype=np.int64)

    @property
    def further(self) -> tuple[Parameter, ...]:
        """Parameters in `term` that are inferred in addition to the structural ones."""
        return self.term.inferred[len(self.structural) - self.term.model.full.n_parameters :]

    def own(self, theta: FloatArray) -> FloatArray:
        """Select the parameters of `term`, (n, n_own), from the likelihood's theta (n, ndim)."""
        if len(self.columns) == theta.shape[1]:  # a single test with its parameters in theta's order
            return theta
        return theta.take(self.columns, axis=1)

    def by_structural(self, n: int, n_structural: int, chain: Chain | None) -> FloatArray:
        """Return the derivatives, (n, s, N), of the first s parameters of `term` with respect to N parameters.

        With a `chain`, these are the N problem parameters. Without it, they are the `n_structural` structural
        parameters in the test.
        """
        s = len(self.structural)
        found = np.zeros((n, s, n_structural))
        found[:, np.arange(s), self.structural] = 1.0
        return found if chain is None else chain(found, np.full(s, self.test))


class FRFLikelihood(Likelihood):
    """The sum of the modes' log-likelihood and the FRFs' log-densities.

    Parameters
    ----------
    modal : ModalLikelihood
        Likelihood of the modes; it uses no mode if the FRFs are the only data.
    every : sequence of FRFsOfTest
    n_structural : int
        Number of structural parameters in a test.
    n_tests : int

    Attributes
    ----------
    modal : ModalLikelihood
        Likelihood of the modes.
    model : ModalModel
        Model that computes the modes.
    every : tuple of FRFsOfTest
    responses : tuple of FRFTerm

    Notes
    -----
    In `noise`, and thus in theta, the parameters that are inferred only for the FRFs follow the inferred
    parameters of the errors in modes.
    """

    of_modes = True

    def __init__(
        self, modal: ModalLikelihood, every: Sequence[FRFsOfTest], n_structural: int, n_tests: int
    ) -> None:
        self.modal, self.n_structural = modal, n_structural
        noise = list(modal.noise)
        for one in every:
            noise += [p for p in one.further if p not in noise]
        self.noise = tuple(noise)
        placed = []
        for one in every:
            further = np.array([noise.index(p) for p in one.further], dtype=np.int64)
            columns, slopes = (
                np.concatenate([first + one.structural, n + further])
                for first, n in ((one.test * n_structural, n_tests * n_structural), (0, n_structural))
            )
            placed.append(one._replace(columns=columns, slopes=slopes))
        self.every = tuple(placed)
        self._n_modal = n_tests * n_structural + len(modal.noise)
        self._adopt()

    def _adopt(self) -> None:
        """Copy the attributes that describe the modes from the modal likelihood."""
        modal, self.responses = self.modal, tuple(one.term for one in self.every)
        self.model = modal.model
        self.needs_shapes, self.simulates, self.has_discrepancy, self.predictions_per_gradient = (
            modal.needs_shapes, modal.simulates, modal.has_discrepancy, modal.predictions_per_gradient,
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
    def _has_no_terms_of_modes(self) -> bool:
        """Whether the FRFs are the only data, so that the modes need not be computed."""
        return self.is_of_frfs_alone and not self.quantities

    @property
    def frequency_term(self) -> ErrorTerm | None:
        """The first error model for frequencies; None if there is none."""
        return self.modal.frequency_term

    @property
    def n_noise(self) -> int:
        """Number of inferred parameters of the errors in modes, which come first in `noise`."""
        return len(self.modal.noise)

    def using(self, used: IntArray | None) -> Self:
        """Return the likelihood of the FRFs and only the modes with indices `used`; None selects all modes."""
        return self._with(self.modal.using(used))

    def with_model(self, model: Any) -> Self:
        """Return the likelihood with another model to compute the modes."""
        return self._with(self.modal.with_model(model))

    def _with(self, modal: ModalLikelihood, every: Sequence[FRFsOfTest] | None = None) -> Self:
        other = copy(self)
        other.modal = modal
        if every is not None:
            other.every = tuple(every)
        other._adopt()
        return other

    def easier(self) -> list[Likelihood]:
        """Return likelihoods with the same parameters but fewer maxima. The easiest comes first.

        The first is the likelihood of all measured modes, including unused ones, without the FRFs' values. In the
        others the FRFs have an additional relative error, which decreases from one likelihood to the next but
        stays above half of the data's relative noise. If narrow measured and computed resonances do not overlap,
        the gradient does not lead one to the other; with large errors they overlap.
        """
        noise = min(term.relative_noise for term in self.responses)
        wider = [relative for relative in _WIDER if relative > _WORTHWHILE * noise]
        modes = self.modal.using(None)
        begin = [one._replace(term=one.term.without_lines()) for one in self.every if one.term.has_discrepancy]
        stages: list[Likelihood] = [self._with(modes, begin)]
        for relative in wider:
            stages.append(self._with(modes, [one._replace(term=one.term.widen(relative)) for one in self.every]))
        return stages

    def _of_modes(self, theta: FloatArray) -> FloatArray:
        return theta[:, : self._n_modal]

    def terms(self, theta: FloatArray) -> FloatArray:
        """Return the log-likelihood of each used mode, each quantity and each test's FRFs, (n, n_terms)."""
        return self._with_responses(self._modal_terms(theta), theta)

    def _modal_terms(self, theta: FloatArray) -> FloatArray:
        if self._has_no_terms_of_modes:
            return np.empty((len(theta), 0))
        return self.modal.terms(self._of_modes(theta))

    def _with_responses(self, terms: FloatArray, theta: FloatArray) -> FloatArray:
        found = [one.term.terms(one.own(theta))[:, None] for one in self.every]
        return np.concatenate([terms, *found], axis=1)

    def terms_and_gradient(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the `terms`, (n, n_terms), and their gradients, (n, n_terms, n_structural + n_inferred).

        There are n_inferred parameters in `noise`.
        """
        values, slopes = [], []
        N = self.n_structural + len(self.noise)
        if not self._has_no_terms_of_modes:
            terms, slope = self.modal.terms_and_gradient(self._of_modes(theta))
            whole = np.zeros((*terms.shape, N))
            whole[..., : slope.shape[-1]] = slope
            values, slopes = [terms], [whole]
        for one in self.every:
            value, gradient = one.term.terms_and_gradient(one.own(theta))
            values.append(value[:, None])
            slopes.append(np.zeros((len(theta), 1, N)))
            slopes[-1][:, 0, one.slopes] = gradient
        return np.concatenate(values, axis=1), np.concatenate(slopes, axis=1)

    def observed(self, theta: FloatArray, gradient: bool = False) -> ModalPrediction:
        """Return the predicted modes at theta (n, ndim), with shapes if needed and derivatives if `gradient`."""
        return self.modal.observed(self._of_modes(theta), gradient)

    def terms_of_frequencies(self, frequencies: FloatArray, theta: FloatArray) -> FloatArray:
        """Return the log-likelihood terms at theta, given the computed frequencies; see `Likelihood`."""
        return self._with_responses(self.modal.terms_of_frequencies(frequencies, self._of_modes(theta)), theta)

    def terms_and_misfit(
        self, theta: FloatArray, frequencies: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Return the used modes' log-likelihood terms and sums of squared normal scores; see `Likelihood`.

        Both arrays are empty if no mode is used.
        """
        if self.is_of_frfs_alone:
            return np.zeros((len(theta), 0)), np.zeros((len(theta), 0, 0))
        return self.modal.terms_and_misfit(self._of_modes(theta), frequencies)

    @property
    def by_frequencies(self) -> bool:
        """Whether the modes' log-likelihood needs only the computed frequencies; True if no mode is used."""
        return self.is_of_frfs_alone or self.modal.by_frequencies

    def quadratic(
        self, theta: FloatArray, chain: Chain | None = None
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the log-likelihood (n,), its gradient (n, ndim) and the information (n, ndim, ndim)."""
        n, P = len(theta), self.n_structural
        none = np.zeros((n, 0, P))
        N = (none if chain is None else chain(none, np.zeros(0, dtype=np.int64))).shape[-1]
        ndim = N + len(self.noise)
        value, gradient, information = np.zeros(n), np.zeros((n, ndim)), np.zeros((n, ndim, ndim))
        if not self._has_no_terms_of_modes:
            m = N + len(self.modal.noise)
            value, gradient[:, :m], information[:, :m, :m] = self.modal.quadratic(self._of_modes(theta), chain)
        for one in self.every:
            own, s = one.own(theta), len(one.structural)
            D = np.zeros((n, len(one.columns), ndim))  # the chain rule
            D[:, :s, :N] = one.by_structural(n, P, chain)
            D[:, np.arange(s, len(one.columns)), N - P + one.slopes[s:]] = 1.0
            Dt = np.swapaxes(D, 1, 2)
            term, slope = one.term.terms_and_gradient(own)
            value, gradient = value + term, gradient + (Dt @ slope[..., None])[..., 0]
            information += Dt @ one.term.information(own) @ D
        return value, gradient, information

    def residuals_and_slopes(self, theta: FloatArray, chain: Chain | None = None) -> tuple[FloatArray, FloatArray]:
        """Return residuals (n, n_residuals) and their derivatives (n, n_residuals, n_structural).

        A test's FRFs have one residual for each parameter in `FRFsOfTest.structural`. Let J be the square root of
        the information on these parameters when the other parameters of the FRFs have their best values. The
        residuals are −J⁻ᵀ times the gradient, and 0 in directions without information. Their derivatives are J.
        With a `chain`, the derivatives are with respect to the parameters of all tests.
        """
        values, slopes = [], []
        if not self._has_no_terms_of_modes:
            r, J = self.modal.residuals_and_slopes(self._of_modes(theta), chain)
            values, slopes = [r], [J]
        for one in self.every:
            own, s = one.own(theta), len(one.structural)
            gradient, information = one.term.terms_and_gradient(own)[1], one.term.information(own)
            found = [_whiten(*pair, s) for pair in zip(gradient, information, strict=True)]
            r, J = (np.stack(part) for part in zip(*found, strict=True))
            values.append(r)
            slopes.append(J @ one.by_structural(len(theta), self.n_structural, chain))
        return np.concatenate(values, axis=1), np.concatenate(slopes, axis=1)

    @property
    def test_of_terms(self) -> IntArray:
        """Index of the test that each log-likelihood term belongs to, shape (n_terms,)."""
        of_modes = np.zeros(0, dtype=np.int64) if self._has_no_terms_of_modes else self.modal.test_of_terms
        return np.concatenate([of_modes, np.array([one.test for one in self.every], dtype=np.int64)])

    @property
    def test_of_residuals(self) -> IntArray:
        """Index of the test that each residual of `residuals_and_slopes` belongs to, shape (n_residuals,)."""
        found = [] if self._has_no_terms_of_modes else [self.modal.test_of_residuals]
        return np.concatenate([*found, *(np.full(len(one.structural), one.test) for one in self.every)])

    def labels(self, modes: tuple[str, ...]) -> tuple[str, ...]:
        """Return the residuals' names in the order of `residuals_and_slopes`, given the names of the modes."""
        of_modes = () if self._has_no_terms_of_modes else self.modal.labels(modes)
        return of_modes + (FRFS,) * sum(len(one.structural) for one in self.every)

    def in_standard_deviations(self, frequencies: FloatArray, error: FloatArray, theta: FloatArray) -> FloatArray:
        """Return absolute errors in computed frequencies, (n_modes,), divided by sds; 0 if no mode is used."""
        if self.is_of_frfs_alone:
            return np.zeros(len(frequencies))
        return self.modal.in_standard_deviations(frequencies, error, theta[: self._n_modal])

    def simulate(
        self, rng: np.random.Generator, frequencies: FloatArray, noise: FloatArray | None = None
    ) -> FloatArray:
        """Return frequencies with simulated measurement errors added, (n, n_modes), in Hz."""
        return self.modal.simulate(rng, frequencies, noise)

    def simulate_discrepancy(
        self, rng: np.random.Generator, frequencies: FloatArray, noise: FloatArray | None = None
    ) -> FloatArray:
        """Return frequencies (n, n_modes), Hz, plus the random errors with inferred sds."""
        return self.modal.simulate_discrepancy(rng, frequencies, noise)

    def with_discrepancy(
        self, rng: np.random.Generator, frequencies: FloatArray, theta: FloatArray | None, given_data: bool = False
    ) -> FloatArray:
        """Return frequencies (n, n_modes), Hz, plus any random discrepancy in the modes; see `Likelihood`."""
        return self.modal.with_discrepancy(rng, frequencies, theta, given_data)

    def why_not_finite(self, theta: FloatArray) -> str | None:
        """Return the reason why the log-likelihood is not finite at theta (ndim,), or None if it is finite."""
        found = None if self._has_no_terms_of_modes else self.modal.why_not_finite(theta[: self._n_modal])
        for one in [] if found else self.every:
            if not np.isfinite(one.term.terms(one.own(theta[None]))[0]):
                return f"the log-likelihood is not finite: {one.term.of_test}the FRFs have no value"
        return found

    def as_dict(self) -> dict[str, Plain]:
        """Return the settings of the errors in modes and FRFs as a dict of plain Python types."""
        return self.modal.as_dict() | {
            "responses": [term.as_dict() for term in self.responses],
            "inferred": [p.name for p in self.noise[len(self.modal.noise) :]],
        }


def _whiten(gradient: FloatArray, information: FloatArray, n: int) -> tuple[FloatArray, FloatArray]:
    """Return n residuals and their derivatives (n, n) with respect to the first n parameters.

    The other parameters have their best values, so their uncertainty is accounted for.
    """
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
