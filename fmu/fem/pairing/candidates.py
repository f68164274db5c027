"""All modes that might answer to a measured one, and how alike each is to each measured shape."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np

from fmu.fem.modes.blocks import Block, BlockModel
from fmu.fem.modes.modal import BlockPrediction, frequency_gradient, frequency_hz
from fmu.fem.pairing.rules import RankPairing, ShapePairing
from fmu.fem.reduced.basis import ReducedBlock
from fmu.types import FloatArray

SOFTNESS = 0.02
"""Temperature τ of the weights exp(MAC/τ): a shape that is nothing like the measured one costs 1/τ = 50 nats."""
UNSEEN = 1e-12
"""Squared length at the sensors, beside the longest, below which a shape moves by rounding alone."""


@dataclass(frozen=True, eq=False)
class SoftPairing(ShapePairing):
    """Every candidate answers to every measured mode, with the weight exp(MAC/τ) over the sum of all.

    Solved as `ShapePairing`, it gives the modes of the one-to-one assignment. It is never constant: all candidates
    are needed everywhere.

    Attributes
    ----------
    softness : float
        τ.
    """

    softness: float = SOFTNESS
    name: ClassVar[str] = "soft"
    is_soft: ClassVar[bool] = True

    def __post_init__(self) -> None:
        if not (np.isfinite(self.softness) and self.softness > 0.0):
            raise ValueError(f"softness: must be positive and finite (got {self.softness})")

    def constant(self, model: BlockModel, shapes: Mapping[int, FloatArray]) -> RankPairing | None:
        """Return None."""
        return None


@dataclass(frozen=True)
class Candidates:
    """Modes at n parameter vectors, beside m measured ones.

    Attributes
    ----------
    frequencies : ndarray, shape (n, k), Hz; NaN where a solve failed
    shapes : ndarray, shape (n, n_sensors, k)
        At the sensors where shapes were measured, else empty: n_sensors = 0.
    mac : ndarray, shape (n, m, k)
        With the measured shapes or the references; −inf of a mode that moves none of the coordinates compared.
    frequency_slopes : ndarray, shape (n, k, n_parameters), or None
    shape_slopes : ndarray, shape (n, n_sensors, k, n_parameters), or None
    mac_slopes : ndarray, shape (n, m, k, n_parameters), or None
    """

    frequencies: FloatArray
    shapes: FloatArray
    mac: FloatArray
    frequency_slopes: FloatArray | None = None
    shape_slopes: FloatArray | None = None
    mac_slopes: FloatArray | None = None


class _View(NamedTuple):
    """A block, how many modes it offers, the coordinates of comparison, and the references there."""

    block: Block
    n_candidates: int
    rows: Any
    reference: FloatArray


class CandidateView:
    """A model, full or reduced, of which all modes that might answer are looked at.

    Parameters
    ----------
    model : BlockModel
    rule : ShapePairing
    at_sensors : bool
        Whether the rule compares at the sensors, so that shapes there are of use beside their MAC. Where they are
        not, a reduced block is compared in a basis of what it can show.
    """

    def __init__(self, model: BlockModel, rule: ShapePairing, at_sensors: bool) -> None:
        self.n_parameters, self._at_sensors = model.n_parameters, at_sensors
        self._model, self._rule = model, rule
        self._reference_size = np.sum(rule.shapes**2, axis=0)

    def __getstate__(self) -> dict[str, Any]:
        """Leave out what is prepared when needed."""
        return {name: value for name, value in self.__dict__.items() if name != "_views"}

    @cached_property
    def _views(self) -> list[_View]:
        """The blocks looked at; prepared when they are first needed."""
        views = []
        for b in self._rule.observe(self._model):
            block = self._model.blocks[b]
            rows, reference = self._rule.rows[:, block.dofs], self._rule.shapes
            if isinstance(block, ReducedBlock):
                rows = rows @ block.basis
                if len(rows) > block.size and not self._at_sensors:
                    Q, rows = np.linalg.qr(rows)
                    reference = Q.T @ reference
            views.append(_View(block, self._rule.n_candidates(self._model, b), rows, reference))
        return views

    def __call__(self, theta: FloatArray, gradient: bool = False) -> Candidates:
        """Return the candidates at theta (n, n_parameters)."""
        parts = [self._of_block(view, theta, gradient) for view in self._views]

        def joined(name: str, axis: int) -> FloatArray:
            return np.concatenate([getattr(part, name) for part in parts], axis=axis)

        values = joined("frequencies", 1), joined("shapes", 2), joined("mac", 2)
        if not gradient:
            return Candidates(*values)
        return Candidates(
            *values, joined("frequency_slopes", 1), joined("shape_slopes", 2), joined("mac_slopes", 2)
        )

    def _of_block(self, view: _View, theta: FloatArray, gradient: bool) -> Candidates:
        if isinstance(view.block, ReducedBlock):
            seen = view.block.seen_in_basis(theta, view.n_candidates, view.rows, gradient)
        else:
            seen = view.block.seen(theta, view.n_candidates, view.rows, gradient)
        kept = slice(None) if self._at_sensors else slice(0)
        f = frequency_hz(seen.eigenvalues)
        mac, mac_slopes = self._alike(view, seen)
        if seen.eigenvalue_slopes is None or seen.shape_slopes is None:
            return Candidates(f, seen.shapes[:, kept], mac)
        slopes = frequency_gradient(f, seen.eigenvalue_slopes)
        return Candidates(f, seen.shapes[:, kept], mac, slopes, seen.shape_slopes[:, kept], mac_slopes)

    def _alike(self, view: _View, seen: BlockPrediction) -> tuple[FloatArray, FloatArray | None]:
        """Return MAC_ik = (ψ_iᵀφ_k)²/(ψ_iᵀψ_i φ_kᵀφ_k), shape (n, m, k), slopes if those of shapes are known."""
        phi, psi = np.ascontiguousarray(seen.shapes), view.reference
        length = np.sum(phi**2, axis=1)
        unseen = (length <= UNSEEN * np.max(length, axis=1, keepdims=True))[:, None]
        length = np.where(unseen[:, 0], 1.0, length)[:, None]
        cross = psi.T @ phi
        scale = self._reference_size[:, None] * length
        mac = cross**2 / scale
        alike = np.where(unseen, -np.inf, mac)
        if seen.shape_slopes is None:
            return alike, None
        n, q, k, p = seen.shape_slopes.shape
        d_phi = np.ascontiguousarray(seen.shape_slopes)
        d_cross = (psi.T @ d_phi.reshape(n, q, k * p)).reshape(n, -1, k, p)
        half_d_length = np.sum(phi[..., None] * d_phi, axis=1)[:, None]
        slopes = 2.0 * (cross / scale)[..., None] * d_cross - 2.0 * (mac / length)[..., None] * half_d_length
        return alike, np.where(unseen[..., None], 0.0, slopes)
