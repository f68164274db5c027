"""Problem files with their matrices beside them, and measurements made from a planted truth."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import scipy.linalg as sl
import scipy.sparse as sp


@dataclass(frozen=True)
class Planted:
    """A problem file, and what its measurement was made with.

    Attributes
    ----------
    path : Path
    truth : dict of str to float
    frequencies_hz : callable
        Maps values of the parameters, a dict, to all frequencies wanted, by a dense solver.
    """

    path: Path
    truth: dict[str, float]
    frequencies_hz: object = field(repr=False)


def dense_frequencies(K, M, count):
    """Return the lowest elastic frequencies of K φ = λ M φ in Hz, (count,), by LAPACK; M may be singular.

    The inverse problem M x = μ (K + s M) x has the digits of the lowest modes, whatever M lacks.
    """
    K, M = (np.asarray(A.toarray() if sp.issparse(A) else A) for A in (K, M))
    shift = np.trace(K) / np.trace(M) * 1e-6
    scale = 1.0 / np.sqrt(np.diag(K + shift * M))
    A, B = (scale[:, None] * X * scale for X in (K + shift * M, M))
    mu = sl.eigh(B, A, eigvals_only=True)[::-1]
    lam = 1.0 / mu[: count + 12] - shift
    elastic = lam[lam > 1e-9 * lam[-1]]
    return np.sqrt(elastic[:count]) / (2.0 * np.pi)


def write_problem(folder, name, matrices, dofs, truth, bounds, frequencies, sd, **options):
    """Write matrices and a problem file.

    Parameters
    ----------
    folder : Path
    name : str
    matrices : dict of str to list of (matrix, dict of str to float)
        ``"stiffness"`` and ``"mass"``: each matrix with the powers of the parameters that multiply it.
    dofs : sequence of (node, direction)
    truth : dict of str to float
    bounds : dict of str to (float, float)
    frequencies, sd : ndarray, shape (n_modes,), Hz
    options : str
        Lines of ``[model]`` and of ``[measurement]``, the line of the prior, and those at the top.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    text = [f'name = "{name}"', options.get("top", ""), "[model]", 'type = "matrices"', options.get("model", "")]
    text.append("dofs = [" + ", ".join(f'[{node}, "{direction}"]' for node, direction in dofs) + "]")
    for what, terms in matrices.items():
        for i, (matrix, powers) in enumerate(terms):
            file = f"{name}-{what}-{i}.npz"
            sp.save_npz(folder / file, sp.csr_matrix(matrix))
            text += [f"[[model.{what}]]", f'file = "{file}"']
            if powers:
                text.append("powers = {" + ", ".join(f'"{p}" = {power}' for p, power in powers.items()) + "}")
    text += ["[measurement]", f"frequencies = {_row(frequencies)}", f"sd = {_row(sd)}"]
    text.append(options.get("measurement", ""))
    for parameter, (lower, upper) in bounds.items():
        text += ["[[parameters]]", f'name = "{parameter}"', 'unit = "1"', f"lower = {lower}", f"upper = {upper}"]
        text += [f"start = {options.get('start', 1.0)}", options.get("prior", "")]
    path = folder / f"{name}.toml"
    path.write_text("\n".join(text) + "\n", encoding="utf-8")
    return path


def _row(values):
    return "[" + ", ".join(repr(float(value)) for value in values) + "]"
