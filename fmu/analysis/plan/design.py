"""A planned test in numbers: scaled derivatives, expected errors, and the information that follows from them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from fmu.analysis.plan.candidates import Candidates
from fmu.analysis.plan.information import Readings, State
from fmu.analysis.plan.sensitivities import Sensitivities
from fmu.arguments import ArgumentError
from fmu.differences import both_sides
from fmu.posterior.problem import UpdatingProblem
from fmu.types import FloatArray

Target = str | Sequence[str] | Mapping[str, float] | Callable[[FloatArray], FloatArray]
"""Names of parameters, weights of a combination by name, or a prediction: theta (n, ndim) to (n,) or (n, t)."""
_STEP = 1e-4


@dataclass(frozen=True, eq=False)
class Design:
    """What determines the expected information of a test.

    Attributes
    ----------
    names : tuple of str
        Names of the p parameters.
    scale : ndarray, shape (p, p)
        L with LLᵀ the covariance of the parameters before the test, SI units.
    found : Sensitivities
    candidates : Candidates
    modes : tuple of int
        Indices, from 0, of the modes to be measured among those of `found`.
    frequency_sd : ndarray, shape (n_modes,)
        Relative standard deviations of the measured frequencies.
    shape_sd : float
        Standard deviation of a shape's component, relative to its largest component at the candidates.
    target : ndarray, shape (n, t, p), or None
        Combinations of the scaled parameters that matter.
    """

    names: tuple[str, ...]
    scale: FloatArray
    found: Sensitivities
    candidates: Candidates
    modes: tuple[int, ...]
    frequency_sd: FloatArray
    shape_sd: float
    target: FloatArray | None = None

    @property
    def largest(self) -> FloatArray:
        """Largest component of each shape at the candidates, shape (n, 1, modes), spare modes included."""
        return np.max(np.abs(self.found.seen.shapes), axis=1, keepdims=True)

    def frequency_information(self, modes: Sequence[int], sd: FloatArray) -> FloatArray:
        """Return the information of the frequencies of some modes, with relative errors `sd`, (n, p, p)."""
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
        """Return the readings of the candidates, for these or other modes and errors; see `Readings`.

        `prior` is the information before the test, shape (n, p, p); the identity by default.
        """
        seen, picked = self.found.seen, list(self.modes if modes is None else modes)
        assert seen.shape_slopes is not None  # for the type checker
        if frequency_sd is None:
            frequency_sd = self.frequency_sd if modes is None else self.frequency_sd_of(picked)
        sd = (self.shape_sd if shape_sd is None else shape_sd) * self.largest[:, :, picked]
        n, q, _, p = seen.shape_slopes.shape
        shapes, slopes = np.zeros((n, q + 1, len(picked))), np.zeros((n, q + 1, len(picked), p))
        shapes[:, :q] = seen.shapes[:, :, picked] / sd
        slopes[:, :q] = (seen.shape_slopes[:, :, picked] / sd[..., None]) @ self.scale
        before = np.eye(p) if prior is None else prior
        first = before + self.frequency_information(picked, frequency_sd)
        return Readings(first, shapes, slopes, self.candidates.groups, self.target)

    def frequency_sd_of(self, modes: Sequence[int]) -> FloatArray:
        """Return the relative errors of frequencies of some of the measured modes, by their indices."""
        return np.array([self.frequency_sd[self.modes.index(i)] for i in modes])

    def sd_of(self, state: State) -> FloatArray:
        """Return the expected standard deviations of the parameters, the mean over the draws, (p,), SI units."""
        return np.asarray(np.mean(self.sd_at_draws(state), axis=0))

    def sd_at_draws(self, state: State) -> FloatArray:
        """Return the standard deviations of the parameters after a test at each draw, (n, p), SI units."""
        covariance = self.scale @ state.covariance() @ self.scale.T
        return np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))

    @property
    def prior_sd(self) -> FloatArray:
        """Standard deviations of the parameters before the test, shape (p,), SI units."""
        return np.asarray(np.linalg.norm(self.scale, axis=1))


def target_of(
    target: Target | None, problem: UpdatingProblem, theta: FloatArray, scale: FloatArray
) -> FloatArray | None:
    """Return the combinations of scaled parameters of a target, (n, t, p); None without a target.

    A prediction is linearised at theta (n, p) by central differences.

    Raises
    ------
    ValueError
        If a name is unknown, the weights are all zero, or a prediction does not return finite numbers.
    """
    names = problem.names[: problem.n_structural]
    n, p = theta.shape
    if target is None:
        return None
    if callable(target):
        h = _STEP * np.linalg.norm(scale, axis=1)
        points, _ = both_sides(theta, h, problem.lower[:p], problem.upper[:p])
        values = np.asarray(target(points.reshape(-1, p)), dtype=float)
        if values.shape[:1] != (2 * n * p,) or not np.all(np.isfinite(values)):
            rule = f"must return finite numbers of shape (n,) or (n, t) at theta (n, {p})"
            raise ArgumentError("target", rule, f"shape {values.shape}")
        values = values.reshape(2, n, p, -1)
        at = np.diagonal(points, axis1=2, axis2=3)
        rows = np.swapaxes((values[0] - values[1]) / (at[0] - at[1])[..., None], 1, 2)
    else:
        weights = [{target: 1.0}] if isinstance(target, str) else [target] if isinstance(target, Mapping) else []
        weights = weights or [{name: 1.0} for name in target]
        rows = np.zeros((n, len(weights), p))
        for t, one in enumerate(weights):
            for name, weight in one.items():
                if name not in names:
                    raise ArgumentError("target", f"must name parameters, {', '.join(names)}", repr(name))
                rows[:, t, names.index(name)] += weight
    found = rows @ scale
    if not np.all(np.any(found, axis=2)):
        raise ArgumentError("target", "must depend on the parameters", "a combination of weight zero")
    return np.asarray(found)
