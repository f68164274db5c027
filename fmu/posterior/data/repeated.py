"""Average repeated tests of one structure: the mean of the measured modes, and its uncertainty."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fmu.arguments import ArgumentError
from fmu.numbers import fixed
from fmu.posterior.data.estimated_sd import gaussian_sd, joint_scores, student_scores, to_chi_square
from fmu.types import FloatArray, IntArray, Plain

SCATTERS = ("each", "pooled", "joint")
FEW = 10
"""Number of values of a mode below which the scatter is pooled by default."""
LEAST_MAC = 0.5
"""Smallest MAC of the shape from one test with the mean of all tests; a lower value indicates another mode."""
_NO_SCATTER = 1e-9
"""Scatter of shapes of unit length below which the shapes differ by rounding only."""


class MeanFrequencies(NamedTuple):
    """Mean frequencies (n_modes,), Hz, with standard deviations (n_modes,), Hz, or a covariance matrix, Hz²."""

    frequencies_hz: FloatArray
    sd_hz: FloatArray | None
    covariance_hz2: FloatArray | None


class _Scatter(NamedTuple):
    """For each mode: the mean and sample standard deviation, Hz, degrees of freedom, and number of values."""

    mean: FloatArray
    s: FloatArray
    nu: NDArray[np.int64]
    n: NDArray[np.int64]


def _check_frequencies(frequencies: ArrayLike, scatter: str | None) -> FloatArray:
    """Return frequencies as an array (n_tests, n_modes); raise ValueError if an argument is invalid."""
    values = np.array(frequencies, dtype=float)
    if values.ndim != 2 or values.size == 0:
        raise ArgumentError("frequencies", "must have shape (n_tests, n_modes)", values.shape)
    if scatter is not None and scatter not in SCATTERS:
        raise ArgumentError("scatter", f"must be one of {SCATTERS}", repr(scatter))
    wrong = ~np.isnan(values) & ~(np.isfinite(values) & (values > 0))
    if wrong.any():
        i, j = map(int, np.unravel_index(np.argmax(wrong), wrong.shape))
        raise ArgumentError(f"frequencies.{i}.{j}", "must be positive and finite, or NaN", f"{values[i, j]} Hz")
    n = np.sum(~np.isnan(values), axis=0)
    if n.min() < 2:
        at = int(np.argmin(n))
        raise ArgumentError("frequencies", "every mode must have at least 2 values", f"{n[at]} of mode {at + 1}")
    return values


def _scatter(values: FloatArray, scatter: str | None) -> _Scatter:
    """Return each mode's scatter, estimated separately or, if `scatter` is "pooled", as one relative scatter.

    Raise ValueError if a mode's values (if pooled, the values of all modes) do not differ between tests.
    """
    n = np.sum(~np.isnan(values), axis=0)
    mean, s = np.nanmean(values, axis=0), np.nanstd(values, axis=0, ddof=1)
    nu = n - 1
    if scatter == "pooled":
        s = mean * np.sqrt(np.sum(nu * (s / mean) ** 2) / np.sum(nu))
        nu = np.full(len(n), np.sum(nu))
    if not np.all(s > 0):
        raise ArgumentError(
            "frequencies",
            "the values of a mode must differ between tests, or their scatter says nothing",
            f"{mean[np.argmin(s)]} Hz only, of mode {np.argmin(s) + 1}",
        )
    return _Scatter(mean, s, nu, n)


@dataclass(frozen=True, eq=False)
class RepeatedTests:
    """Frequencies from repeated tests, in the order in which the tests were made.

    Attributes
    ----------
    frequencies_hz : ndarray, shape (n_tests, n_modes)
        Frequencies, with NaN where a test missed a mode; every mode needs at least two values.
    scatter : {"each", "pooled", "joint"}, optional
        Defaults to "pooled" if a mode has fewer than ten values, otherwise to "each".

        "each": independent modes, each with the scatter of its own n_i values and ν = n_i − 1 degrees of freedom.
        This assumes nothing about other modes. But a few tests of a mode may agree closely by chance, and the mode
        then gets too much weight. If 3, 6 or 12 modes determine a parameter equally well, its 95 % interval holds
        the truth in 87, 78 or 63 % of the cases for two tests, 87, 81 or 75 % for three, 91, 90 or 85 % for five,
        and 94, 93 or 93 % for ten.

        "pooled": independent modes with one *relative* scatter, s_i = c f_i with c² = Σ ν_i (s_i/f_i)² / Σ ν_i and
        ν = Σ ν_i. The intervals above then hold the truth in 93 to 97 % of the cases, and in 90 to 92 % if the
        logarithms of the modes' true relative scatters have a standard deviation of 1.

        "joint": a full covariance, for modes whose frequencies vary together, for example with temperature. Let S
        be the sample covariance of n tests. With the prior ∝ |Σ|^(−(n_modes + 1)/2) the mean has a multivariate
        Student distribution (Gelman et al. 2013, Bayesian Data Analysis, 3rd ed., section 3.6). The covariance of
        this distribution, S (n − 1)/(n (n − n_modes − 2)), is used. It exists if n ≥ n_modes + 3 and no test
        missed a mode. With fewer tests, S is singular or nearly so.
    shapes : array_like, shape (n_tests, n_sensors, n_modes), optional
        Shapes measured in the tests, as in `shapes_sd`.

    Raises
    ------
    ValueError
        If `frequencies_hz` is not two-dimensional, a frequency is not positive and finite (or NaN), a mode has too
        few values, `scatter` is unknown, or `shapes` are of other tests or modes; if the values of a mode ("each")
        or of all modes ("pooled") do not differ between tests; or if there are too few tests, or a test missed a
        mode ("joint").

    Notes
    -----
    The scatter measures repeatability only. Errors that all tests share (the mass of the sensors, that day's
    weather, identification bias, model error) do not average out and are not included.
    """

    frequencies_hz: ArrayLike
    scatter: str | None = None
    shapes: ArrayLike | None = None

    def __post_init__(self) -> None:
        values = _check_frequencies(self.frequencies_hz, self.scatter)
        values.flags.writeable = False
        if self.scatter is None:
            fewest = np.sum(~np.isnan(values), axis=0).min()
            object.__setattr__(self, "scatter", "pooled" if fewest < FEW else "each")
        object.__setattr__(self, "frequencies_hz", values)
        shape = None if self.shapes is None else np.shape(self.shapes)
        if shape is not None and (len(shape) != 3 or shape[::2] != values.shape):
            n_tests, n_modes = values.shape
            raise ArgumentError("shapes", f"must have shape ({n_tests}, n_sensors, {n_modes})", shape)
        self.mean()

    def mean(self) -> MeanFrequencies:
        """Return the mean over the tests, and its uncertainty estimated from the scatter between the tests.

        With a joint scatter, the uncertainty is the covariance in the description of `scatter`. Otherwise, let
        mode i have n_i tests, the sample standard deviation s_i, and ν degrees of freedom. The mean's error
        divided by s_i/√n_i has Student's t distribution, because s_i is itself an estimate. This distribution is
        replaced by the Gaussian with the same central 95 % interval. The Gaussian's standard deviation is s_i/√n_i
        · t_0.975(ν)/1.96 (the expanded uncertainty in JCGM 100:2008, GUM, annex G.3, divided by the normal
        factor). This is 6.5 s_i/√n_i for two tests, 2.2 s_i/√n_i for three, 1.4 s_i/√n_i for five and 1.05
        s_i/√n_i for twenty-five, if the scatter is not pooled.
        """
        values = np.asarray(self.frequencies_hz)
        if self.scatter == "joint":
            return _joint(values)
        found = _scatter(values, self.scatter)
        return MeanFrequencies(found.mean, found.s / np.sqrt(found.n) * gaussian_sd(found.nu), None)

    def gave(self, sd_hz: ArrayLike | None, covariance_hz2: ArrayLike | None) -> bool:
        """Return True if the standard deviations, Hz, or the covariance, Hz², are those from `mean`."""
        mean = self.mean()
        pairs = ((mean.sd_hz, sd_hz), (mean.covariance_hz2, covariance_hz2))
        return any(
            own is not None and given is not None and np.allclose(own, given, rtol=1e-9, atol=0.0)
            for own, given in pairs
        )

    def freedom_of_shapes(self, sd: ArrayLike | None) -> FloatArray | None:
        """Return ν of each mean shape, (n_modes,), or None if `sd`, (n_sensors, n_modes), is not `shapes_sd`."""
        found = None if sd is None or self.shapes is None else shapes_sd(self.shapes)
        if found is None or not np.allclose(sd, found, rtol=1e-9, atol=0.0):  # type: ignore[arg-type]
            return None
        shapes = np.asarray(self.shapes, dtype=float)
        return (np.sum(~np.isnan(shapes).all(axis=1), axis=0) - 1.0) * (shapes.shape[1] - 1.0)

    def normal_scores(self, z: FloatArray, used: IntArray | None = None) -> FloatArray:
        """Convert errors of the mean, divided by the standard deviations from `mean`, to standard normal scores.

        The Gaussian in `mean` has the central 95 % interval of Student's t distribution but not its tails: with
        three tests, one error in a hundred exceeds four of these standard deviations. If each mode has its own
        scatter, let t be the error divided by s_i/√n_i, and F the distribution function of Student's t. The score
        Φ⁻¹(F(t)) is exactly standard normal.

        Otherwise, all modes share one estimated scatter, and large errors come together. If the scatter is joint,
        z are errors whitened by the covariance of the k modes, and each gets the score of its distribution given
        the modes before it (`joint_scores`). If it is pooled, the errors z of k modes are all multiplied by one
        factor, which gives Σ z² the chi-square distribution with k degrees of freedom (`to_chi_square`): g² Σ z²/k
        has the distribution F(k, ν), where g is `gaussian_sd`.

        Parameters
        ----------
        z : ndarray, shape (..., n_modes)
        used : ndarray of int, shape (k,), optional
            Indices (from 0) of the k modes. Defaults to all modes. The scores of other modes have no meaning.
        """
        if self.scatter == "each":
            return student_scores(z, self.freedom)
        at = np.arange(z.shape[-1]) if used is None else used
        if self.scatter == "joint":
            scores = np.array(z)
            scores[..., at] = joint_scores(z[..., at], *np.shape(self.frequencies_hz))
            return scores
        q = np.sum(z[..., at] ** 2, axis=-1, keepdims=True)
        return z * to_chi_square(q, len(at), self.freedom[0], gaussian_sd(self.freedom[0]) ** 2)

    @property
    def freedom(self) -> FloatArray:
        """Degrees of freedom of each mean's error, shape (n_modes,)."""
        values = np.asarray(self.frequencies_hz)
        if self.scatter == "joint":
            return np.full(values.shape[1], float(values.shape[0] - values.shape[1]))
        return np.asarray(_scatter(values, self.scatter).nu, dtype=float)

    def freedom_given_others(self, used: IntArray | None) -> FloatArray:
        """Return the degrees of freedom of each mean's error, (n_modes,), given the errors of the other modes.

        Let k be the number of other modes in `used` (indices; None for all modes). If the scatter is pooled, their
        errors add k degrees of freedom to ν. If it is joint, the regression on them leaves n − 1 − k.
        """
        if self.scatter == "each":
            return self.freedom
        n, n_modes = np.shape(self.frequencies_hz)
        k = (n_modes if used is None else len(used)) - 1
        return np.full(n_modes, n - 1.0 - k) if self.scatter == "joint" else self.freedom + k

    def widened_given_others(self, squares: FloatArray, own: FloatArray, used: IntArray | None) -> FloatArray:
        """Return factors (n, n_modes) on the sds of errors that are predicted from the other modes' errors.

        If the other modes err by more than the common scatter suggests, this scatter is probably larger. Let q be
        the sum of their squared errors, in the sds from `mean`, and ν' `freedom_given_others`. The error divided
        by its scale has Student's distribution with ν' degrees of freedom. With a pooled scatter, the squared
        scale is (ν + g² q)/ν' times s_i²/n_i, where g is `gaussian_sd` of ν (Ding 2016, *Am. Stat.* 70, 293). With
        a joint scatter, it is (n − n_modes − 2 + q)/ν' times the variance given the other modes, as in a
        prediction by regression on them. The factors are for the Gaussian with the same central 95 % interval.

        Parameters
        ----------
        squares : ndarray, shape (n, n_modes)
            Squared errors, whitened if the scatter is joint. The sum over the `used` modes minus `own` is q.
        own : ndarray, shape (n, n_modes)
            Each mode's part of the sum; if the scatter is joint, its part given the other modes.
        used : ndarray of int, shape (k + 1,), or None for all modes
        """
        if self.scatter == "each":
            return np.ones_like(own)
        (n, n_modes), nu = np.shape(self.frequencies_hz), self.freedom_given_others(used)
        q = np.sum(squares if used is None else squares[:, used], axis=1, keepdims=True) - own
        q = np.maximum(q, 0.0)  # of modes that are not used, whose factors have no meaning
        if self.scatter == "joint":
            return np.asarray(np.sqrt((n - n_modes - 2.0 + q) / nu) * gaussian_sd(nu))
        g = gaussian_sd(self.freedom)
        return np.asarray(np.sqrt((self.freedom + g**2 * q) / nu) * gaussian_sd(nu) / g)

    def simulate(self, rng: np.random.Generator, size: int) -> FloatArray:
        """Draw the differences between one further test's frequencies and the true ones, (size, n_modes), Hz.

        A single test's standard deviation, estimated from n tests, is integrated out with the prior ∝ 1/s. The
        differences are then s_i times Student's t with ν_i degrees of freedom. For very few tests, the predictive
        interval from a model that can fit the mean is a little too wide, because the Gaussian in `mean` is widened
        too. A 90 % interval then covers 92 % for two tests, 91 % for three, and 90 % for five or more. If the
        scatter is "joint", the differences have the multivariate t distribution with n − n_modes degrees of
        freedom and the scale matrix (n − 1) S/(n − n_modes), under the prior described for `scatter`.
        """
        values, t = np.asarray(self.frequencies_hz), self._student(rng, size)
        if self.scatter != "joint":
            return np.asarray(_scatter(values, self.scatter).s * t)
        centred = values - values.mean(axis=0)
        root = np.linalg.cholesky(centred.T @ centred / (values.shape[0] - values.shape[1]))
        return np.asarray(t @ root.T)

    def standard_errors(self, rng: np.random.Generator, size: int) -> FloatArray:
        """Draw errors of the mean of as many new tests, divided by the sds from `mean`, shape (size, n_modes).

        They are Student's t divided by `gaussian_sd`. If the scatter is joint, they are multivariate Student's t
        with the identity matrix as covariance.
        """
        t = self._student(rng, size)
        if self.scatter == "joint":
            return np.asarray(t * np.sqrt((self.freedom - 2.0) / self.freedom))
        return np.asarray(t / gaussian_sd(self.freedom))

    def _student(self, rng: np.random.Generator, size: int) -> FloatArray:
        """Draw values of Student's t, (size, n_modes), with a common chi-square value if the scatter is common."""
        z = rng.standard_normal((size, np.shape(self.frequencies_hz)[1]))
        if self.scatter == "each":
            return np.asarray(z / np.sqrt(rng.chisquare(self.freedom, z.shape) / self.freedom))
        return np.asarray(z / np.sqrt(rng.chisquare(self.freedom[0], (size, 1)) / self.freedom[0]))

    def relative_scatter(self) -> FloatArray:
        """Return the relative standard deviations of the frequencies in one test, s_i/f_i, shape (n_modes,)."""
        found = _scatter(np.asarray(self.frequencies_hz), self.scatter)
        return np.asarray(found.s / found.mean)

    def of_modes(self, at: IntArray) -> RepeatedTests:
        """Return the same tests with only the modes at these indices (from 0)."""
        shapes = None if self.shapes is None else np.asarray(self.shapes)[..., at]
        return replace(self, frequencies_hz=np.asarray(self.frequencies_hz)[:, at], shapes=shapes)

    def as_dict(self) -> dict[str, Plain]:
        """Return the frequencies and the scatter as a dict. A frequency is None if a test missed the mode."""
        rows = [[None if np.isnan(f) else float(f) for f in row] for row in np.asarray(self.frequencies_hz)]
        return {"frequencies_hz": rows, "scatter": self.scatter}


def _joint(values: FloatArray) -> MeanFrequencies:
    n, n_modes = values.shape
    if np.isnan(values).any():
        raise ArgumentError("frequencies", 'must have no NaN where scatter is "joint"')
    if n < n_modes + 3:
        raise ArgumentError(
            "frequencies",
            f'must be of at least {n_modes + 3} tests, 3 more than modes, where scatter is "joint"',
            n,
        )
    centred = values - values.mean(axis=0)
    return MeanFrequencies(values.mean(axis=0), None, centred.T @ centred / (n * (n - n_modes - 2)))


def mean_shapes(shapes: ArrayLike, least_mac: float = LEAST_MAC) -> FloatArray:
    """Return the mean of the tests' mode shapes, (n_sensors, n_modes), after giving them a common scale and sign.

    Each shape is scaled to unit length, with the sign that makes its scalar product with the common direction
    (the first eigenvector of Σ φφᵀ) positive. The mean has unit length and the sign of the first test that did not
    miss the mode.

    Parameters
    ----------
    shapes : array_like, shape (n_tests, n_sensors, n_modes)
        All NaN where a test missed a mode.
    least_mac : float
        Smallest MAC between a shape and the mean; a smaller one indicates another mode.

    Raises
    ------
    ValueError
        If the array does not have three dimensions, a shape is zero or not finite, a mode has no shape in any
        test, or the MAC between a shape and the mean is below `least_mac`.
    """
    values = _checked_shapes(shapes)
    return np.stack([_align_shapes(values[:, :, k], k + 1, least_mac)[1] for k in range(values.shape[2])], axis=1)


def shapes_sd(shapes: ArrayLike) -> FloatArray | None:
    """Return the standard deviation of each mean shape's components, (n_modes,), from the scatter between tests.

    For one mode, let u_j be the n unit-length shapes with the same sign, and m their mean. The components of u_j
    orthogonal to m scatter in n_sensors − 1 directions: s² = Σ_j |u_j − (u_jᵀm) m|² / ν with ν = (n − 1)(n_sensors
    − 1). The same s is assumed for all sensors. The mean's standard deviation is s/√n, widened for few tests as in
    `RepeatedTests.mean`. Return None if a mode has fewer than two shapes, there is only one sensor, or a mode's
    shapes do not differ.

    Parameters
    ----------
    shapes : array_like, shape (n_tests, n_sensors, n_modes)
        All NaN where a test missed a mode.

    Raises
    ------
    ValueError
        In the cases listed for `mean_shapes`.
    """
    values = _checked_shapes(shapes)
    sd = np.zeros(values.shape[2])
    for k in range(len(sd)):
        unit, mean = _align_shapes(values[:, :, k], k + 1)
        n, n_sensors = unit.shape
        nu = (n - 1) * (n_sensors - 1)
        if nu:
            across = unit - (unit @ mean)[:, None] * mean
            sd[k] = np.sqrt(np.sum(across**2) / (nu * n)) * gaussian_sd(nu)
    return sd if np.all(sd > _NO_SCATTER) else None


def _checked_shapes(shapes: ArrayLike) -> FloatArray:
    values = np.array(shapes, dtype=float)
    if values.ndim != 3 or values.size == 0:
        raise ArgumentError("shapes", "must have shape (n_tests, n_sensors, n_modes)", values.shape)
    return values


def _align_shapes(shapes: FloatArray, mode: int, least_mac: float = LEAST_MAC) -> tuple[FloatArray, FloatArray]:
    """Return one mode's measured shapes with unit length and the same sign, and their mean.

    Tests that missed the mode are left out. Raise the errors listed in `mean_shapes`.
    """
    tests = np.flatnonzero(~np.isnan(shapes).all(axis=1))
    if not len(tests):
        raise ArgumentError("shapes", "every mode must be in a test", f"none of mode {mode}")
    length = np.linalg.norm(shapes[tests], axis=1)
    if not np.all(np.isfinite(length) & (length > 0)):
        at = tests[np.argmin(np.isfinite(length) & (length > 0))]
        raise ArgumentError(f"shapes.{at}", f"mode {mode} must be finite and not zero, or NaN at every sensor")
    unit = shapes[tests] / length[:, None]
    common = np.linalg.svd(unit)[2][0]
    turned = unit * np.where(unit @ common < 0, -1.0, 1.0)[:, None]
    mean = turned.mean(axis=0) / np.linalg.norm(turned.mean(axis=0))
    mac = (unit @ mean) ** 2
    if mac.min() < least_mac:
        at = tests[np.argmin(mac)]
        raise ArgumentError(
            f"shapes.{at}",
            f"mode {mode} must have a MAC of at least {least_mac} with the mean of all tests",
            fixed(float(mac.min()), 2),
            ": is it the same mode?",
        )
    sign = 1.0 if unit[0] @ mean > 0 else -1.0
    return sign * turned, sign * mean
