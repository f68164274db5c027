"""Several kinds of errors at once, with standard deviations known or inferred: the likelihood in general."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np

from fmu.fem.pairing.paired_model import ModalModel
from fmu.fem.pairing.prediction import ModalPrediction
from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.errors.models import ErrorModel
from fmu.posterior.errors.terms import Evaluated, FrequencyTerm
from fmu.posterior.parameters import Parameter
from fmu.types import FloatArray


class JointLikelihood:
    """The sum of the log-densities of error models of different kinds, independent of each other.

    Parameters
    ----------
    model : ModalModel
        Takes the leading parameters. With ``observed`` as `fmu.fem.pairing.paired_model.PairedStructure` has it,
        where errors are of shapes.
    data : ModalData
    errors : sequence of ErrorModel

    Attributes
    ----------
    noise : tuple of Parameter
        The standard deviations to be inferred, the last parameters of the problem; one that several error models
        name is one parameter.

    Raises
    ------
    ValueError
        If there is no error model, one does not fit the data, the model cannot say what sensors see, or different
        parameters share a name.
    """

    of_modes: ClassVar[bool] = True
    error: ClassVar[None] = None
    terms_name: ClassVar[str] = "modes"

    def __init__(self, model: ModalModel, data: ModalData, errors: Sequence[ErrorModel]) -> None:
        if not errors:
            raise ValueError("error: at least one error model is needed (got none)")
        self.model, self.n_structural = model, model.n_parameters
        noise: list[Parameter] = []

        def index(parameter: Parameter) -> int:
            if parameter not in noise:
                if parameter.name in (p.name for p in noise):
                    raise ValueError(f"error: different parameters must not share a name (got {parameter.name!r})")
                noise.append(parameter)
            return noise.index(parameter)

        self.terms_of = tuple(error.bind(data, index) for error in errors)
        self.noise = tuple(noise)
        sees = hasattr(model, "observed") and getattr(model, "gives_shapes", True)
        if any(term.needs_shapes for term in self.terms_of) and not sees:
            raise ValueError(f"error: errors of shapes need a model that gives shapes (got {model.name})")

    @property
    def needs_shapes(self) -> bool:
        """Whether the errors are of shapes too."""
        return any(term.needs_shapes for term in self.terms_of)

    def terms(self, theta: FloatArray) -> FloatArray:
        """Return the log-likelihood of each mode, shape (n, n_modes), at theta (n, ndim)."""
        return self.terms_of_observed(self._observed(theta, False), theta)

    def terms_of_observed(self, seen: ModalPrediction, theta: FloatArray) -> FloatArray:
        """Return the log-likelihood of each mode, shape (n, n_modes), for what a model of one's own observes."""
        return np.asarray(sum(self._parts(seen, theta)))

    def terms_by_error(self, theta: FloatArray) -> list[tuple[str, FloatArray]]:
        """Return what each error model contributes to `terms`, (n, n_modes), beside its name."""
        parts = self._parts(self._observed(theta, False), theta)
        return [(str(term.as_dict()["error"]), part) for term, part in zip(self.terms_of, parts, strict=True)]

    def terms_and_gradient(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the terms and their gradients, shape (n, n_modes, ndim)."""
        return self._terms_and_gradient(self._observed(theta, True), theta)

    def residuals_and_slopes(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return all errors over their standard deviations, and their slopes by the model's parameters.

        Shapes (n, n_residuals) and (n, n_residuals, n_structural): what Gauss–Newton steps and the linearised
        information of the data are made of. Inferred standard deviations are held.
        """
        return self._residuals_and_slopes(self._observed(theta, True), theta)

    @property
    def simulates(self) -> bool:
        """Whether frequencies are among what has errors, so that a new measurement of them can be simulated."""
        return any(isinstance(term, FrequencyTerm) for term in self.terms_of)

    def simulate(
        self, rng: np.random.Generator, frequencies: FloatArray, theta: FloatArray | None = None
    ) -> FloatArray:
        """Return frequencies (n, n_modes) with the errors of the first model of them added, Hz.

        Raises
        ------
        ValueError
            If standard deviations are inferred and `theta` (n, ndim) is not given.
        """
        return self._simulated(self._frequency_term, rng, frequencies, theta)

    def simulate_discrepancy(
        self, rng: np.random.Generator, frequencies: FloatArray, theta: FloatArray | None = None
    ) -> FloatArray:
        """Return frequencies (n, n_modes), Hz, with the inferred errors alone: what the model leaves out.

        Raises
        ------
        ValueError
            As `simulate` does.
        """
        term = self._frequency_term
        inferred = replace(term, spread=replace(term.spread, fixed=np.zeros_like(term.spread.fixed)))
        return self._simulated(inferred, rng, frequencies, theta)

    @property
    def _frequency_term(self) -> FrequencyTerm:
        return next(term for term in self.terms_of if isinstance(term, FrequencyTerm))

    def _simulated(
        self, term: FrequencyTerm, rng: np.random.Generator, frequencies: FloatArray, theta: FloatArray | None
    ) -> FloatArray:
        if theta is None and self.noise:
            raise ValueError("theta: must be given where standard deviations are inferred (got None)")
        noise = np.empty((len(frequencies), 0)) if theta is None else theta[:, self.n_structural :]
        return term.simulate(rng, frequencies, noise)

    def sensitivity(self, theta: FloatArray) -> FloatArray:
        """Return the slopes of the errors over their standard deviations, shape (n, n_residuals, n_structural)."""
        return self.residuals_and_slopes(theta)[1]

    def labels(self, modes: tuple[str, ...]) -> tuple[str, ...]:
        """Name the rows of `sensitivity`."""
        return tuple(label for term in self.terms_of for label in term.labels(modes))

    def full_terms(self, theta: FloatArray) -> FloatArray:
        """Return `terms` by the full model, where a reduced one answers otherwise."""
        return self.terms_of_observed(self.model.full_observed(theta[:, : self.n_structural]), theta)

    def quadratic(self, theta: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the log-likelihood (n,), its gradient (n, ndim) and the information (n, ndim, ndim).

        JᵀJ of the residuals for the model's parameters, Fisher's information for the standard deviations.
        """
        seen = self._observed(theta, True)
        terms, gradient = self._terms_and_gradient(seen, theta)
        J = self._residuals_and_slopes(seen, theta)[1]
        return terms.sum(axis=1), gradient.sum(axis=1), self._information(J, theta)

    def _information(self, J: FloatArray, theta: FloatArray) -> FloatArray:
        n, s = self.n_structural, theta[:, self.n_structural :]
        information = np.zeros((len(theta), theta.shape[1], theta.shape[1]))
        information[:, :n, :n] = np.einsum("nrk,nrl->nkl", J, J)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            information[:, n:, n:] = sum(term.information(s) for term in self.terms_of)
        return information

    def as_dict(self) -> dict[str, Any]:
        """Return names and settings."""
        return {"errors": [term.as_dict() for term in self.terms_of], "noise": [p.name for p in self.noise]}

    def _parts(self, seen: ModalPrediction, theta: FloatArray) -> list[FloatArray]:
        noise = theta[:, self.n_structural :]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            return [term.evaluate(term.project(seen), noise, gradient=False).terms for term in self.terms_of]

    def _observed(self, theta: FloatArray, gradient: bool) -> ModalPrediction:
        structural = theta[:, : self.n_structural]
        if self.needs_shapes:
            observed: ModalPrediction = self.model.observed(structural, gradient)
            return observed
        nothing = np.empty((len(theta), 0, self.model.n_modes))
        if gradient:
            frequencies, slopes = self.model.frequencies_and_gradient(structural)
            return ModalPrediction(frequencies, nothing, slopes)
        return ModalPrediction(self.model.frequencies(structural), nothing)

    def _terms_and_gradient(self, seen: ModalPrediction, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        noise = theta[:, self.n_structural :]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            views = [term.project(seen) for term in self.terms_of]
            parts = [
                term.evaluate(of, noise, gradient=True) for term, of in zip(self.terms_of, views, strict=True)
            ]
            chained = (self._chained(part, of, theta.shape[1]) for part, of in zip(parts, views, strict=True))
            slopes = np.asarray(sum(chained))
        return np.asarray(sum(part.terms for part in parts)), np.where(np.isfinite(slopes), slopes, np.nan)

    def _residuals_and_slopes(self, seen: ModalPrediction, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        noise = theta[:, self.n_structural :]
        values, slopes = [], []
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            for term in self.terms_of:
                of = term.project(seen)
                r = term.residuals(of, noise)
                n, m, q = r.values.shape
                J = np.zeros((n, m, q, self.n_structural))
                if r.by_frequency is not None and of.frequency_slopes is not None:
                    J = J + r.by_frequency[..., None] * of.frequency_slopes[:, :, None]
                if r.by_shape is not None and of.shape_slopes is not None:
                    J = J + np.einsum("nmqs,nsmk->nmqk", r.by_shape, of.shape_slopes)
                values.append(r.values.reshape(n, m * q))
                slopes.append(J.reshape(n, m * q, -1))
        return np.concatenate(values, axis=1), np.concatenate(slopes, axis=1)

    def _chained(self, part: Evaluated, seen: ModalPrediction, ndim: int) -> FloatArray:
        """Return the gradient of an error model's terms by all parameters, shape (n, n_modes, ndim)."""
        gradient = np.zeros((*part.terms.shape, ndim))
        leading = gradient[..., : self.n_structural]
        if part.by_frequency is not None and seen.frequency_slopes is not None:
            leading += part.by_frequency[..., None] * seen.frequency_slopes
        if part.by_shape is not None and seen.shape_slopes is not None:
            # a sum in one order, whatever the batch
            leading += np.einsum("nsm,nsmk->nmk", part.by_shape, seen.shape_slopes)
        for k, slope in (part.by_noise or {}).items():
            gradient[..., self.n_structural + k] += slope
        return gradient
