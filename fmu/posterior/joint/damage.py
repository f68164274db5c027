"""Losses of stiffness between a reference state and later ones, with a plain or a sparse prior."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from fmu.posterior.parameters import Parameter
from fmu.posterior.priors.base import Normal, Prior
from fmu.types import FloatArray, IntArray, require_positive

_LOWEST, _HIGHEST = -0.5, 0.95
_SD = 0.3
_GLOBAL = 0.01
"""Median of the typical loss of all parameters, where few are damaged."""
SPARSE_RANGE = (-0.9, 0.9)
"""Three slabs: sparse losses lie within it as a rule."""


@dataclass(frozen=True)
class Damage:
    """A parameter that each later group of tests has lost a share d of: θ = θ_reference (1 − d).

    The first test's group is the reference, unless the problem says otherwise. A negative loss is a gain: noise
    gives it where there is no damage, so that losses are not biased upwards.

    Attributes
    ----------
    prior : Prior, optional
        Of each loss, between −0.5 and 0.95; normal about 0 with a standard deviation of 0.3 by default.
    sparse : bool
        Whether few parameters are expected to be damaged: all losses of a state share the regularised horseshoe
        (Piironen & Vehtari 2017, *Electron. J. Statist.* 11, 5018–5051), d = z s with z standard normal and
        1/s² = 1/(τλ)² + 1/c²; λ is half-Cauchy(1) for each, τ half-Cauchy(0.01) for the state, the slab c is 0.3.
        It pulls small losses to nothing and leaves large ones alone. Its gradients are smooth; a spike and slab
        would need jumps between models, one for every subset of parameters.

    Raises
    ------
    ValueError
        If both are given.
    """

    prior: Prior | None = None
    sparse: bool = False

    def __post_init__(self) -> None:
        if self.sparse and self.prior is not None:
            raise ValueError("prior: must not be given with sparse, which is a prior")

    def loss(self, of: Parameter, state: str) -> Parameter:
        """Return the loss of a parameter in a state, where it is not sparse."""
        prior = Normal(_SD) if self.prior is None else self.prior
        start = float(np.clip(0.0, max(_LOWEST, prior.support[0]), min(_HIGHEST, prior.support[1])))
        return Parameter(f"{of.name} loss [{state}]", start, _LOWEST, _HIGHEST, prior)

    def as_dict(self) -> dict[str, Any]:
        """Return the settings in plain Python types."""
        return {"prior": None if self.prior is None else self.prior.as_dict(), "sparse": self.sparse}


@dataclass(frozen=True)
class Horseshoe:
    """The regularised horseshoe, in coordinates whose priors are standard normal and uniform.

    Attributes
    ----------
    typical : float
        Scale of the half-Cauchy prior of τ.
    slab : float
        c.
    """

    typical: float = _GLOBAL
    slab: float = _SD

    def __post_init__(self) -> None:
        require_positive("typical", self.typical)
        require_positive("slab", self.slab)

    def __call__(
        self, z: FloatArray, local: FloatArray, common: FloatArray
    ) -> tuple[FloatArray, tuple[FloatArray, FloatArray, FloatArray]]:
        """Return d = z s, and its derivatives by z and by the uniform coordinates of λ and τ; all of one shape.

        λ = tan(π local/2) and τ = typical · tan(π common/2) are half-Cauchy where the coordinates are uniform.
        """
        scale, by_local = _half_cauchy(local)
        tau, by_common = (self.typical * x for x in _half_cauchy(common))
        a = tau * scale
        s = self.slab * a / np.hypot(self.slab, a)
        by_a = (self.slab / np.hypot(self.slab, a)) ** 3
        return z * s, (s, z * by_a * tau * by_local, z * by_a * scale * by_common)


def _half_cauchy(u: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the quantile u of the half-Cauchy distribution, and its derivative."""
    angle = 0.5 * np.pi * np.clip(u, 0.0, 1.0 - 1e-9)
    return np.tan(angle), 0.5 * np.pi / np.cos(angle) ** 2


def coordinates(of: Parameter, state: str) -> tuple[Parameter, Parameter]:
    """Return the coordinates of a sparse loss: its score z, and the uniform one of its λ."""
    return (
        Parameter(f"{of.name} loss score [{state}]", 0.0, prior=Normal(1.0)),
        Parameter(f"{of.name} loss scale [{state}]", 0.5, 0.0, 1.0),
    )


def common_coordinate(state: str) -> Parameter:
    """Return the uniform coordinate of τ of a state."""
    return Parameter(f"loss scale [{state}]", 0.5, 0.0, 1.0)


@dataclass(frozen=True)
class Loss:
    """The loss of one parameter in every test.

    Attributes
    ----------
    columns : ndarray of int, shape (n_tests, 1) or (n_tests, 3)
        Numbers in theta of the loss, or of z, λ and τ where it is sparse.
    is_lost : ndarray of bool, shape (n_tests,)
        False in the reference.
    """

    columns: IntArray
    is_lost: Any

    def __call__(self, theta: FloatArray) -> tuple[FloatArray, list[tuple[IntArray, FloatArray]]]:
        """Return the losses, shape (n, n_tests), and their derivatives by the parameters of each column."""
        given = [theta[:, column] for column in self.columns.T]
        value, slopes = Horseshoe()(*given) if len(given) == 3 else (given[0], (np.ones_like(given[0]),))
        by = [
            (column, np.where(self.is_lost, slope, 0.0))
            for column, slope in zip(self.columns.T, slopes, strict=True)
        ]
        return np.where(self.is_lost, value, 0.0), by
