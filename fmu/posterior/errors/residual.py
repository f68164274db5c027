"""The likelihood of the modal residual, eq. (2) of Boulkaibet et al. (`fmu.paper.published`)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike, NDArray

from fmu.arguments import ArgumentError, first_repeated
from fmu.fem.condensation import SingularCondensationError, StaticCondensation
from fmu.fem.modes.separable import SeparableModel
from fmu.fem.modes.terms import ParametricMatrix, Term
from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.errors.base import Likelihood
from fmu.posterior.errors.noise import checked_beta
from fmu.types import FloatArray, Plain


class ModalResidual(Likelihood):
    """Likelihood of the measured modes' residual in the condensed equations of motion, eq. (2) of the paper.

    The residual of mode i is ε_i = (K_c − ω_i² M_c) φ_i / ‖K_c(θ_ref) φ_i‖. Here ω_i and φ_i are measured, and K_c
    and M_c are condensed onto the sensors by Guyan reduction (eq. 2 and the text below it). The log-likelihood of
    mode i is −β_i ‖ε_i‖² + (F/2) log(β_i/π) with F sensors (eqs. 4 and 5).

    Parameters
    ----------
    model : SeparableModel
    data : ModalData
        Must have shapes, and sensors at different degrees of freedom.
    reference : ndarray, shape (n_parameters,)
        θ_ref, usually the parameters before updating.
    beta : float or array_like, shape (n_modes,)
        β_i, the trust in each mode's data. It is dimensionless, since the residual is a force divided by the
        elastic force at θ_ref.

    Raises
    ------
    ValueError
        If no shapes were measured, a sensor is not a degree of freedom, two sensors are at the same degree of
        freedom, a β is not positive and finite, the number of β is wrong, or, at θ_ref, the model is a mechanism
        when the degrees of freedom at the sensors are fixed.

    Notes
    -----
    This is a *pseudo*-likelihood: ε combines data and model and is not the error of any measured quantity. If the
    parameters allow it, the density increases as K and M are scaled down together. The fixed scale ‖K_c(θ_ref)
    φ_i‖ makes modes with different frequencies comparable and β dimensionless, but does not remove this defect. Do
    not compute an evidence from a pseudo-likelihood. The modal residual needs no mode pairing and no eigenproblem,
    but one factorisation of the stiffness at the unmeasured degrees of freedom for each theta.
    """

    terms_name = "residual"

    def __init__(
        self, model: SeparableModel, data: ModalData, reference: FloatArray, beta: ArrayLike = 1.0
    ) -> None:
        if data.shapes is None:
            raise ArgumentError("data.shapes", "the modal residual needs measured shapes at the sensors", "none")
        self.beta: FloatArray = checked_beta(beta, data.n_modes)
        sensors = _masters(model, data.sensors)
        part = np.sort(np.concatenate([dofs for dofs in model.blocks if np.isin(sensors, dofs).any()]))
        order = np.concatenate([sensors, np.setdiff1d(part, sensors)])
        self._K_terms = tuple(Term(sp.csc_array(t.matrix[order][:, order]), t.powers) for t in model.K_terms)
        self._M_terms = tuple(Term(sp.csc_array(t.matrix[order][:, order]), t.powers) for t in model.M_terms)
        self._K_map, self._M_map = ParametricMatrix(self._K_terms), ParametricMatrix(self._M_terms)
        self._n_sensors = len(sensors)
        self.used = data.used
        self._eigenvalues = (2.0 * np.pi * np.asarray(data.frequencies_hz)) ** 2
        self._shapes = np.asarray(data.shapes)
        self._reference = reference
        try:
            K, _, condensed = self._at(reference[None])
        except SingularCondensationError as error:
            raise ArgumentError("sensors", "the structure can still move when they are held") from error
        elastic = condensed.transfer(K @ condensed.extend(self._shapes))
        self._scale = np.linalg.norm(elastic, axis=0)

    def terms(self, theta: FloatArray) -> FloatArray:
        """Return the pseudo-log-likelihood of each used mode, (n, n_used), at theta (n, n_parameters).

        It is NaN where the structure is a mechanism when the sensors are fixed.
        """
        return self.of_used(np.stack([self._one(point[None], gradient=False)[0] for point in theta]))

    def terms_and_gradient(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the pseudo-log-likelihood of each used mode and its gradient, (n, n_used, n_parameters).

        Both are NaN where the structure is a mechanism when the sensors are fixed.
        """
        results = [self._one(point[None]) for point in theta]
        terms, slopes = (np.stack(parts) for parts in zip(*results, strict=True))
        return self.of_used(terms), self.of_used(slopes, 1)

    def why_not_finite(self, theta: FloatArray) -> str:
        """Return why the terms are not finite at theta (n_parameters,). Whether they are finite is not checked."""
        try:
            self._at(theta[None])
        except SingularCondensationError:
            return "the structure can still move when the sensors are held"
        return "the log-likelihood is not finite: the modal residual overflows"

    def as_dict(self) -> dict[str, Plain]:
        """Return the error model's name and settings as a dict."""
        return {"error": "modal-residual", "beta": self.beta.tolist(), "reference": self._reference.tolist()}

    def _at(self, theta: FloatArray) -> tuple[Any, Any, StaticCondensation]:
        """Return K, M and the condensation onto the sensors at a single theta, shape (1, n_parameters).

        In K and M, the sensors' degrees of freedom come first. Raise SingularCondensationError if the structure is
        a mechanism when the sensors are fixed.
        """
        K = sp.csc_array(self._K_map.add_up(self._K_map.coefficients(theta)[0], dense=False))
        M = sp.csc_array(self._M_map.add_up(self._M_map.coefficients(theta)[0], dense=False))
        return K, M, StaticCondensation(K, np.arange(self._n_sensors))

    def _terms(self, residual: FloatArray) -> FloatArray:
        size = np.sum((residual / self._scale) ** 2, axis=0)
        return 0.5 * self._n_sensors * np.log(self.beta / np.pi) - self.beta * size

    def _one(self, theta: FloatArray, gradient: bool = True) -> tuple[FloatArray, FloatArray]:
        """Return the log-likelihood terms and their gradients at a single theta; NaN if condensation fails.

        If `gradient` is False, the gradients are NaN. With the static condensation T, let u = Tφ, r = Tᵀ(K − ω²M)u
        and w = Tr. The index s selects the unmeasured degrees of freedom. Since dT_s = −K_ss⁻¹ (dK T)_s,
        rᵀdr = wᵀ(dK − ω²dM)u + ω²(aᵀdK w + bᵀdK u), where a and b are the displacements under the loads Mu and Mw
        with the sensors fixed (adjoint method).
        """
        slope = np.full((len(self.beta), theta.shape[1]), np.nan)
        try:
            K, M, condensed = self._at(theta)
        except SingularCondensationError:
            return np.full(len(self.beta), np.nan), slope
        lam, u = self._eigenvalues, condensed.extend(self._shapes)
        residual = condensed.transfer(K @ u - lam * (M @ u))  # (K_c − ω²M_c)φ, shape (n_sensors, n_modes)
        if not gradient:
            return self._terms(residual), slope
        w = condensed.extend(residual)
        a, b = condensed.solve_held(M @ u), condensed.solve_held(M @ w)
        K_forms = []
        for term in self._K_terms:
            Ku = term.matrix @ u
            K_forms.append(np.sum(w * Ku + lam * (a * (term.matrix @ w) + b * Ku), axis=0))
        M_forms = [lam * np.sum(w * (term.matrix @ u), axis=0) for term in self._M_terms]
        slope = self._K_map.contract(theta, np.array([K_forms]))[0]
        slope = slope - self._M_map.contract(theta, np.array([M_forms]))[0]
        return self._terms(residual), -2.0 * (self.beta / self._scale**2)[:, None] * slope


def _masters(model: SeparableModel, sensors: Sequence[tuple[Any, str]]) -> NDArray[np.intp]:
    """Return the degree-of-freedom index at each sensor, shape (n_sensors,).

    Raise ValueError if a sensor does not read exactly one degree of freedom with the factor 1, or two sensors read
    the same one.
    """
    rows = model.observation(sensors)
    if not (np.all(np.diff(rows.indptr) == 1) and np.all(rows.data == 1.0)):
        raise ArgumentError(
            "sensors", "for the modal residual they must be degrees of freedom, without arms or signs"
        )
    found = np.asarray(rows.indices, dtype=np.intp)
    twice = first_repeated(found.tolist())
    if twice is not None:
        rule = "for the modal residual they must be at different degrees of freedom; average those at the same one"
        raise ArgumentError("sensors", rule, sensors[twice])
    return found
