"""FRFs of a model with wrong modes: each mode in the band has its own frequency, and its residues scatter.

The measured receptance of an FRF is Σ_r (A_r(θ) + σ_s a_r ε_r) g_r(f_r) + e. Here A_r(θ) is the model's residue of
mode r, g_r the resonance factor of a mode with the frequency f_r, and e the measurement error. The frequencies f_r
of the modes in the band are inferred. With the model's frequency f_r(θ), ln f_r − ln f_r(θ) is normal with the
standard deviation σ and the correlation ρ between modes. The residue errors ε_r of each FRF are standard normal
and independent. Their unit a_r is the root mean square of the mode's residues over the FRFs. These errors are
linear and are integrated out exactly. In units of the measurement standard deviations, an FRF's errors have the
covariance S = I + C Cᵀ with the columns C_r = σ_s a_r g_r. S is inverted by Woodbury's identity as in
`fmu.posterior.discrepancy.latent`.

The frequency errors must not be linearised. The tangent to a resonance with the damping ratio ζ is valid only for
relative frequency errors below about ζ/2, and model errors are larger. σ and ρ must be given: a band has too few
modes to infer them, and their joint density with f_r is unbounded at σ = 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from fmu.fem.frf.model import FRFModel
from fmu.fem.frf.residues import Residues, Resonances
from fmu.posterior.data.frf_data import FRFData
from fmu.posterior.discrepancy.embedded import MOST, Discrepancy
from fmu.posterior.frf.channels import Channels
from fmu.posterior.frf.misfit import square
from fmu.posterior.frf.term import FRFTerm
from fmu.posterior.frf.window import PER_LINE
from fmu.posterior.parameters import Parameter
from fmu.posterior.priors.base import Uniform
from fmu.posterior.priors.one_sided import HalfNormal
from fmu.types import BoolArray, ComplexArray, FloatArray, Plain

_BAND = 1.1
"""Modes up to this multiple of the highest line's frequency have a discrepancy."""
_RANGE = 0.3
"""Bounds of a mode's frequency, relative to the model's frequency at the starting point."""


@dataclass(frozen=True, eq=False)
class ModeScatter:
    """Model discrepancy in the m modes in the band, and the parameters that are inferred for it.

    Attributes
    ----------
    first : int
        Index (from 0) of the lowest of these modes.
    parameters : tuple of Parameter
        The m frequencies, and σ_s if it is inferred.
    sd, correlation : float
        σ and ρ.
    shape_sd : float or None
        σ_s; None if it is inferred.
    """

    first: int
    parameters: tuple[Parameter, ...]
    sd: float
    correlation: float
    shape_sd: float | None

    @property
    def m(self) -> int:
        """Number of modes with a discrepancy."""
        return len(self.parameters) - (self.shape_sd is None)

    @classmethod
    def of(cls, given: Discrepancy, model: FRFModel, start: FloatArray, top: float) -> ModeScatter:
        """Return the discrepancy in a model's elastic modes up to `_BAND` times the frequency `top`, Hz."""
        lam = model.block.eigenvalues(start[None], model.block.size)[0, model.n_rigid :]
        hz = np.sqrt(np.maximum(lam, 0.0)) / (2.0 * np.pi)
        own = [
            Parameter(f"frequency of mode {k + 1}", f, (1.0 - _RANGE) * f, (1.0 + _RANGE) * f, Uniform(), "Hz")
            for k, f in enumerate(hz[hz < _BAND * top].tolist())
        ]
        if given.shape_sd is None:
            size, prior = given.prior_sd, HalfNormal(given.prior_sd)
            own.append(Parameter(f"{given.label} shapes", 0.5 * size, 0.0, MOST * size, prior))
        sd, correlation = given.sd or 0.0, float(given.correlation or 0.0)  # given, see `FRFErrors`
        return cls(model.n_rigid, tuple(own), sd, correlation, given.shape_sd)

    @cached_property
    def precision(self) -> FloatArray:
        """Inverse covariance of the relative frequency errors, shape (m, m)."""
        m, rho = self.m, self.correlation
        return np.asarray((np.eye(m) - rho / (1.0 + (m - 1) * rho)) / ((1.0 - rho) * self.sd**2))

    def log_density(self, f: FloatArray, lam: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the log-density (n,) of the frequencies f (n, m) in Hz given the model's eigenvalues lam (n, m).

        Also return its derivatives with respect to the frequencies and to the eigenvalues, (n, m) each. The
        density replaces the uniform prior density of f, so the result is the log-density minus the log-prior of f.
        """
        x = np.log(2.0 * np.pi * f) - 0.5 * np.log(lam)
        turned = np.einsum("gh,nh->ng", self.precision, x)
        constant = 0.5 * (np.linalg.slogdet(self.precision)[1] - self.m * np.log(2.0 * np.pi))
        constant += sum(np.log(p.upper - p.lower) for p in self.parameters[: self.m])
        value = constant - 0.5 * np.sum(x * turned, axis=1) - np.sum(np.log(f), axis=1)
        return value, -(turned + 1.0) / f, 0.5 * turned / lam

    def as_dict(self) -> dict[str, Plain]:
        """Return the settings as a dict of plain Python types."""
        shapes = self.parameters[-1].name if self.shape_sd is None else self.shape_sd
        return {"modes": self.m, "sd": self.sd, "correlation": self.correlation, "shape_sd": shapes}


class _At(NamedTuple):
    """Quantities that a term computes at n parameter vectors.

    They are the modes of the model, the eigenvalues `lam` with the inferred frequencies in place of the model's,
    their resonances, the units a_r of the residue errors, the whitened errors E, the loadings B of the residue
    errors ε, and the distribution of ε. E has the shape (n, n_frfs, 2 L) and B (n, n_frfs, m, 2 L), with the real
    parts of all L lines before the imaginary parts. The `mean` and `precision` of ε given the data have the shapes
    (n, n_frfs, m) and (n, n_frfs, m, m).
    """

    modes: Residues
    lam: FloatArray
    resonances: Resonances
    unit: FloatArray
    E: FloatArray
    B: FloatArray
    mean: FloatArray
    precision: FloatArray


class ScatteredTerm(FRFTerm):
    """Measured FRFs bound to a structure with model discrepancy in its modes; see the module docstring.

    The parameters in `scatter` follow the damping parameters.
    """

    has_discrepancy = True

    def __init__(
        self,
        data: FRFData,
        model: FRFModel,
        channels: Channels,
        of_damping: Sequence[Parameter],
        settings: dict[str, Plain],
        scatter: ModeScatter,
        per_line: int = PER_LINE,
    ) -> None:
        settings, own = settings | {"discrepancy": scatter.as_dict()}, (*of_damping, *scatter.parameters)
        super().__init__(data, model, channels, own, False, 0.0, settings, per_line=per_line)
        self.scatter, self._is_silent = scatter, False
        begin = self._first + model.n_values
        self._f = slice(begin, begin + scatter.m)
        self._modes = slice(scatter.first, scatter.first + scatter.m)

    @property
    def roles(self) -> tuple[str, ...]:
        """Description in words of each parameter in `inferred`."""
        return ("damping",) * self.model.n_values + ("error of the model",) * len(self.scatter.parameters)

    def with_use(self, use: BoolArray) -> ScatteredTerm:
        """Return the same term for the measured values at which `use`, (n_frfs, n_lines), is True."""
        own = self.inferred[: self.model.n_values], self._settings, self.scatter, self.window.per_line
        return ScatteredTerm(replace(self.data, use=use, band=None), self.model, self.channels, *own)

    def without_lines(self) -> ScatteredTerm:
        """Return the term without measured values, so that only the density of the frequencies remains.

        The search for maxima starts with it.
        """
        other = self.widen(0.0)
        assert isinstance(other, ScatteredTerm)
        other._is_silent = True
        return other

    def _weights(self) -> FloatArray:
        """Return the reciprocal standard deviations of the values, (n_frfs, L); 0 for values that are not used.

        All are 0 in a term `without_lines`.
        """
        if self._is_silent:
            return np.zeros(self._used.shape)
        return np.asarray(self._used / np.sqrt(self._variance + self._wider**2 * square(self._measured)))

    def _shape_sd(self, theta: FloatArray) -> FloatArray:
        """Return the residue error sd σ_s, shape (n, 1)."""
        known = self.scatter.shape_sd
        return theta[:, -1:] if known is None else np.full((len(theta), 1), known)

    def _at(self, theta: FloatArray) -> _At:
        structural, values = self.split(theta)
        modes = Residues.of(self.model, structural)
        lam = modes.lam.copy()
        lam[:, self._modes] = (2.0 * np.pi * theta[:, self._f]) ** 2
        resonances = Resonances.of(self.model.of_block, lam, values, self.window.omega)  # type: ignore[arg-type]
        resonances = resonances.smooth(self.window.smooth)
        unit = np.sqrt(np.mean(modes.amplitudes[..., self._modes] ** 2, axis=1) + np.finfo(float).tiny)
        size, W = self._shape_sd(theta) * unit, self._weights()
        E = _split((self._measured - modes.amplitudes @ resonances.g) * W)
        B = _split((size[..., None] * resonances.g[:, self._modes])[:, None] * W[:, None])
        precision = np.eye(self.scatter.m) + B @ np.swapaxes(B, 2, 3)
        mean = np.linalg.solve(precision, B @ E[..., None])[..., 0]
        return _At(modes, lam, resonances, unit, E, B, mean, precision)

    def _evaluate_some(self, theta: FloatArray, gradient: bool) -> tuple[FloatArray, FloatArray]:
        at, mine = self._at(theta), self._modes
        modes, shape_sd = at.modes, self._shape_sd(theta)
        prior, prior_by_f, prior_by_lam = self.scatter.log_density(theta[:, self._f], modes.lam[:, mine])
        fitted = (np.swapaxes(at.B, 2, 3) @ at.mean[..., None])[..., 0]
        left = at.E - fitted
        value = prior - 0.5 * np.sum(np.sum(at.E * left, axis=2) + np.linalg.slogdet(at.precision)[1], axis=1)
        if not self._is_silent:
            value = value + self._constant + 2.0 * np.sum(np.log(np.where(self._used, self._weights(), 1.0)))
        slope = np.zeros((len(theta), theta.shape[1] if gradient else 0))
        if not gradient:
            return value, slope
        W, g = self._weights(), at.resonances.g
        w = np.conj(_join(left)) * W
        of_amplitude = np.real(w @ np.swapaxes(g, 1, 2))  # ∂/∂A
        loads = at.mean[..., None] * left[:, :, None] - np.linalg.solve(at.precision, at.B)
        of_loads = np.sum(np.conj(_join(loads)) * W[:, None], axis=1)  # ∂/∂(σ_s a g), (n, m, L)
        along = np.sum(np.real(of_loads * g[:, mine]), axis=2)
        A = modes.amplitudes[..., mine]
        of_amplitude[..., mine] += (shape_sd * along / at.unit)[:, None] * A / A.shape[1]
        of_g = np.swapaxes(np.swapaxes(w, 1, 2) @ modes.amplitudes, 1, 2)
        of_g[:, mine] += (shape_sd * at.unit)[..., None] * of_loads
        of_lam, viscous, hysteretic = (
            np.sum(np.real(of_g * part), axis=2)
            for part in (at.resonances.by_lam, at.resonances.by_viscous, at.resonances.by_hysteretic)
        )
        slope[:, self._f] = of_lam[:, mine] * 2.0 * at.lam[:, mine] / theta[:, self._f] + prior_by_f
        of_lam[:, mine] = prior_by_lam
        p, (_, values) = self._first, self.split(theta)
        slope[:, :p] = np.einsum("nfr,nfrp->np", of_amplitude, modes.by_amplitude)
        slope[:, :p] += np.einsum("nr,nrp->np", of_lam, modes.by_lam)
        slope[:, p : self._f.start] = self.model.of_block.pull_back(at.lam, values, viscous, hysteretic)  # type: ignore[union-attr]
        if self.scatter.shape_sd is None:
            slope[:, -1] = np.sum(along * at.unit, axis=1)
        return value, slope

    def _information_at(self, theta: FloatArray) -> FloatArray:
        at, scatter, n, mine = self._at(theta), self.scatter, theta.shape[1], self._modes
        modes, g, p, (_, values) = at.modes, at.resonances, self._first, self.split(theta)
        own = modes.by_lam[0].copy()
        own[mine] = 0.0
        A = modes.amplitudes[0]
        dH = np.zeros((*self._used.shape, n), dtype=complex)
        dH[..., :p] = np.einsum("frp,rl->flp", modes.by_amplitude[0], g.g[0])
        dH[..., :p] += np.einsum("fr,rl,rp->flp", A, g.by_lam[0], own)
        viscous, hysteretic = self.model.of_block.slopes(at.lam, values)  # type: ignore[union-attr]
        dH[..., p : self._f.start] = np.einsum("fr,rl,rq->flq", A, g.by_viscous[0], viscous[0])
        dH[..., p : self._f.start] += np.einsum("fr,rl,rq->flq", A, g.by_hysteretic[0], hysteretic[0])
        by_f = 2.0 * at.lam[0, mine] / theta[0, self._f]
        dH[..., self._f] = np.einsum("fr,rl,r->flr", A[:, mine], g.by_lam[0, mine], by_f)
        J = np.swapaxes(_split(np.swapaxes(dH * self._weights()[..., None], 1, 2)), 1, 2)
        BJ = at.B[0] @ J
        found = np.sum(np.swapaxes(J, 1, 2) @ J, axis=0)
        found -= np.sum(np.swapaxes(BJ, 1, 2) @ np.linalg.solve(at.precision[0], BJ), axis=0)
        D = np.zeros((scatter.m, n))  # derivatives of the relative frequency errors
        D[:, :p] = -0.5 * modes.by_lam[0, mine] / modes.lam[0, mine, None]
        D[:, self._f] = np.diag(1.0 / theta[0, self._f])
        found += D.T @ scatter.precision @ D
        if scatter.shape_sd is None:
            share = np.eye(scatter.m) - np.linalg.inv(at.precision[0])
            found[-1, -1] += 2.0 * np.einsum("fij,fji->", share, share) / float(theta[0, -1]) ** 2
        return found

    def frfs(self, theta: FloatArray) -> ComplexArray:
        """Return the FRFs with the inferred frequencies and no residue errors, in the units of the data.

        The shape is (n, n_frfs, n_lines).
        """
        at = self._at(theta)
        return np.asarray(at.modes.amplitudes @ at.resonances.g * self._power)

    def drawn_frfs(self, every: FRFTerm, theta: FloatArray, rng: np.random.Generator) -> ComplexArray:
        """Return the FRFs, (n, n_frfs, n_lines), at the lines of another term for the same structure, `every`.

        The residue errors are drawn given this term's data.
        """
        assert isinstance(every, ScatteredTerm)
        epsilon, there = self._draw(self._at(theta), rng), every._at(theta)
        size = self._shape_sd(theta) * there.unit
        residues = there.modes.amplitudes.copy()
        residues[..., self._modes] += epsilon * size[:, None]
        return np.asarray(residues @ there.resonances.g * every._power)

    def squares(self, theta: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Return each FRF's sum of squared residuals over its used lines, (n, n_frfs).

        The residue errors are drawn given the data.
        """
        at = self._at(theta)
        epsilon = self._draw(at, rng)
        return np.asarray(np.sum((at.E - (epsilon[:, :, None] @ at.B)[:, :, 0]) ** 2, axis=2))

    @staticmethod
    def _draw(at: _At, rng: np.random.Generator) -> FloatArray:
        factor = np.swapaxes(np.linalg.cholesky(at.precision), 2, 3)
        noise = rng.standard_normal((*at.mean.shape, 1))
        return np.asarray(at.mean + np.linalg.solve(factor, noise)[..., 0])


def _split(z: ComplexArray) -> FloatArray:
    """Split complex numbers into real parts followed by imaginary parts along the last axis."""
    return np.concatenate([z.real, z.imag], axis=-1)


def _join(x: FloatArray) -> ComplexArray:
    """Join real and imaginary parts along the last axis into complex numbers; the inverse of `_split`."""
    real, imaginary = np.split(x, 2, axis=-1)
    return np.asarray(real + 1j * imaginary)
