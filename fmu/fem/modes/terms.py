"""Stiffness and mass terms, which are matrices multiplied by powers of the parameters, and their sums."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp

from fmu.arguments import ArgumentError, check_arguments, shown
from fmu.numbers import typed
from fmu.types import FloatArray, IntArray

Powers = tuple[float, ...]
"""Powers of the parameters in a monomial."""


@check_arguments
@dataclass(frozen=True)
class Term:
    """A matrix multiplied by a monomial in the parameters, Π theta_j ** powers[j].

    Attributes
    ----------
    matrix : array_like or sparse, shape (n_dof, n_dof)
        Symmetric, which is checked when a model is built; includes the constant factor of the monomial. Stored as
        a csr_array of float.
    powers : sequence of int or float, length n_parameters
        Power of each parameter; all are zero for a term that no parameter changes.

    Raises
    ------
    ValueError
        If `matrix` is not a real matrix, or a power is not a finite number.
    """

    matrix: Any
    powers: tuple[float, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "matrix", _as_csr(self.matrix))
        object.__setattr__(self, "powers", tuple(self.powers))

    @property
    def constant(self) -> bool:
        """Whether no parameter changes this term."""
        return not any(self.powers)


def coefficients(terms: Sequence[Term], theta: FloatArray) -> FloatArray:
    """Return the coefficients of `terms`, shape (n, n_terms), at theta of shape (n, n_parameters)."""
    return np.stack([monomial(theta, t.powers) for t in terms], axis=1)


def coefficient_gradients(terms: Sequence[Term], theta: FloatArray) -> FloatArray:
    """Return the coefficient gradients ∂c_k/∂theta_j, shape (n, n_terms, n_parameters)."""
    result = np.zeros((len(theta), len(terms), theta.shape[1]))
    for k, term in enumerate(terms):
        for j, power in enumerate(term.powers):
            if power:
                lowered = tuple(p - (i == j) for i, p in enumerate(term.powers))
                result[:, k, j] = power * monomial(theta, lowered)
    return result


def coefficient_curvatures(terms: Sequence[Term], theta: FloatArray) -> dict[tuple[int, int, int], FloatArray]:
    """Return the second derivatives ∂²c_k/∂theta_i∂theta_j, each of shape (n,), keyed by (k, i, j).

    Derivatives that are zero at every theta are left out.
    """
    found = {}
    for k, term in enumerate(terms):
        powers = np.array(term.powers, dtype=float)
        for i, j in np.ndindex(len(powers), len(powers)):
            lowered = powers - np.eye(len(powers))[i]
            factor = powers[i] * lowered[j]
            if factor:
                found[k, i, j] = factor * monomial(theta, (lowered - np.eye(len(powers))[j]).tolist())
    return found


def monomial(theta: FloatArray, powers: Sequence[float]) -> FloatArray:
    """Return the monomial Π theta[:, j] ** powers[j], shape (n,).

    It is NaN where it is undefined, and infinite on overflow. Each power is a repeated product or is computed for
    one theta at a time, so that a result does not depend on the rest of the batch.
    """
    value = np.ones(len(theta))
    with np.errstate(over="ignore", invalid="ignore"):
        for j, power in enumerate(powers):
            if power == 0:
                continue
            if power == int(power) and 0 < power <= 8:
                for _ in range(int(power)):
                    value = value * theta[:, j]
            else:
                value = value * np.array([_power(float(x), power) for x in theta[:, j]])
    return value


def _power(x: float, power: float) -> float:
    try:
        return math.pow(x, power)
    except OverflowError:
        return math.copysign(math.inf, x) if power % 2.0 == 1.0 else math.inf
    except ValueError:  # zero to a negative power, or a negative number to a fractional one
        return math.nan


def check_terms(name: str, terms: Sequence[Term], n_dof: int, n_parameters: int) -> None:
    """Raise ArgumentError if a term is not symmetric and finite, or has the wrong shape or number of powers.

    The shape must be (n_dof, n_dof), and each parameter must have a finite power.
    """
    for k, term in enumerate(terms):
        if term.matrix.shape != (n_dof, n_dof):
            raise ArgumentError(f"{name}.{k}", f"must have shape {(n_dof, n_dof)}", term.matrix.shape)
        if len(term.powers) != n_parameters:
            raise ArgumentError(f"{name}.{k}", f"must have {n_parameters} powers", len(term.powers))
        if not np.all(np.isfinite(term.powers)):
            raise ArgumentError(f"{name}.{k}", "powers must be finite", term.powers)
        difference = abs(term.matrix - term.matrix.T).max()
        if not difference <= 1e-9 * abs(term.matrix).max():
            raise ArgumentError(f"{name}.{k}", f"must be symmetric and finite (asymmetry {typed(difference)})")


def merge_terms(terms: Sequence[Term]) -> tuple[Term, ...]:
    """Add the matrices of terms that have the same powers, and return the resulting terms."""
    merged: dict[Powers, sp.csr_array] = {}
    for term in terms:
        merged[term.powers] = merged[term.powers] + term.matrix if term.powers in merged else term.matrix
    return tuple(Term(sp.csr_array(matrix), powers) for powers, matrix in merged.items())


def weighted_sum(terms: Sequence[Term], weights: FloatArray) -> sp.csr_array:
    """Return the sparse sum Σ weights[k] · K_k over the terms' matrices K_k.

    Overflow gives inf or NaN without a warning.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        total = terms[0].matrix * weights[0]
        for term, weight in zip(terms[1:], weights[1:], strict=True):
            total = total + term.matrix * weight
    return total


def sum_at(terms: Sequence[Term], theta: FloatArray) -> sp.csr_array:
    """Return the sparse sum of `terms` at theta (n_parameters,). Overflow gives inf or NaN without a warning."""
    return weighted_sum(terms, coefficients(terms, theta[None])[0])


class ParametricMatrix:
    """The matrix Σ_k c_k(θ) K_k: its coefficients, their derivatives, and the sum itself.

    There is a fast path for the common case c_k = θ_j. The sparsity pattern of the sum is determined only once, on
    demand, because adding sparse arrays takes longer than solving a small structure.

    Parameters
    ----------
    terms : sequence of Term
    """

    def __init__(self, terms: Sequence[Term]) -> None:
        self.terms = tuple(terms)
        self.n_parameters = len(self.terms[0].powers)
        self._linear = [k for k, t in enumerate(self.terms) if sorted(filter(None, t.powers)) == [1]]
        self._source = [self.terms[k].powers.index(1) for k in self._linear]
        self._general = [k for k, t in enumerate(self.terms) if k not in self._linear and not t.constant]
        self._slopes = np.zeros((len(self.terms), self.n_parameters))
        self._slopes[self._linear, self._source] = 1.0

    def __getstate__(self) -> dict[str, object]:
        """Return the state for pickling. It omits the sparsity pattern, which is determined again on demand."""
        return {name: value for name, value in self.__dict__.items() if name not in ("_pattern", "_places")}

    @cached_property
    def _pattern(self) -> tuple[IntArray, IntArray, list[tuple[slice | IntArray, FloatArray]]]:
        """Column indices and row pointers of the sum (CSR), and positions and values of each term's entries.

        The positions are ``slice(None)`` for a term that has all the entries of the sum.
        """
        matrices = [sp.csr_array(term.matrix, copy=not term.matrix.has_canonical_format) for term in self.terms]
        for matrix in matrices:
            matrix.sum_duplicates()
        ones = [_with_entries(matrix, np.ones(matrix.nnz)) for matrix in matrices]
        pattern = ones[0]
        for one in ones[1:]:
            pattern = pattern + one
        number = _with_entries(pattern, np.arange(1.0, pattern.nnz + 1.0))  # from 1: a product drops zeros
        parts = [
            (slice(None) if m.nnz == pattern.nnz else one.multiply(number).data.astype(np.int32) - 1, m.data)
            for one, m in zip(ones, matrices, strict=True)
        ]
        return pattern.indices.astype(np.int32), pattern.indptr.astype(np.int32), parts

    @cached_property
    def _places(self) -> IntArray:
        """Positions of the sum's entries in a dense matrix, counted row by row."""
        columns, pointers, _ = self._pattern
        rows = np.repeat(np.arange(len(pointers) - 1), np.diff(pointers))
        return np.ravel_multi_index((rows, columns), self.terms[0].matrix.shape)

    def add_up(self, weights: FloatArray, dense: bool) -> Any:
        """Return Σ_k w_k K_k, dense or sparse, for weights (n_terms,).

        Overflow gives inf or NaN without a warning.
        """
        columns, pointers, parts = self._pattern
        data = np.zeros(len(columns))
        with np.errstate(over="ignore", invalid="ignore"):
            for weight, (where, values) in zip(weights, parts, strict=True):
                data[where] += weight * values
        shape = self.terms[0].matrix.shape
        if dense:
            total = np.zeros(shape)
            total.flat[self._places] = data
            return total
        return sp.csr_array((data, columns, pointers), shape=shape)

    @property
    def is_curved(self) -> bool:
        """Whether any coefficient is neither constant nor equal to a parameter, and so has second derivatives."""
        return bool(self._general)

    def coefficients(self, theta: FloatArray) -> FloatArray:
        """Return the coefficients c_k(θ), shape (n, n_terms), at theta (n, n_parameters)."""
        if len(self._linear) == len(self.terms):
            return theta.take(self._source, axis=1)
        value = np.ones((len(theta), len(self.terms)))
        value[:, self._linear] = theta[:, self._source]
        for k in self._general:
            value[:, k] = monomial(theta, self.terms[k].powers)
        return value

    def contract(self, theta: FloatArray, forms: FloatArray) -> FloatArray:
        """Return Σ_k forms[:, k] ∂c_k/∂theta, shape (n, m, n_parameters), at theta (n, n_parameters).

        `forms`, shape (n, n_terms, m), contains for example the quadratic forms φᵀ K_k φ of m modes.
        """
        # einsum without `optimize` adds term by term, so that a result does not depend on the rest of the batch
        if self._general:
            return np.einsum("nkm,nkj->nmj", forms, coefficient_gradients(self.terms, theta))
        return np.einsum("nkm,kj->nmj", forms, self._slopes)

    def along(self, theta: FloatArray, d: FloatArray) -> FloatArray:
        """Return the derivatives Σ_j ∂c_k/∂theta_j d_j of the coefficients along d, shape (n, n_terms, m).

        `d` has shape (n, m, n_parameters).
        """
        if self._general:
            return np.einsum("nkj,nmj->nkm", coefficient_gradients(self.terms, theta), d)
        return np.einsum("kj,nmj->nkm", self._slopes, d)

    def contract_twice(self, theta: FloatArray, forms: FloatArray) -> FloatArray:
        """Return Σ_kj forms[:, k, :, j] ∂²c_k/∂theta∂theta_j, shape (n, m, n_parameters).

        `forms` has shape (n, n_terms, m, n_parameters).
        """
        total = np.zeros((forms.shape[0], *forms.shape[2:]))
        for (k, i, j), value in coefficient_curvatures(self.terms, theta).items():
            total[..., i] += forms[:, k, :, j] * value[:, None]
        return total

    def contract_along(self, theta: FloatArray, forms: FloatArray, d: FloatArray) -> FloatArray:
        """Return Σ_k forms[:, k] Σ_j ∂²c_k/∂theta∂theta_j d_j: the derivative of `contract` along d.

        `forms`, shape (n, n_terms, m), is constant. Both `d` and the result have shape (n, m, n_parameters).
        """
        return self.contract_twice(theta, forms[..., None] * d[:, None])


def _with_entries(matrix: sp.csr_array, entries: FloatArray) -> sp.csr_array:
    return sp.csr_array((entries, matrix.indices, matrix.indptr), shape=matrix.shape)


def _as_csr(matrix: Any) -> sp.csr_array:
    if not sp.issparse(matrix):
        try:
            matrix = np.asarray(matrix)
        except ValueError:  # rows of different lengths
            raise ArgumentError("matrix", "must be a real matrix", shown(matrix)) from None
    if matrix.ndim != 2 or matrix.dtype.kind not in "fiub":
        raise ArgumentError("matrix", "must be a real matrix", f"{matrix.dtype} of shape {matrix.shape}")
    return sp.csr_array(matrix, dtype=float)


def named_term(given: Any, names: tuple[str, ...], where: str) -> Term:
    """Build a term from a matrix alone, a matrix and its parameter's name, or a matrix and powers keyed by name.

    Parameters
    ----------
    given : Term, matrix, or tuple (matrix, str) or (matrix, mapping of str to float)
        A `Term` is returned unchanged.
    names : tuple of str
        Parameter names, in the order of theta.
    where : str
        Name of the term in an error message.

    Raises
    ------
    ValueError
        If a name is not among `names`, the matrix is not a real matrix, or a power is not a finite number.
    """
    if isinstance(given, Term):
        return given
    paired = isinstance(given, tuple) and len(given) == 2 and isinstance(given[1], str | Mapping)
    matrix, powers = given if paired else (given, {})
    by_name = {powers: 1} if isinstance(powers, str) else dict(powers)
    unknown = sorted(set(by_name) - set(names))
    if unknown:
        raise ArgumentError(where, f"must name parameters among {', '.join(names)}", ", ".join(unknown))
    try:
        return Term(matrix, tuple(by_name.get(name, 0) for name in names))
    except ValueError as error:
        raise ArgumentError.of(error).under(where) from error
