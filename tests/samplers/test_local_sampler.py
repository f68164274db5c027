"""A local sampler of one's own: what it takes for jumps, the mixture, tempering and checkpoints, and no more."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest

import fmu
from fmu.samplers import Info, State, run
from fmu.samplers.local import LocalKernel, LocalSampler, accept_or_reject
from fmu.samplers.mixture.mixture import with_jumps
from fmu.samplers.tempering.kernel import side_by_side
from fmu.samplers.tempering.tempering import Tempering
from fmu.samplers.trajectory import ExactGradient
from tests.samplers.mixture.test_mixture import Apart, drawn
from tests.samplers.moments import assert_right
from tests.samplers.targets import SkewedGumbel
from tests.samplers.tempered_targets import LinearGaussian


@dataclass(frozen=True)
class Langevin(LocalSampler):
    """Metropolis-adjusted Langevin steps, x* = x + h²/2 S ∇ log P + h L z, S = L Lᵀ (Roberts & Tweedie 1996)."""

    length: float = 0.3
    factor: tuple = ()
    name: ClassVar[str] = "langevin"

    @property
    def gradient(self):
        return "exact"

    def bind(self, density):
        factor = np.array(self.factor) if self.factor else np.eye(density.ndim)
        return LangevinKernel(ExactGradient(density), self.length * factor)

    def take_covariance(self, covariance):
        return replace(self, length=0.9, factor=tuple(map(tuple, np.linalg.cholesky(covariance))))


@dataclass(frozen=True)
class LangevinKernel(LocalKernel):
    """`factor` is h L, (ndim, ndim) or each chain's own."""

    factor: np.ndarray

    def step(self, rng, state):
        if state.gradient is None:
            raise ValueError("state: must carry the gradient at its position (got None)")
        z = rng.standard_normal(state.position.shape)
        x = state.position + self._times(self.factor, z + self._pull(state.gradient))
        inside = np.all((x >= self.target.lower) & (x <= self.target.upper), axis=1)
        new = self.target.slope(np.where(inside[:, None], x, state.position), with_log_prob=True)
        finite = inside & new.finite
        candidate = State(x, np.where(finite, new.log_prob, -np.inf), np.where(finite[:, None], new.gradient, 0.0))
        back = z + self._pull(state.gradient) + self._pull(candidate.gradient)
        log_ratio = candidate.log_prob - state.log_prob + 0.5 * np.sum(z**2 - back**2, axis=1)
        end, accepted = accept_or_reject(rng, state, candidate, log_ratio)
        rate = np.exp(np.minimum(0.0, log_ratio))
        extra = {"acceptance_rate": rate, "n_nonfinite": (inside & ~new.finite).astype(np.int64)}
        return end, Info(accepted, end.log_prob, new.n_solves, np.ones_like(new.n_solves), extra)

    def join(self, kernels, chains):
        return replace(self, factor=np.repeat([kernel.factor for kernel in kernels], chains, axis=0))

    def _pull(self, gradient):
        """Return h Lᵀ ∇ log P / 2."""
        return 0.5 * self._times(np.swapaxes(self.factor, -1, -2), gradient)

    @staticmethod
    def _times(matrix, z):
        return np.einsum("...ij,...j->...i", matrix, z)


def test_it_samples_alone():
    target = SkewedGumbel()
    kernel = Langevin().take_covariance(target.covariance / np.outer(target.scale, target.scale))
    assert_right(target, run(target, kernel, draws=100, warmup=60, chains=256, seed=1, init="prior"))


def test_with_jumps_its_chains_cross_in_the_right_proportion():
    target = Apart()
    sampler = with_jumps(Langevin()).starting_from(target.components(), np.array([0.5, 0.5]))
    assert sampler.name == "langevin"
    result = drawn(
        target, sampler, init=np.repeat(target.centres[1:], 32, axis=0), chains=32, draws=190, warmup=200
    )
    left = result.posterior.position[..., 0] < 0
    assert left.mean() == pytest.approx(0.7, abs=0.05)
    learnt = result.learnt["local"]
    assert learnt["type"] == "Langevin"
    assert learnt["length"] == 0.9, "the mixture has given it its covariance"
    moves = result.posterior.stats["accepted"][:, ::2]
    assert moves.mean() > 0.4


def test_tempering_moves_its_replicas():
    target = LinearGaussian()
    kernels = tuple(Langevin(length=h) for h in (1.0, 0.5, 0.2, 0.1, 0.05))
    tempering = Tempering(kernels, temperatures=np.linspace(0, 1, 6) ** 5)
    assert_right(target, run(target, tempering, draws=150, warmup=100, chains=256, seed=2, init="prior"))
    joined = side_by_side([kernel.bind(target) for kernel in kernels], 2)
    np.testing.assert_array_equal(joined.factor[:, 0, 0], np.repeat([1.0, 0.5, 0.2, 0.1, 0.05], 2))


@pytest.mark.parametrize("sampler", [Langevin(), with_jumps(Langevin()), Tempering(Langevin())], ids=str)
def test_a_run_that_is_interrupted_goes_on_as_if_it_were_not(sampler, tmp_path):
    target = LinearGaussian()

    def interrupt(phase, done, total, info):
        if phase == "draws" and done == 10:
            raise KeyboardInterrupt

    options = {"draws": 20, "warmup": 60, "chains": 2, "init": np.zeros((2, 3)), "seed": 3}
    with pytest.raises(KeyboardInterrupt):
        fmu.sample(target, sampler, progress=interrupt, checkpoint=tmp_path, **options)
    resumed = fmu.sample(target, sampler, checkpoint=tmp_path, **options)
    whole = fmu.sample(target, sampler, **options)
    for name in whole.posterior:
        np.testing.assert_array_equal(resumed.posterior[name], whole.posterior[name])


def test_a_density_without_gradients_is_refused_with_jumps_too():
    class Plain:
        ndim, lower, upper = 2, np.zeros(2), np.ones(2)

        def log_prob(self, theta):
            return -np.sum(np.asarray(theta) ** 2, axis=-1)

    for jumps in (False, True):
        with pytest.raises(ValueError, match="sampler: langevin needs a density with log_prob_and_grad"):
            fmu.sample(Plain(), Langevin(), jumps=jumps, init=np.full((4, 2), 0.4))
