"""Several kinds of errors at once, with standard deviations known or inferred: the likelihood in general."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fmu.fem.model import ModalModel
from fmu.fem.observed import Observed
from fmu.posterior.error_terms import Evaluated
from fmu.posterior.errors import ErrorModel
from fmu.posterior.measurement import ModalData
from fmu.posterior.parameters import Parameter

FloatArray = NDArray[np.float64]


class JointLikelihood:
    """The sum of the log-densities of error models of different kinds, independent of each other.

    Parameters
    ----------
    model : ModalModel
        Takes the leading parameters. With ``observed`` as `fmu.fem.structure.PairedStructure` has it, where errors
        are of shapes.
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
        if any(term.needs_shapes for term in self.terms_of) and not hasattr(model, "observed"):
            raise ValueError(
                f"error: errors of shapes need a model that gives shapes (got {type(model).__name__})"
            )

    @property
    def needs_shapes(self) -> bool:
        """Whether the errors are of shapes too."""
        return any(term.needs_shapes for term in self.terms_of)

    def terms(self, theta: FloatArray) -> FloatArray:
        """Return the log-likelihood of each mode, shape (n, n_modes), at theta (n, ndim)."""
        return self.terms_of_observed(self._observed(theta, False), theta)

    def terms_of_observed(self, seen: Observed, theta: FloatArray) -> FloatArray:
        """Return the log-likelihood of each mode, shape (n, n_modes), for what a model of one's own observes."""
        noise = theta[:, self.n_structural :]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            parts = [term.evaluate(seen, noise, gradient=False).terms for term in self.terms_of]
        return np.asarray(sum(parts))

    def terms_and_gradient(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the terms and their gradients, shape (n, n_modes, ndim)."""
        seen, noise = self._observed(theta, True), theta[:, self.n_structural :]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            parts = [term.evaluate(seen, noise, gradient=True) for term in self.terms_of]
            slopes = sum(self._chained(part, seen, theta.shape[1]) for part in parts)
        return np.asarray(sum(part.terms for part in parts)), np.asarray(slopes)

    def residuals_and_slopes(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return all errors over their standard deviations, and their slopes by the model's parameters.

        Shapes (n, n_residuals) and (n, n_residuals, n_structural): what Gauss–Newton steps and the linearised
        information of the data are made of. Inferred standard deviations are held.
        """
        seen, noise = self._observed(theta, True), theta[:, self.n_structural :]
        values, slopes = [], []
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            for term in self.terms_of:
                r = term.residuals(seen, noise)
                n, m, q = r.values.shape
                J = np.zeros((n, m, q, self.n_structural))
                if r.by_frequency is not None and seen.frequency_slopes is not None:
                    J = J + r.by_frequency[..., None] * seen.frequency_slopes[:, :, None]
                if r.by_shape is not None and seen.shape_slopes is not None:
                    J = J + np.einsum("nmqs,nsmk->nmqk", r.by_shape, seen.shape_slopes)
                values.append(r.values.reshape(n, m * q))
                slopes.append(J.reshape(n, m * q, -1))
        return np.concatenate(values, axis=1), np.concatenate(slopes, axis=1)

    def as_dict(self) -> dict[str, Any]:
        """Return names and settings."""
        return {"errors": [term.as_dict() for term in self.terms_of], "noise": [p.name for p in self.noise]}

    def _observed(self, theta: FloatArray, gradient: bool) -> Observed:
        structural = theta[:, : self.n_structural]
        if self.needs_shapes:
            observed: Observed = self.model.observed(structural, gradient)  # type: ignore[attr-defined]
            return observed
        nothing = np.empty((len(theta), 0, self.model.n_modes))
        if gradient:
            frequencies, slopes = self.model.frequencies_and_gradient(structural)
            return Observed(frequencies, nothing, slopes)
        return Observed(self.model.frequencies(structural), nothing)

    def _chained(self, part: Evaluated, seen: Observed, ndim: int) -> FloatArray:
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
