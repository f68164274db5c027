"""Gaussian processes with a linear trend, fitted by scikit-learn.

The prediction at a point is bitwise the same in every batch of points. With x the `Coordinates` of theta, the
prior of a quantity y, scaled to zero mean and unit variance, has the covariance

k(x, x′) = a (1 + xᵀx′) + c exp(−½ Σ_j (x_j − x′_j)²/ℓ_j²) + s² [x = x′].

The first term is a linear trend whose coefficients have variance a. The second is a smooth remainder with length
scales ℓ_j: a parameter without effect has a long one, and does not make the fit harder. The third is the variance
s² of the solver's scatter (Rasmussen & Williams 2006, *Gaussian Processes for Machine Learning*, chapters 2, 5).
The hyper-parameters a, c, ℓ and s² maximise the marginal likelihood. With few points, variation that the smooth
part does not yet represent resembles scatter. Therefore s² stays at its minimum unless a larger value makes the
likelihood exp(`_TELLING`) times as large. Kriging with a polynomial trend of fixed degree is the limit of large a,
or of long ℓ.
"""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING

import numpy as np

from fmu.types import FloatArray

if TYPE_CHECKING:
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import Kernel

LEAST_SCATTER = 1e-10
"""Smallest s² of a quantity of unit variance, which keeps the covariance matrix well-conditioned."""
_TELLING = 12.0
"""Smallest gain in log-likelihood for which scatter is assumed: few points of an exact function give up to 9, and
a scatter of 1e-4 gives 30."""
_CHUNK = 16  # rows of every matrix product: a fixed number, so that the order of summation is always the same
_STARTS = 1.0, 4.0, 15.0  # length scales at which searches start
_BOUNDS = {"trend": (1e-4, 1e3), "smooth": (1e-6, 1e3), "length": (0.1, 1e3), "scatter": (LEAST_SCATTER, 0.1)}


class Process:
    """Gaussian process for q quantities with a common covariance function, conditioned on values at N points.

    Parameters
    ----------
    x : ndarray, shape (N, d)
        The points, in scaled coordinates.
    y : ndarray, shape (N, q)
        Values of the quantities at the points.
    before : Process, optional
        A process whose hyper-parameters are a starting point of the search for new ones.
    search : bool
        Whether hyper-parameters are searched for. If False, `before` must be given, and its hyper-parameters are
        used.

    Attributes
    ----------
    log_likelihood : float
        Log marginal likelihood of the scaled quantities.
    n_hyper : int
        Number of free hyper-parameters.
    caution : float
        Factor applied to the variances: the mean square of the standardised leave-one-out errors (Rasmussen &
        Williams, eq. 5.12), but at least 1.
    left_out_error : float
        Root mean square of the leave-one-out errors, in units of y.
    unit : ndarray, shape (q,)
        Standard deviations by which the quantities were scaled; 1 for a constant quantity.
    scatter : ndarray, shape (q,)
        Standard deviations s of the solver's scatter, in units of y; `relative_scatter` is s of the scaled y.
    most : float
        Largest variance that `predict` gives, scaled and without the factor `caution`; see `limit`. Its initial
        value is the median of the squared leave-one-out errors, divided by `caution`.
    """

    def __init__(self, x: FloatArray, y: FloatArray, before: Process | None = None, search: bool = True) -> None:
        self.x = np.ascontiguousarray(x)
        self._mean, spread = y.mean(axis=0), y.std(axis=0)
        self.unit = np.where(spread > 0.0, spread, 1.0)
        z = (y - self._mean) / self.unit
        fitted = _fit(self.x, z, None if before is None else before.kernel, search)
        self.kernel: Kernel = fitted.kernel_
        self.log_likelihood = float(fitted.log_marginal_likelihood_value_)
        self.n_hyper = len(fitted.kernel_.theta)
        p = self.kernel.get_params()
        self._trend, self._smooth = p["k1__k1__k1__constant_value"], p["k1__k2__k1__constant_value"]
        length = np.broadcast_to(p["k1__k2__k2__length_scale"], x.shape[1])
        self._by_length = 1.0 / length**2
        self._s2 = p["k2__noise_level"]
        from scipy.linalg import cho_solve, solve_triangular

        # the inverse of the factor L of K is used, as K⁻¹ would lose twice as many digits
        self._root = np.ascontiguousarray(solve_triangular(fitted.L_, np.eye(len(x)), lower=True))
        self._alpha = cho_solve((fitted.L_, True), z)
        variance = 1.0 / np.sum(self._root**2, axis=0)
        errors = self._alpha * variance[:, None]
        self.caution = max(1.0, float(np.mean(errors**2 / variance[:, None])))
        self.left_out_error = float(np.sqrt(np.mean((errors * self.unit) ** 2)))
        self.relative_scatter = float(np.sqrt(self._s2))
        self.scatter = self.unit * self.relative_scatter
        self.most = float(np.median(errors**2)) / self.caution

    def values(self, x: FloatArray) -> FloatArray:
        """Return the expected y, shape (n, q), at points x (n, d)."""
        k, _ = self._covariances(x)
        return self._expect(k)

    def limit(self, x: FloatArray) -> None:
        """Limit the variances from `predict` to the largest one at the posterior draws x (n, d).

        If the data contradict the model, a likelihood that includes the surrogate's variance would otherwise
        prefer theta far from all solves to the best-fitting theta.
        """
        k, _ = self._covariances(x)
        self.most = float(np.max(self._remaining_variance(x, _product(k, self._root.T))))

    def predict(self, x: FloatArray, limited: bool = True) -> tuple[FloatArray, FloatArray]:
        """Return the expected y at x (n, d) and its variance without the solver's scatter, (n, q) each.

        If `limited`, the variances are capped; see `limit`.
        """
        k, _ = self._covariances(x)
        left = self._remaining_variance(x, _product(k, self._root.T))
        return self._expect(k), self._variance(np.minimum(left, self.most) if limited else left)

    def predict_with_slopes(self, x: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return the two arrays from `predict`, and their derivatives with respect to x, (n, q, d) each.

        Where a variance is capped, or zero because of rounding, its derivatives are zero.
        """
        k, smooth = self._covariances(x)
        u = _product(k, self._root.T)
        w = _product(u, self._root)
        d = x.shape[1]
        slopes, by_variance = np.empty((len(x), self._alpha.shape[1], d)), np.empty((len(x), d))
        for j in range(d):
            dk = self._trend * self.x[:, j] - self._by_length[j] * (x[:, j, None] - self.x[:, j]) * smooth
            slopes[:, :, j] = np.sum(dk[:, None, :] * self._alpha.T, axis=2)
            by_variance[:, j] = 2.0 * (self._trend * x[:, j] - np.sum(w * dk, axis=1))
        left = self._remaining_variance(x, u)
        by_variance[(left <= 0.0) | (left >= self.most)] = 0.0
        slopes *= self.unit[:, None]
        return (
            self._expect(k),
            self._variance(np.minimum(left, self.most)),
            slopes,
            self._variance(by_variance[:, None]),
        )

    def covariance(self, x: FloatArray) -> tuple[FloatArray, float]:
        """Return the posterior covariance of the scaled y between points x (n, d), shape (n, n), and s².

        Both include the factor `caution`. Multiplied by the square of `unit`, they are in units of y².
        """
        k, _ = self._covariances(x)
        prior = self._trend * (1.0 + x @ x.T) + self._smooth * np.exp(-0.5 * _squares(x, x, self._by_length))
        u = k @ self._root.T
        return self.caution * (prior - u @ u.T), self.caution * self._s2

    def _covariances(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the prior covariances between x and the N points, and their smooth part, (n, N) each."""
        smooth = self._smooth * np.exp(-0.5 * _squares(x, self.x, self._by_length))
        trend = np.ones_like(smooth)
        for j in range(x.shape[1]):
            trend += x[:, j, None] * self.x[:, j]
        return self._trend * trend + smooth, smooth

    def _expect(self, k: FloatArray) -> FloatArray:
        return self._mean + self.unit * np.sum(k[:, None, :] * self._alpha.T, axis=2)

    def _remaining_variance(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the posterior variance (n,) of the scaled y: k(x, x) − uᵀu, where u = L⁻¹k has shape (n, N).

        k are the covariances with the N points, and L is the Cholesky factor of their covariance matrix.
        """
        own = np.ones(len(x))
        for j in range(x.shape[1]):
            own += x[:, j] ** 2
        return self._trend * own + self._smooth - np.sum(u**2, axis=1)

    def _variance(self, scaled: FloatArray) -> FloatArray:
        """Convert scaled variances (n,), or their derivatives (n, 1, d), to units of y², and apply `caution`.

        The result has shape (n, q) or (n, q, d). Variances that are negative because of rounding are set to zero.
        """
        if scaled.ndim == 1:
            return self.caution * self.unit**2 * np.maximum(scaled, 0.0)[:, None]
        return self.caution * (self.unit**2)[:, None] * scaled


def _product(k: FloatArray, matrix: FloatArray) -> FloatArray:
    """Return k (n, N) times a matrix (N, N), in chunks of equal size so that no row depends on the others."""
    n, N = k.shape
    padded = np.zeros((-(-n // _CHUNK) * _CHUNK, N))
    padded[:n] = k
    return (padded.reshape(-1, _CHUNK, N) @ matrix).reshape(-1, N)[:n]


def _squares(x: FloatArray, other: FloatArray, weights: FloatArray) -> FloatArray:
    """Return weighted squared distances Σ_j w_j (x_j − x′_j)² between all pairs of points, shape (n, N).

    They are always summed in the same order.
    """
    total = np.zeros((len(x), len(other)))
    for j, weight in enumerate(weights):
        total += weight * (x[:, j, None] - other[:, j]) ** 2
    return total


def _fit(x: FloatArray, z: FloatArray, kernel: Kernel | None, search: bool) -> GaussianProcessRegressor:
    """Fit a scikit-learn regressor to z (N, q) at x (N, d), and return it.

    If `search` is False, the hyper-parameters of `kernel` are kept. Otherwise the search starts from `kernel`, if
    given, and from other kernels. Scatter above its minimum is kept only if it raises the log-likelihood by more
    than `_TELLING`.
    """
    from sklearn.base import clone
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, DotProduct, WhiteKernel

    def start(length: float) -> Kernel:
        return (
            ConstantKernel(1.0, _BOUNDS["trend"]) * DotProduct(1.0, "fixed")
            + ConstantKernel(0.1, _BOUNDS["smooth"]) * RBF(np.full(x.shape[1], length), _BOUNDS["length"])
            + WhiteKernel(1e-6, _BOUNDS["scatter"])
        )

    def fit_process(kernel: Kernel, optimizer: str | None) -> GaussianProcessRegressor:
        return GaussianProcessRegressor(kernel, alpha=0.0, optimizer=optimizer).fit(x, z)

    if not search:
        return fit_process(kernel, None)
    starts = [*map(start, _STARTS)] if kernel is None else [kernel, start(_STARTS[-1])]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # parameters without effect reach the length's bound
        # the likelihood may have several maxima: one of them explains all variation by scatter
        best = max(
            (fit_process(one, "fmin_l_bfgs_b") for one in starts),
            key=lambda one: one.log_marginal_likelihood_value_,
        )
        exact = fit_process(
            clone(best.kernel_).set_params(k2__noise_level=LEAST_SCATTER, k2__noise_level_bounds="fixed"),
            "fmin_l_bfgs_b",
        )
        gain = best.log_marginal_likelihood_value_ - exact.log_marginal_likelihood_value_
        if gain > _TELLING:
            return best
        exact.kernel_.set_params(k2__noise_level_bounds=_BOUNDS["scatter"])
        return exact
