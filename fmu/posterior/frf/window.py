"""Frequency response functions (FRFs) as a random test with a window measures them.

Segments of a stationary random test are multiplied by a window w of length T with the spectrum W. The estimate
H1 = S_fx/S_ff is then H smoothed over neighbouring frequencies. If the spectrum of the force is flat over the few
lines that the window spans, the expected spectra have the quotient

    H_w(ω) = Σ_k p_k H(ω + k δ),      p_k = |W(k δ)|² / Σ_j |W(j δ)|²,      δ = 2π/(m T).

In the time domain, H_w is the product of the impulse response and the autocorrelation of w, which vanishes beyond
T. The sum over the spacing δ is therefore exact for an impulse response shorter than (m − 1) T. m is 4, which is
enough for segments of 1.3 decay times, or is doubled until twice as many frequencies change the model's FRFs by
less than half a standard deviation of all lines together (`Window.agrees`). H is in the unit of the measured FRF.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
import scipy.sparse as sp

from fmu.posterior.data.frf.estimates import window_values
from fmu.types import ComplexArray, FloatArray

PER_LINE, MOST_PER_LINE = 4, 64
"""Smallest and largest number m of frequencies per distance 1/T."""
_CHANGE = 0.5
"""Largest change of the FRFs by twice as many frequencies, in standard deviations of all lines together."""
_LEFT_OUT = 1e-6
"""Largest share of the weights p_k that is left out on both sides."""
_WIDEST = 64
"""Largest k/m: a boxcar's weights decrease with 1/k² only, and 0.2 % of them are left out."""
_ROUNDED = 1e-5
"""Largest relative distance of a line from a multiple of the spacing that is attributed to rounding in a file."""
_SAMPLES = 4096


class Solved(Protocol):
    """Responses of a structure at n parameter vectors; see `fmu.fem.frf.proportional.ModalResponses`."""

    def frfs(self, omega: FloatArray) -> ComplexArray:
        """Return the receptances, shape (n, n_frfs, n_lines)."""
        ...

    def add(self, weights: ComplexArray) -> None:
        """Add the contribution of the lines in the last `frfs` call to the derivatives of a scalar function."""
        ...

    def slopes(self, omega: FloatArray) -> ComplexArray:
        """Return the derivatives of the receptances, shape (n, n_frfs, n_lines, n_parameters)."""
        ...


class Window:
    """Receptances at frequency lines, smoothed by the window with which the FRFs were estimated, if there was one.

    Attributes
    ----------
    omega : ndarray, shape (n,), rad/s
        Frequencies at which the FRFs are computed.
    weights : sparse, shape (n_lines, n), or None
        Matrix that smooths receptances, p_k ((ω + k δ)/ω)^power; None without a window.

    Parameters
    ----------
    lines : ndarray, shape (n_lines,), rad/s
    power : int
        Power of iω that converts receptances to the measured kind of FRF.
    window : (str, float) or None
        Name of the window, and its length T in s.
    per_line : int
        The number m of frequencies per distance 1/T.
    """

    def __init__(
        self, lines: FloatArray, power: int, window: tuple[str, float] | None, per_line: int = PER_LINE
    ) -> None:
        self.omega, self.weights, self.per_line = lines, None, per_line
        self._settings = lines, power, window
        self._of_block: dict[tuple[int, int], tuple[FloatArray, sp.csr_array]] = {}
        if window is None:
            return
        p = _kernel(window[0], per_line)
        k, spacing = np.arange(len(p)) - len(p) // 2, 2.0 * np.pi / (per_line * window[1])
        at = lines[:, None] / spacing
        near = np.round(at)  # FRFs are shared by lines at multiples of the spacing; files have six digits
        at = np.where(np.abs(at - near) < _ROUNDED * at, near, np.round(at, 6))
        kept = np.abs(k) < 0.5 * at  # no frequencies at or below 0
        p = np.where(kept, p, 0.0)
        weights = p / p.sum(axis=1, keepdims=True) * (1.0 + k / at) ** power
        there, column = np.unique(np.round(at + k, 6)[kept], return_inverse=True)
        self.omega = spacing * there
        self.weights = sp.csr_array((weights[kept], (np.nonzero(kept)[0], column)))

    def twice(self) -> Window:
        """Return the same window with twice as many frequencies."""
        return Window(*self._settings, 2 * self.per_line)

    def agrees(self, finer: Window, solved: Solved, unit: FloatArray) -> bool:
        """Return True if a `finer` window hardly changes the FRFs of a structure at one parameter vector.

        `unit`, (n_frfs, n_lines), are the standard deviations of the lines.
        """
        change = finer.frfs(solved, slice(None)) - self.frfs(solved, slice(None))
        return bool(np.sum(np.abs(change[0] / unit) ** 2) <= _CHANGE**2)

    def cost(self, n_lines: int) -> int:
        """Return the approximate number of frequencies at which FRFs are computed for `n_lines` lines."""
        return n_lines if self.weights is None else n_lines * len(self.omega) // self.weights.shape[0]

    def _block(self, lines: slice) -> tuple[FloatArray, sp.csr_array]:
        """Return the frequencies that a block of lines needs, and the matrix that smooths their receptances."""
        assert self.weights is not None
        start, stop, _ = lines.indices(self.weights.shape[0])
        if (start, stop) not in self._of_block:
            rows = self.weights[start:stop]
            some = np.unique(rows.indices)
            self._of_block[start, stop] = self.omega[some], sp.csr_array(rows[:, some])
        return self._of_block[start, stop]

    def frfs(self, solved: Solved, lines: slice) -> ComplexArray:
        """Return the receptances at a block of lines, shape (n, n_frfs, n_lines)."""
        if self.weights is None:
            return solved.frfs(self.omega[lines])
        omega, weights = self._block(lines)
        return _times(weights, solved.frfs(omega))

    def add(self, solved: Solved, by_frfs: ComplexArray, lines: slice) -> None:
        """Add the contribution of the lines in the last `frfs` call; see `Solved.add`."""
        solved.add(by_frfs if self.weights is None else _times(self._block(lines)[1].T.tocsr(), by_frfs))

    def slopes(self, solved: Solved, lines: slice) -> ComplexArray:
        """Return the derivatives of the receptances at a block of lines, (n, n_frfs, n_lines, n_parameters)."""
        if self.weights is None:
            return solved.slopes(self.omega[lines])
        omega, weights = self._block(lines)
        return np.swapaxes(_times(weights, np.swapaxes(solved.slopes(omega), 2, 3)), 2, 3)

    def smooth(self, of_frequencies: ComplexArray) -> ComplexArray:
        """Return values (…, n) at all frequencies `omega` as values (…, n_lines) at the lines."""
        return of_frequencies if self.weights is None else _times(self.weights, of_frequencies)

    def unit(self, of_lines: FloatArray) -> FloatArray:
        """Return units of errors u, (n_frfs, n), for which Σ |e/u|² bounds the sum over the smoothed errors.

        `of_lines`, shape (n_frfs, n_lines), are the units of the smoothed errors. By Cauchy's inequality,
        |Σ_k p_k e_k|² ≤ Σ_k p_k |e_k|² if the weights p_k have the sum 1.
        """
        if self.weights is None:
            return of_lines
        with np.errstate(divide="ignore"):
            return np.asarray(1.0 / np.sqrt((self.weights.T @ of_lines.T**-2.0).T))


def _kernel(name: str, per_line: int) -> FloatArray:
    """Return the weights p_k for −K ≤ k ≤ K, shape (2 K + 1,), with m = `per_line`.

    K is the smallest number that leaves out less than `_LEFT_OUT` of the weights, but at most `_WIDEST` m.
    """
    spectrum = np.abs(np.fft.fft(window_values(name, _SAMPLES), per_line * _SAMPLES)) ** 2
    p = spectrum[: spectrum.size // 2] / spectrum.sum()
    left_out = 1.0 - (2.0 * np.cumsum(p) - p[0])
    last = min(int(np.argmax(left_out < _LEFT_OUT)), _WIDEST * per_line)
    return np.concatenate([p[last:0:-1], p[: last + 1]])


def _times(weights: sp.csr_array, values: ComplexArray) -> ComplexArray:
    """Return the product of a matrix (m, n) and the last axis of `values`, shape (…, n), as (…, m)."""
    return np.asarray((weights @ values.reshape(-1, values.shape[-1]).T).T.reshape(*values.shape[:-1], -1))
