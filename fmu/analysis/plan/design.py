"""Numerical description of a planned test: scaled derivatives, expected errors, and the resulting information."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fmu.analysis.plan.candidates import Candidates
from fmu.analysis.plan.sensitivities import Sensitivities
from fmu.analysis.plan.sensors.information import Readings, State
from fmu.posterior.parameters import Parameter
from fmu.types import FloatArray


@dataclass(frozen=True, eq=False)
class Design:
    """The quantities that determine the expected information of a planned test.

    Attributes
    ----------
    parameters : tuple of Parameter
        The p parameters of the plan, which are ψ in `fmu.analysis.plan.before`.
    scale : ndarray, shape (p + z, p + z)
        L, where LLᵀ is the covariance of the parameters and the z latent errors of the model before the test, SI
        units. In the shapes of arrays of scaled parameters below, p means p + z.
    found : Sensitivities
    candidates : Candidates
    modes : tuple of int
        Modes to be measured, as 0-based indices into the modes of `found`.
    frequency_sd : ndarray, shape (n_modes,)
        Relative standard deviations of the measured frequencies, without drift.
    shape_sd : float
        Standard deviation of a mode-shape component, relative to the largest component at the candidates.
    target : ndarray, shape (n, t, p), or None
        Combinations of the scaled parameters that matter; None if all parameters matter equally.
    shape_sd_of_model : float
        Standard deviation of the model's errors in a component, in the same unit. Repeats do not reduce it.
    """

    parameters: tuple[Parameter, ...]
    scale: FloatArray
    found: Sensitivities
    candidates: Candidates
    modes: tuple[int, ...]
    frequency_sd: FloatArray
    shape_sd: float
    target: FloatArray | None = None
    shape_sd_of_model: float = 0.0

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return tuple(one.name for one in self.parameters)

    @property
    def largest(self) -> FloatArray:
        """Largest absolute component of each mode shape at the candidates, shape (n, 1, modes).

        Spare modes are included.
        """
        return np.max(np.abs(self.found.seen.shapes), axis=1, keepdims=True)

    def frequency_information(self, modes: Sequence[int], sd: FloatArray) -> FloatArray:
        """Return the information (n, p, p) from the frequencies of `modes`, whose relative errors are `sd`."""
        seen = self.found.seen
        assert seen.frequency_slopes is not None  # for the type checker
        picked = list(modes)
        J = seen.frequency_slopes[:, picked] / seen.frequencies[:, picked, None] / sd[:, None] @ self.scale
        return np.swapaxes(J, 1, 2) @ J

    def readings(
        self,
        modes: Sequence[int] | None = None,
        frequency_sd: FloatArray | None = None,
        shape_sd: float | None = None,
        prior: FloatArray | None = None,
    ) -> Readings:
        """Return the linearised `Readings` of the candidates for a test that may differ from the design.

        Modes and errors that are None are those of the design. `prior` is the information before the test, shape
        (n, p, p). It defaults to the identity matrix.
        """
        seen, picked = self.found.seen, list(self.modes if modes is None else modes)
        assert seen.shape_slopes is not None  # for the type checker
        if frequency_sd is None:
            frequency_sd = self.frequency_sd if modes is None else self.frequency_sd_of(picked)
        of_test = self.shape_sd if shape_sd is None else shape_sd
        sd = np.hypot(of_test, self.shape_sd_of_model) * self.largest[:, :, picked]
        n, q, _, p = seen.shape_slopes.shape
        shapes, slopes = np.zeros((n, q + 1, len(picked))), np.zeros((n, q + 1, len(picked), p))
        shapes[:, :q] = seen.shapes[:, :, picked] / sd
        slopes[:, :q] = (seen.shape_slopes[:, :, picked] / sd[..., None]) @ self.scale
        before = np.eye(p) if prior is None else prior
        first = before + self.frequency_information(picked, frequency_sd)
        return Readings(first, shapes, slopes, self.candidates.groups, self.target)

    def frequency_sd_of(self, modes: Sequence[int]) -> FloatArray:
        """Return the relative standard deviations of the given measured modes' frequencies, (len(modes),)."""
        return np.array([self.frequency_sd[self.modes.index(i)] for i in modes])

    def sd_of(self, state: State) -> FloatArray:
        """Return the expected parameter standard deviations after the test, shape (p,), SI units.

        They are averaged over the draws.
        """
        return np.asarray(np.mean(self.sd_at_draws(state), axis=0))

    def sd_at_draws(self, state: State) -> FloatArray:
        """Return the parameter standard deviations after the test at each draw, (n, p), SI units."""
        covariance = self.scale @ state.covariance() @ self.scale.T
        return np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))[:, : len(self.parameters)]

    @property
    def prior_sd(self) -> FloatArray:
        """Parameter standard deviations before the test, shape (p,), SI units."""
        return np.asarray(np.linalg.norm(self.scale, axis=1))[: len(self.parameters)]
