"""The trace group with measured and predicted FRFs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from fmu.posterior.data.frf.student import squared_scores
from fmu.posterior.data.held_out_lines import held_out
from fmu.posterior.frf.term import FRFTerm
from fmu.progress.phases import by_parts
from fmu.types import BoolArray, ComplexArray, FloatArray, IntArray

if TYPE_CHECKING:
    import xarray as xr

GROUP = "frfs"
_JUDGED, _DRAWN, _AT_ONCE = 500, 200, 16
"""Numbers of draws compared with the data and used for the bands, and number of draws solved in one batch."""
_STEPS, _SETTLED = 100, 1e-6
"""Largest number of reweighted least-squares fits, and change of the weights at which they end."""
_BAND = (0.05, 0.5, 0.95)
_FILL = {"in_spectrum": 0, "used": 0, "held_out": 0}
"""Fill values of variables that cannot be NaN, at lines that only other tests' spectra have."""


class HeldOut(NamedTuple):
    """Comparison of each FRF's held-out values with their prediction.

    Attributes
    ----------
    squares : ndarray, shape (n_frfs,)
        Chi-square with `freedom` degrees of freedom if the model is correct; NaN without held-out values.
    freedom : ndarray of int, shape (n_frfs,)
    inside : ndarray of int, shape (n_frfs,)
        Number of held-out values whose measured amplitude is inside its 90 % prediction interval.
    """

    squares: FloatArray
    freedom: IntArray
    inside: IntArray


def frf_groups(problem: Any, position: FloatArray, rng: np.random.Generator) -> dict[str, xr.Dataset]:
    """Return the trace group ``frfs`` in a dict; the dict is empty if no FRFs were measured.

    Parameters
    ----------
    problem : UpdatingProblem
    position : ndarray, shape (chains, draws, ndim)
    rng : Generator
        For simulated measurement errors.

    Returns
    -------
    mapping of str to xarray.Dataset
        Dimensions: ``frf``, named by response and drive, and by the test if there are several; ``line``, the
        frequencies of all tests in Hz; ``part``, the real and the imaginary part; ``sample``, evenly spaced draws.

        Variables: ``response`` (frf), the kind of the FRF; ``in_spectrum`` (frf, line), whether its spectrum has
        the line; ``measured`` (frf, line, part), in the units of the data; ``used`` and ``held_out`` (frf, line),
        whether a value is used, or tests the updated model (`fmu.posterior.data.held_out_lines`).

        ``amplitude`` and ``phase`` (kind, quantile, frf, line) are the 5 %, 50 % and 95 % quantiles of the model's
        FRFs with channel errors, and of another measurement; phases are in degrees. They are NaN at lines at which
        no FRF of the test is used or held out. ``distance`` (frf, line) is the root sum of squares of the normal
        scores of the real and imaginary errors (or of log amplitude and phase), at the mean of the model's FRFs
        (`squared_scores`). For Gaussian errors, it is the error in standard deviations. It is NaN at values that
        are neither used nor held out. ``squares`` (sample, frf) is chi-square with ``freedom`` (frf) degrees of
        freedom if the model is correct.

        For ``held_squares``, ``held_freedom`` and ``held_inside`` (frf) see `HeldOut`. ``frac`` (frf) is the
        frequency response assurance criterion of the mean at the lines in use, or at the held-out lines of an FRF
        that is not used. ``gain`` and ``gain_sd`` (channel) are the posterior means and standard deviations of the
        marginalised gain errors γ, of a gain 1 + γ; both are 0 for a channel without such an error. An error g of
        log H is γ = exp(g) − 1.
    """
    import xarray as xr

    theta = position.reshape(-1, position.shape[-1])
    found = [_group_of_test(term, own, rng) for term, own in problem.responses_at(theta)]
    if not found:
        return {}
    together = []
    for dim, other in (("frf", "channel"), ("channel", "frf")):
        parts = [one.drop_dims(other) for one in found]
        together.append(
            xr.concat(parts, dim, data_vars="minimal", join="outer", fill_value=_FILL, combine_attrs="override")
        )
    return {GROUP: xr.merge(together)}


def _group_of_test(term: FRFTerm, theta: FloatArray, rng: np.random.Generator) -> xr.Dataset:
    """Return the trace group ``frfs`` of one test, given draws `theta` (n, n_own) of the FRF term's parameters."""
    import xarray as xr

    data = term.data
    held = held_out(data)
    every = term.with_use(data.used | held)
    judged, drawn = (theta[np.unique(np.linspace(0, len(theta) - 1, n).astype(int))] for n in (_JUDGED, _DRAWN))
    squares = np.concatenate(by_parts("predictions", lambda part: term.squares(part, rng), judged, _AT_ONCE))
    computed = np.concatenate(
        by_parts("predictions", lambda part: term.drawn_frfs(every, part, rng), drawn, _AT_ONCE)
    )
    best, gain_sd = (
        np.concatenate(part) for part in zip(*by_parts("predictions", term.gains, drawn, _AT_ONCE), strict=True)
    )
    gain = best + gain_sd * rng.standard_normal(gain_sd.shape)
    seen, simulated = every.through_channels(computed, gain), every.simulate(computed, drawn, rng, gain)
    amplitudes, phases = zip(*(_bands(part) for part in (seen, simulated)), strict=True)
    lines = (data.used | held).any(axis=0)
    predicted = (data.used | held)[:, lines]
    mean, centre = seen.mean(axis=0, keepdims=True), drawn.mean(axis=0, keepdims=True)
    measured = np.asarray(data.values)
    scores = squared_scores(np.abs(every.distance(mean, centre)[0]) ** 2, every.freedoms(mean, centre)[0])
    distance = np.where(predicted, np.sqrt(scores), np.nan)
    tested = _compare(every, seen, drawn, measured[:, lines], np.asarray(amplitudes[1]), held[:, lines])
    compared = np.where(data.used.any(axis=1, keepdims=True), data.used, held)[:, lines]
    known = term.channels.gain_sd > 0.0
    if term.is_log:  # γ = exp(g) − 1, dγ = exp(g) dg
        best, gain_sd = np.expm1(best), np.exp(best) * gain_sd

    def spread(values: FloatArray) -> FloatArray:
        """Return an array over all lines, (..., n_lines), with `values` (..., n_predicted) at the predicted lines.

        The other lines are NaN.
        """
        found = np.full((*values.shape[:-1], data.n_lines), np.nan)
        found[..., lines] = values
        return found

    dims = ("kind", "quantile", "frf", "line")
    variables = {
        "response": ("frf", [data.kind] * data.n_frfs),
        "in_spectrum": (("frf", "line"), np.ones(held.shape, dtype=np.int8)),
        "measured": (("frf", "line", "part"), np.stack([measured.real, measured.imag], axis=-1)),
        "used": (("frf", "line"), data.used.astype(np.int8)),
        "held_out": (("frf", "line"), held.astype(np.int8)),
        "amplitude": (dims, spread(np.array(amplitudes))),
        "phase": (dims, spread(np.array(phases)), {"units": "degree"}),
        "distance": (("frf", "line"), spread(distance)),
        "squares": (("sample", "frf"), squares),
        "freedom": ("frf", 2 * data.used.sum(axis=1)),
        "held_squares": ("frf", tested.squares),
        "held_freedom": ("frf", tested.freedom),
        "held_inside": ("frf", tested.inside),
        "frac": ("frf", frac(*(np.where(compared, part, 0.0) for part in (measured[:, lines], mean[0])))),
        "gain": ("channel", best.mean(axis=0)),
        "gain_sd": ("channel", np.where(known, np.sqrt(np.mean(gain_sd**2, axis=0) + best.var(axis=0)), 0.0)),
    }
    names = {
        "frf": [f"{term.of_test}{label}" for label in data.labels],
        "line": np.asarray(data.frequencies_hz),
        "part": ["real", "imaginary"],
        "kind": ["model", "measurement"],
        "quantile": list(_BAND),
        "channel": [f"{term.of_test}{place} {direction}" for place, direction in term.channels.names],
    }
    return xr.Dataset(variables, coords=names)


def _compare(
    term: FRFTerm,
    seen: ComplexArray,
    theta: FloatArray,
    measured: ComplexArray,
    amplitude: FloatArray,
    held: BoolArray,
) -> HeldOut:
    """Compare the FRF values marked in `held` (n_frfs, n_lines) with their prediction.

    Let z be the errors at a draw in standard deviations (real and imaginary parts), z̄ their mean over S draws,
    and A the matrix of the deviations (z − z̄)/√(S − 1). The prediction has the covariance I + A Aᵀ, and the
    squared distance z̄ᵀ (I + A Aᵀ)⁻¹ z̄ = z̄ᵀ z̄ − z̄ᵀ A (I + Aᵀ A)⁻¹ Aᵀ z̄ is chi-square if the model is correct.
    This distance is the least |z̄ − A a|² + |a|² over the deviations a of the parameters. For noise with Student's
    distribution, the squares of z̄ − A a are replaced by the squares of its normal scores (see `_distance`). For
    an FRF without marked values the distance is NaN.
    """
    squares, freedom = np.full(len(held), np.nan), 2 * held.sum(axis=1)
    low, _, high = amplitude
    inside = np.sum(held & (np.abs(measured) >= low) & (np.abs(measured) <= high), axis=1)
    errors, m = term.distance(seen, theta), term.freedoms(seen, theta)
    for f in np.flatnonzero(freedom):
        z = errors[:, f, held[f]]
        parts: FloatArray = np.concatenate([z.real, z.imag], axis=1)
        mean = parts.mean(axis=0)
        A = (parts - mean).T / np.sqrt(max(len(parts) - 1, 1))
        squares[f] = _distance(mean, A, m[:, f, held[f]].mean(axis=0))
    return HeldOut(squares, freedom, inside)


def _distance(mean: FloatArray, A: FloatArray, m: FloatArray) -> float:
    """Return the least Σ r²(z̄ − A a) + |a|² over a, where r² = m log(1 + |e|²/m) for the noise e of one value.

    It is found by least squares with the weights 1/(1 + |e|²/m) (Lange, Little & Taylor 1989, J. Am. Stat. Assoc.
    84, 881). Only the noise is replaced by normal scores: the deviations of parameters are not Student's.

    Parameters
    ----------
    mean, A : ndarray, shapes (2 L,) and (2 L, S)
        z̄ and A, with the real parts of the L values before the imaginary parts.
    m : ndarray, shape (L,)
        Degrees of freedom.
    """
    weight = np.ones(len(m))
    for _ in range(_STEPS):
        W = np.tile(weight, 2)
        a = np.linalg.solve(np.eye(A.shape[1]) + A.T @ (W[:, None] * A), A.T @ (W * mean))
        square = np.sum((mean - A @ a).reshape(2, -1) ** 2, axis=0)
        last, weight = weight, 1.0 / (1.0 + square / m)
        if np.max(np.abs(weight - last)) < _SETTLED:
            break
    return float(np.sum(squared_scores(square, m)) + a @ a)


def _bands(frfs: ComplexArray) -> tuple[FloatArray, FloatArray]:
    """Return the quantiles of each FRF's amplitude and of its phase in degrees, each (3, n_frfs, n_lines).

    Phases are taken within 180° of the median's phase, so that they do not wrap.
    """
    middle = np.median(frfs.real, axis=0) + 1j * np.median(frfs.imag, axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        away = np.angle(frfs / middle)
    phase = np.degrees(np.angle(middle) + np.quantile(away, _BAND, axis=0))
    return np.quantile(np.abs(frfs), _BAND, axis=0), phase


def frac(measured: ComplexArray, computed: ComplexArray) -> FloatArray:
    """Return the frequency response assurance criterion |Σ d H*|²/(Σ |d|² Σ |H|²) of each FRF, (n_frfs,).

    `measured` d and `computed` H, (n_frfs, n_lines), are 0 at lines that are not compared. The criterion is NaN if
    all lines are 0 (Heylen & Lammens 1996).
    """
    cross = np.abs(np.sum(measured * np.conj(computed), axis=1)) ** 2
    size = np.sum(np.abs(measured) ** 2, axis=1) * np.sum(np.abs(computed) ** 2, axis=1)
    with np.errstate(invalid="ignore"):
        return np.asarray(cross / size)
