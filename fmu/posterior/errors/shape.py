"""Error model for mode shapes at the sensors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from fmu.arguments import ArgumentError, check_arguments, takes_old_names
from fmu.fem.pairing.prediction import ModalPrediction
from fmu.posterior.data.covariance import mode_weights
from fmu.posterior.data.estimated_sd import gaussian_sd, to_chi_square
from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.data.stacked import freedom_of_shapes
from fmu.posterior.errors.base import LOG_2PI, ErrorTerm, Evaluated, Residuals
from fmu.posterior.errors.noise import OLD_NAMES, NoiseIndex, Spread, require_sizes, spread
from fmu.posterior.parameters import Parameter
from fmu.types import FloatArray, IntArray, Plain


@takes_old_names(**OLD_NAMES)
@check_arguments
@dataclass(frozen=True)
class ShapeErrors:
    """Gaussian errors in the mode shapes, scaled to unit length at the sensors.

    The error is ε = u − aφ, with the measured unit-length shape u, the computed shape φ and the best-fitting scale
    a. With the precisions Λ = diag(1/σ_s²) of the q sensors,

    log p = −½ εᵀΛε + ½ log det Λ − ½ log(φᵀΛφ / φᵀφ) − ½ (q − 1) log 2π.

    This is the Gaussian density of u's direction relative to φ's direction. The component along φ depends only on
    the scale and is integrated out (cf. Vanik, Beck & Au 2000, *J. Eng. Mech.* 126, 738–745). The density has q −
    1 dimensions. With one σ for all sensors, εᵀΛε = (1 − MAC)/σ². The signs and scales of shapes have no effect.

    Attributes
    ----------
    sd : float, array_like of shape (n_modes,) or (n_sensors, n_modes), or Parameter, optional
        Standard deviation of a component of a unit-length shape; by default the data's standard deviation.
    weights : array_like, shape (n_modes,), optional
        Weights w_i of the modes: the variances of mode i are sd²/w_i.
    model_sd : Parameter, optional
        Standard deviation sd_d of the model error in a component of a unit-length shape, to be inferred. It adds
        sd_d²/w_i to the variances of mode i.

    Raises
    ------
    ValueError
        If a standard deviation or a weight is not positive and finite.
    """

    sd: ArrayLike | Parameter | None = None
    weights: ArrayLike | None = None
    model_sd: Parameter | None = None

    def __post_init__(self) -> None:
        require_sizes(self.sd, self.weights)

    def bind(self, data: ModalData, index: NoiseIndex) -> ErrorTerm:
        """Return the error model bound to `data`; see `ErrorModel.bind`.

        Raises
        ------
        ValueError
            If shapes were not measured at two sensors or more, standard deviations are missing, standard
            deviations or weights do not fit the data, or an inferred standard deviation has a negative lower bound
            or the name of another parameter.
        """
        unit = unit_shapes(data, "shape errors")
        size = np.ones(unit.shape) / np.sqrt(mode_weights(self.weights, unit.shape[1]))
        sd = data.shapes_sd if self.sd is None else self.sd
        bound = spread("shape errors", sd, self.model_sd, size, index)
        if self.sd is not None or self.model_sd is not None or self.weights is not None:
            return ShapeTerm(unit, bound)
        return ShapeTerm(unit, bound, freedom_of_shapes(data))

    def n_errors(self, data: ModalData) -> int:
        """Return the total number of shape components in all used modes; 0 if no shapes were measured."""
        return 0 if data.shapes is None else len(np.asarray(data.shapes)) * sum(data.use)

    def data_give_sd(self, data: ModalData) -> bool:
        """Return True if `data` have standard deviations for the shapes."""
        return data.shapes_sd is not None


@dataclass(frozen=True, eq=False)
class ShapeTerm(ErrorTerm):
    """Errors in mode shapes.

    Attributes
    ----------
    unit : ndarray, shape (n_sensors, n_modes)
        The measured unit-length shapes.
    spread : Spread
    nu : ndarray, shape (n_modes,), optional
        Degrees of freedom ν of the standard deviations, if they come only from the scatter of repeated tests;
        infinite for a mode of another test that was not repeated.
    """

    unit: FloatArray
    spread: Spread
    nu: FloatArray | None = None
    needs_shapes: ClassVar[bool] = True
    is_chi_square: ClassVar[bool] = True
    quantity: ClassVar[str] = "shapes"

    @property
    def n_data(self) -> int:
        """Number of independent measured values per mode: one fewer than the sensors, because the scale is free.

        With u = φ/‖φ‖ + ση and independent standard normal η, the residuals are the component of η orthogonal to
        φ, to first order in σ. Therefore εᵀΛε is chi-square distributed with q − 1 degrees of freedom at q
        sensors. If the errors are large, εᵀΛε is smaller, because it cannot exceed its value at MAC = 0.
        """
        return len(self.unit) - 1

    def normal_scores(self, z: FloatArray) -> FloatArray:
        """Convert residuals z, (..., n_sensors, n_modes), to normal scores.

        Let one standard deviation of a mode's mean shape come from the scatter of tests on ν degrees of freedom,
        widened by g = `gaussian_sd`. Then g² Σ z²/(q − 1) has the distribution F(q − 1, ν). The factor
        `to_chi_square` on z gives Σ z² the chi-square distribution with q − 1 degrees of freedom.
        """
        if self.nu is None:
            return z
        q = np.sum(z**2, axis=-2, keepdims=True)
        factor = to_chi_square(q, self.n_data, self.nu, gaussian_sd(self.nu) ** 2)
        return z * np.where(np.isinf(self.nu), 1.0, factor)

    def evaluate(self, seen: ModalPrediction, noise: FloatArray, gradient: bool) -> Evaluated:
        """Return the log-density of each mode; see `ErrorTerm.evaluate`."""
        s, u = seen.shapes, self.unit
        Lam = 1.0 / self.spread.variance(noise)
        weighted, size = np.sum(Lam * s**2, axis=1), np.sum(s**2, axis=1)
        a = np.sum(Lam * u * s, axis=1) / weighted
        error = u - a[:, None] * s
        log_det = np.sum(np.log(Lam), axis=1) - np.log(weighted / size)
        terms = 0.5 * (log_det - np.sum(Lam * error**2, axis=1) - (len(u) - 1) * LOG_2PI)
        if not gradient:
            return Evaluated(terms)
        by_shape = a[:, None] * Lam * error - Lam * s / weighted[:, None] + s / size[:, None]
        by_Lam = 0.5 * (1.0 / Lam - error**2 - s**2 / weighted[:, None])
        by_noise = {k: np.sum(-by_Lam * Lam**2 * dV, axis=1) for k, dV in self.spread.slopes(noise).items()}
        return Evaluated(terms, None, by_shape, by_noise)

    def residuals(self, seen: ModalPrediction, noise: FloatArray) -> Residuals:
        """Return the errors divided by their standard deviations; see `ErrorTerm.residuals`."""
        s, u = seen.shapes, self.unit
        root = self.spread.inverse_sd(noise)
        Lam = root**2
        weighted = np.sum(Lam * s**2, axis=1)
        a = np.sum(Lam * u * s, axis=1) / weighted
        values = np.swapaxes(root * (u - a[:, None] * s), 1, 2)
        da = np.swapaxes((Lam * u - 2.0 * a[:, None] * Lam * s) / weighted[:, None], 1, 2)
        s, root = np.swapaxes(s, 1, 2), np.swapaxes(root, 1, 2)
        by_shape = -root[..., None] * (a[..., None, None] * np.eye(len(u)) + s[..., None] * da[..., None, :])
        return Residuals(values, None, by_shape)

    def residuals_within(self, seen: ModalPrediction, noise: FloatArray) -> Residuals:
        """Return the residuals and their derivatives, projected onto the space orthogonal to ψ = Λ^½φ.

        The residuals lie in this space. Their projected derivatives with respect to φ are −a (I − ψψᵀ/ψᵀψ) Λ^½.
        """
        root = np.swapaxes(self.spread.inverse_sd(noise), 1, 2)
        u, psi = root * self.unit.T, root * np.swapaxes(seen.shapes, 1, 2)
        weighted = np.sum(psi**2, axis=2)[..., None]
        a = np.sum(u * psi, axis=2)[..., None] / weighted
        by_shape = (a * psi / weighted)[..., None] * (root * psi)[:, :, None]
        i = np.arange(len(self.unit))
        by_shape[:, :, i, i] -= a * root
        return Residuals(u - a * psi, None, by_shape)

    def change_of_slopes(
        self, seen: ModalPrediction, noise: FloatArray, by_slope: FloatArray
    ) -> tuple[None, FloatArray, FloatArray]:
        """Differentiate a function of the residuals' slopes; see `ErrorTerm.change_of_slopes`.

        The slopes are B ∂φ/∂θ with B = −a R (I − φφᵀΛ/φᵀΛφ), R = Λ^½. Let G be the derivatives of the function
        with respect to the slopes. The second derivatives of φ have the weights BᵀG. Let T = G (∂φ/∂θ)ᵀ. The
        remainder is ∂φ/∂θ times the derivative of Σ_ks T_ks B_ks = −a (Σ_k R_k T_kk − φᵀR T Λφ/φᵀΛφ) with respect
        to φ at fixed T.
        """
        root = np.swapaxes(self.spread.inverse_sd(noise), 1, 2)
        psi, G = root * np.swapaxes(seen.shapes, 1, 2), by_slope
        J = np.swapaxes(np.asarray(seen.shape_slopes), 1, 2)
        weighted = np.sum(psi**2, axis=2)[..., None]
        pulled, weights = psi / weighted, (root * psi)[..., None]  # Rφ/φᵀΛφ and Λφ
        a = np.sum(root * self.unit.T * pulled, axis=2)[..., None]
        pulled_G = pulled[:, :, None] @ G
        left = a[..., None] * (weights * pulled_G - root[..., None] * G)
        across = (G @ (np.swapaxes(J, 2, 3) @ weights))[..., 0]  # TΛφ
        b = np.sum(pulled * across, axis=2)[..., None]
        trace = np.sum(root * np.sum(G * J, axis=3), axis=2)[..., None]
        pulled_T = (J @ np.swapaxes(pulled_G, 2, 3))[..., 0]  # TᵀRφ/φᵀΛφ
        da = root * (root * self.unit.T - 2.0 * a * psi) / weighted
        db = root * (across / weighted + root * pulled_T - 2.0 * b * pulled)
        by_shape = a * db - da * (trace - b)
        direct = (by_shape[:, :, None] @ J)[:, :, 0]
        return None, np.swapaxes(left, 1, 2), direct

    def labels(self, modes: Sequence[str]) -> list[str]:
        """Return the residuals' names, given the mode names; see `ErrorTerm.labels`."""
        return [f"{mode}, sensor {k + 1}" for mode in modes for k in range(len(self.unit))]

    def information(self, noise: FloatArray, used: IntArray | None = None) -> FloatArray:
        """Return the Fisher information on the inferred sds; see `ErrorTerm.information`.

        The information of independent errors is multiplied by 1 − 1/q at q sensors, because the scale is free.
        """
        return (1.0 - 1.0 / len(self.unit)) * self.spread.information(noise, used)

    def as_dict(self) -> dict[str, Plain]:
        """Return the error model's name and settings as a dict."""
        return {"error": "shape", "spread": self.spread.as_dict()}


def unit_shapes(data: ModalData, name: str) -> FloatArray:
    """Return the measured unit-length shapes, (n_sensors, n_modes).

    Raise ValueError if there are no shapes, or only one sensor.
    """
    if data.shapes is None:
        raise ArgumentError(name, "need measured shapes at the sensors", "none")
    shapes = np.asarray(data.shapes)
    if len(shapes) < 2:
        raise ArgumentError(name, "need shapes at two sensors or more", len(shapes))
    return np.asarray(shapes / np.linalg.norm(shapes, axis=0))
