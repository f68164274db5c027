"""The lowest modes of a structure in extended precision, a reference for every solver of fmu.

The stiffness is factorised, K = L D Lᵀ, and every iteration done in `numpy.longdouble`, with 64 bits of mantissa
or more where the machine has them. In natural order the models of `tests.models.random_models` have a narrow band.
"""

import numpy as np
import scipy.sparse as sp

LONG = np.longdouble
HAS_DIGITS = np.finfo(LONG).eps < 1e-18
"""Whether this machine has such numbers."""
_MORE, _MOST = 12, 400
_ROUNDED = 10.0 * np.finfo(LONG).eps


class Banded:
    """The factors L D Lᵀ of a symmetric matrix of small bandwidth, without pivoting.

    Parameters
    ----------
    matrix : sparse array of longdouble, shape (n, n)
    """

    def __init__(self, matrix):
        entries = sp.coo_array(matrix)
        n, b = matrix.shape[0], int(np.max(np.abs(entries.row - entries.col), initial=0)) + 1
        above = entries.row <= entries.col
        A = np.zeros((n + b, b), dtype=LONG)
        np.add.at(A, (entries.row[above], (entries.col - entries.row)[above]), entries.data[above])
        padded = np.zeros(2 * b, dtype=LONG)
        shifted = np.lib.stride_tricks.sliding_window_view(padded, b)
        for j in range(n):
            if not A[j, 0] > 0.0:
                raise np.linalg.LinAlgError(f"pivot {j} of {n} is not positive")
            own = A[j, 1:].copy()
            A[j, 1:] /= A[j, 0]
            padded[: b - 1] = A[j, 1:]
            A[j + 1 : j + b] -= own[:, None] * shifted[: b - 1]
        self._n, self._b, self._D, self._L = n, b, A[:n, 0].copy(), A[:n, 1:].copy()

    def solve(self, loads):
        """Return A⁻¹ b for b of shape (n, m)."""
        n, b = self._n, self._b
        x = np.zeros((n + b, loads.shape[1]), dtype=LONG)
        x[:n] = loads
        for j in range(n):
            x[j + 1 : j + b] -= self._L[j][:, None] * x[j]
        x[:n] /= self._D[:, None]
        for j in range(n - 1, -1, -1):
            x[j] -= self._L[j] @ x[j + 1 : j + b]
        return x[:n]


def long_sum(terms, theta):
    """Return Σ_k c_k(theta) K_k, summed in extended precision, as a sparse array."""
    total = sp.csr_array(terms[0].matrix.shape, dtype=LONG)
    for term in terms:
        weight = np.prod(theta.astype(LONG) ** np.array(term.powers))
        total = total + sp.csr_array(term.matrix, dtype=LONG) * weight
    return total


def rounded(K, rng):
    """Return a sparse symmetric K whose entries are changed at random, by at most a rounding."""
    upper = sp.triu(K, format="csr")
    upper.data = upper.data * (1 + LONG(2.0**-53) * rng.uniform(-1.0, 1.0, len(upper.data)))
    return sp.csr_array(upper + sp.triu(upper, 1).T)


def elastic_modes(K, M, count, rigid=None):
    """Return the lowest elastic λ (count,) and mass-normalised shapes (n, count) of K φ = λ M φ.

    Parameters
    ----------
    K, M : sparse arrays of longdouble, shape (n, n)
    count : int
    rigid : ndarray, shape (n, 6), optional
        The rigid-body motions of a free structure, of which the first node's six degrees of freedom are held.

    Notes
    -----
    Subspace iteration. Small problems are solved in double precision: a rotation that is wrong in its last digit
    changes a Rayleigh quotient, which is taken in extended precision, by the square of that.
    """
    n, sizes = K.shape[0], abs(K)
    held = 0 if rigid is None else rigid.shape[1]
    factors = Banded(K[held:, held:])
    N = np.zeros((n, 0), dtype=LONG) if rigid is None else _orthonormal(rigid.astype(LONG), M)
    MN = M @ N

    def elastic(X):
        return X - N @ (MN.T @ X)

    X = elastic(np.random.default_rng(0).standard_normal((n, min(count + _MORE, n - held))).astype(LONG))
    before = np.full(count, np.inf)
    for _ in range(_MOST):
        load = M @ X
        load = load - MN @ (N.T @ load)
        X = np.zeros_like(X)
        X[held:] = factors.solve(load[held:])
        X = _orthonormal(elastic(X), K)
        X = X @ np.linalg.eigh((X.T @ (M @ X)).astype(float))[1][:, ::-1]
        Y = X[:, :count]
        mass = np.sum(Y * (M @ Y), axis=0)
        lam = np.sum(Y * (K @ Y), axis=0) / mass
        # what cancels in φᵀKφ limits the digits here too
        cancels = np.sum(np.abs(Y) * (sizes @ np.abs(Y)), axis=0) / mass
        if np.all(np.abs(lam - before) <= 1e-13 * lam + _ROUNDED * cancels):
            return lam, Y / np.sqrt(mass)
        before = lam
    raise ArithmeticError(f"subspace iteration: {_MOST} steps are not enough")


def _orthonormal(X, A):
    """Return a basis of the columns of X (n, m) with Xᵀ A X = 1, by Gram and Schmidt."""
    X = X / np.sqrt(np.sum(X * (A @ X), axis=0))
    for k in range(X.shape[1]):
        for _ in range(2):  # twice against rounding
            X[:, k] -= X[:, :k] @ (X[:, :k].T @ (A @ X[:, k]))
            X[:, k] /= np.sqrt(X[:, k] @ (A @ X[:, k]))
    return X
