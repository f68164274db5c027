"""Likelihood for soft pairing: a mixture over candidate modes, which avoids most jumps of one-to-one pairing."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from fmu.arguments import ArgumentError
from fmu.fem.pairing.paired_structure import PairedStructure
from fmu.fem.pairing.prediction import Candidates, ModalPrediction
from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.errors.base import ErrorModel, Evaluated, Likelihood
from fmu.posterior.errors.likelihood import ModalLikelihood
from fmu.types import Chain, FloatArray, IntArray, Plain


class _Pairs(NamedTuple):
    """Log-densities for all pairs of a candidate k and a measured mode i, as arrays of shape (n, k, m).

    Attributes
    ----------
    log_weight, log_density : ndarray
        log w_ik and log p(measured mode i | candidate k). The latter is set to 0 where the weight is 0.
    of : list of Evaluated
        The pairs' log-densities from each error model, with n·k rows.
    """

    log_weight: FloatArray
    log_density: FloatArray
    of: list[Evaluated]

    @property
    def terms(self) -> FloatArray:
        """Log-likelihood of each measured mode, shape (n, m)."""
        return _log_sum_exp(self.log_weight + self.log_density)

    @property
    def responsibility(self) -> FloatArray:
        """Each candidate's share in a measured mode's likelihood, (n, k, m). The sum over k is 1.

        It is NaN if no candidate gives the mode a positive density.
        """
        return np.exp(self.log_weight + self.log_density - self.terms[:, None])


class MixtureLikelihood(ModalLikelihood):
    """Likelihood in which each measured mode is a mixture over the computed modes that may correspond to it.

    log P(D|θ) = Σ_i log Σ_k w_ik p(f_i, φ_i | f_k(θ), φ_k(θ)),   w_ik = exp(MAC_ik/τ) / Σ_j exp(MAC_ij/τ)

    Here τ is the softness of the pairing. The candidates k are the lowest modes of all blocks in which a measured
    shape has motion (`fmu.fem.pairing.prediction.predict_candidates`). The weights depend on the computed shapes
    and thus on θ; the gradient includes their derivatives. Where two modes of a block veer, their shapes and thus
    this likelihood change continuously, whereas the likelihood of a one-to-one pairing jumps.

    Parameters
    ----------
    model : PairedStructure
        A model with soft pairing. Its parameters come first in theta.
    data : ModalData
    errors : sequence of ErrorModel
        Error models whose errors are independent from mode to mode.

    Raises
    ------
    ValueError
        If an error model's errors depend on several modes (a covariance, or groups of modes), or for a reason
        given in `ModalLikelihood`.

    Notes
    -----
    - The pairing is *not* one to one: two measured modes may use the same candidate. A measured mode that uses
      a candidate other than its best one loses log-weight: the difference between the two MACs, divided by τ.
      The loss is zero if the two measured shapes are equal at the sensors.
    - A candidate whose MAC is lower than the highest MAC by Δ has the relative weight e^(−Δ/τ). With the default
      τ = 0.02 its log-weight is lower by at most 50 nats. If frequencies are measured so accurately that a wrong
      frequency costs more, a mode with a matching frequency but a wrong shape becomes plausible. Then reduce τ
      or add shape errors. In the limit τ → 0 the candidate with the highest MAC is selected.
    - If only frequencies have errors, the likelihood is a density of the frequencies, given the measured shapes.
      If shapes have errors too, the weights use the measured shapes a second time, and the likelihood is no longer
      a density. Do not compare evidences of problems with different softness.
    - The model's ``frequencies`` still come from the one-to-one assignment, because a mean over candidates is not
      the frequency of any mode. These frequencies jump at a veering.
    - A block's candidates end with the highest mode computed. If this mode veers with the next one, the likelihood
      still jumps by that mode's weight.
    """

    model: PairedStructure

    def __init__(self, model: PairedStructure, data: ModalData, errors: Sequence[ErrorModel]) -> None:
        super().__init__(model, data, errors)
        if any(term.couples_modes for term in self.terms_of):
            raise ArgumentError(
                "pairing", "soft needs errors that are independent from mode to mode", "covariance_hz2 or together"
            )
        self.softness = model.softness
        # the terms need the model; they do not follow from the frequencies of the modes paired one to one
        self.error = self.beta = self._fast = None
        self.chi_square = ()  # the errors of a measured mode are not the residuals of any single candidate
        self.terms_name = "modes"

    by_frequencies = Likelihood.by_frequencies
    terms_and_misfit = Likelihood.terms_and_misfit

    def terms(self, theta: FloatArray) -> FloatArray:
        """Return the log-likelihood of each used mode, shape (n, n_used), at theta (n, ndim)."""
        return self.of_used(self._pairs(self._candidates(theta, False), theta, False).terms)

    def terms_and_gradient(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the log-likelihood of each used mode, (n, n_used), and its gradient, (n, n_used, ndim)."""
        candidates = self._candidates(theta, True)
        return self._mix(self._pairs(candidates, theta, True), candidates, theta)

    def residuals_and_slopes(self, theta: FloatArray, chain: Chain | None = None) -> tuple[FloatArray, FloatArray]:
        """Return the residuals and their derivatives, computed for the candidates with the highest MAC.

        These candidates correspond to the measured modes even where the frequencies are still so inaccurate that
        other candidates contribute more to the likelihood. See `Likelihood` for the array shapes. `chain` is
        ignored, because soft pairing works with a single test only.
        """
        candidates = self._candidates(theta, True)
        best = _best(np.swapaxes(candidates.mac, 1, 2))
        return self._residuals_and_slopes(_pick_candidates(candidates, best), theta[:, self.n_structural :])

    def quadratic(
        self, theta: FloatArray, chain: Chain | None = None
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the log-likelihood (n,), its gradient (n, ndim) and the information (n, ndim, ndim).

        The information on the model's parameters is computed from the candidate with the largest share in each
        measured mode.
        """
        candidates = self._candidates(theta, True)
        pairs = self._pairs(candidates, theta, True)
        terms, gradient = self._mix(pairs, candidates, theta)
        answering = _pick_candidates(candidates, _best(pairs.log_weight + pairs.log_density))
        J = self._residuals_and_slopes(answering, theta[:, self.n_structural :])[1]
        return terms.sum(axis=1), gradient.sum(axis=1), self._information(J, theta)

    def as_dict(self) -> dict[str, Plain]:
        """Return the error models' names and settings, and the softness, as a dict of plain Python types."""
        return {**super().as_dict(), "softness": self.softness}

    def _terms_by_error(self, theta: FloatArray) -> list[tuple[str, FloatArray]]:
        return [("every candidate's", self.terms(theta))]

    def _candidates(self, theta: FloatArray, gradient: bool) -> Candidates:
        return self.model.seen_candidates(theta[:, : self.n_structural], gradient)

    def _pairs(self, candidates: Candidates, theta: FloatArray, gradient: bool) -> _Pairs:
        n, m, k = candidates.mac.shape
        f, phi = candidates.frequencies, np.swapaxes(candidates.shapes, 1, 2)
        q = phi.shape[2]
        each = ModalPrediction(
            np.broadcast_to(f[:, :, None], (n, k, m)).reshape(n * k, m),
            np.broadcast_to(phi[..., None], (n, k, q, m)).reshape(n * k, q, m),
        )
        noise = np.repeat(theta[:, self.n_structural :], k, axis=0)
        scaled = np.ascontiguousarray(np.swapaxes(candidates.mac, 1, 2)) / self.softness
        log_weight = scaled - _log_sum_exp(scaled)[:, None]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            of = [term.evaluate(each, noise, gradient) for term in self.terms_of]
        log_density = np.asarray(sum(part.terms for part in of)).reshape(n, k, m)
        # a mode without motion at any sensor has zero weight, and the density of its shape is undefined
        return _Pairs(log_weight, np.where(np.isneginf(log_weight), 0.0, log_density), of)

    def _mix(self, pairs: _Pairs, candidates: Candidates, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the used modes' log-likelihood terms (n, n_used) and their gradients (n, n_used, ndim).

        A gradient component that is not finite is replaced by NaN.
        """
        n, k, m = pairs.log_weight.shape
        n_structural = self.n_structural
        terms = pairs.terms
        slopes_of: Any = candidates  # computed with slopes
        with np.errstate(invalid="ignore", over="ignore"):
            share = pairs.responsibility
            pull = (share - np.exp(pairs.log_weight)) / self.softness
            gradient = np.zeros((n, m, theta.shape[1]))
            leading = gradient[..., :n_structural]
            leading += np.einsum("nkm,nmkp->nmp", pull, slopes_of.mac_slopes)
            for part in pairs.of:
                if part.by_frequency is not None:
                    by = _multiply(share, part.by_frequency.reshape(n, k, m))
                    # the frequency of a rigid-body mode has no derivative; the share of such a mode is zero
                    slopes = np.where(np.any(by != 0.0, axis=2)[..., None], slopes_of.frequency_slopes, 0.0)
                    leading += np.einsum("nkm,nkp->nmp", by, slopes)
                if part.by_shape is not None:
                    by = _multiply(share[:, :, None], part.by_shape.reshape(n, k, -1, m))
                    leading += np.einsum("nksm,nskp->nmp", by, slopes_of.shape_slopes)
                for j, slope in (part.by_noise or {}).items():
                    gradient[..., n_structural + j] += np.sum(_multiply(share, slope.reshape(n, k, m)), axis=1)
        gradient = np.where(np.isfinite(gradient), gradient, np.nan)
        return self.of_used(terms), self.of_used(gradient, 1)


def _best(score: FloatArray) -> IntArray:
    """Return the index (n, m) of each measured mode's candidate with the highest `score` (n, k, m).

    NaN counts as −∞.
    """
    return np.argmax(np.nan_to_num(score, nan=-np.inf), axis=1)


def _pick_candidates(candidates: Candidates, best: IntArray) -> ModalPrediction:
    """Return a prediction that consists of candidate `best` (n, m) for each measured mode, with derivatives."""
    of: Any = candidates
    return ModalPrediction(
        np.take_along_axis(of.frequencies, best, axis=1),
        np.take_along_axis(of.shapes, best[:, None], axis=2),
        np.take_along_axis(of.frequency_slopes, best[..., None], axis=1),
        np.take_along_axis(of.shape_slopes, best[:, None, :, None], axis=2),
    )


def _log_sum_exp(x: FloatArray) -> FloatArray:
    """Return log Σ_k exp x, shape (n, m), for x (n, k, m). It is −inf if x is −inf for all k."""
    highest = np.max(x, axis=1)
    shift = np.where(np.isneginf(highest), 0.0, highest)
    with np.errstate(divide="ignore"):
        return np.asarray(shift + np.log(np.sum(np.exp(x - shift[:, None]), axis=1)))


def _multiply(share: FloatArray, slope: FloatArray) -> FloatArray:
    """Return share · slope, or 0 if the share is 0, because the slope of a distant candidate may be undefined."""
    return np.multiply(share, slope, out=np.zeros(slope.shape), where=np.broadcast_to(share != 0.0, slope.shape))
