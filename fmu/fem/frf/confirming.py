"""Errors of reduced-model FRFs at posterior draws, found with a larger basis and with the full structure."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as ssl

from fmu.engines.blas import single_thread
from fmu.fem.frf.model import Damping, FRFModel
from fmu.fem.frf.proportional import Source
from fmu.fem.frf.training import enlarge
from fmu.fem.modes.terms import sum_at
from fmu.numbers import significant, typed
from fmu.progress.phases import phase
from fmu.types import ComplexArray, FloatArray

ALLOWED = 0.1
"""Largest posterior shift, and largest difference from direct solves, that are allowed, in standard deviations."""
_PREFIX = "frf_certificate_"
_LOSS = 0.02
"""Loss factor with which the full structure is solved directly, line by line."""


@dataclass(frozen=True)
class FRFCertificate:
    """Errors of reduced-model FRFs at posterior draws.

    Attributes
    ----------
    draws : int
        Number of draws at which the FRFs were compared with FRFs from an enlarged basis, at every frequency line.
    shift : float
        Largest shift of the posterior that the FRF errors cause, in posterior standard deviations: to first order,
        in the direction in which the shift is largest.
    lines : int
        Number of direct solves of the full structure: one for each of a few lines at every draw.
    direct_error : float
        Largest FRF error at these lines, in standard deviations of the data.
    tolerance : float
        Largest `shift` and `direct_error` allowed.
    """

    draws: int
    shift: float
    lines: int
    direct_error: float
    tolerance: float = ALLOWED

    @classmethod
    def worst(cls, certificates: Iterable[FRFCertificate]) -> FRFCertificate | None:
        """Combine the certificates of several tests at the same draws: largest errors and total number of lines.

        Return None if there are no certificates.
        """
        every = list(certificates)
        if not every:
            return None
        shift, lines, direct = ([vars(one)[key] for one in every] for key in ("shift", "lines", "direct_error"))
        return replace(every[0], shift=max(shift), lines=sum(lines), direct_error=max(direct))

    @property
    def ok(self) -> bool:
        """Whether the errors are within the tolerance."""
        return self.shift <= self.tolerance and self.direct_error <= self.tolerance

    def attributes(self) -> dict[str, object]:
        """Return trace attributes that store the certificate."""
        return {f"{_PREFIX}{name}": value for name, value in asdict(self).items()}

    @classmethod
    def from_trace(cls, attrs: Mapping[Hashable, Any]) -> FRFCertificate | None:
        """Return the certificate stored in a trace's attributes, or None if no certificate is stored."""
        values = {field.name: attrs.get(f"{_PREFIX}{field.name}") for field in fields(cls)}
        if any(value is None for value in values.values()):
            return None
        return cls(**{name: np.asarray(value).item() for name, value in values.items()})

    def sentence(self) -> str:
        """Return a sentence that states the errors."""
        return (
            f"The reduced model of the FRFs was compared with a larger one at {self.draws} draws: its errors move "
            f"the posterior by at most {significant(self.shift, 2)} of its standard deviations (allowed: "
            f"{typed(self.tolerance)}). Direct solves of the full structure at {self.lines} lines differ from it "
            f"by at most {significant(self.direct_error, 2)} standard deviations of the data."
        )


def confirm(model: FRFModel, theta: FloatArray, values: FloatArray) -> FRFCertificate | None:
    """Compute the errors of reduced-model FRFs at n parameter vectors.

    Return None if there is no reduced model, because the basis has all degrees of freedom. `theta` (n, p) are the
    structural parameters and `values` (n, q) the damping parameters.

    Let r be the errors at all lines in standard deviations of the data, and J the FRF derivatives in the same
    units. To first order, the shift of the posterior, in posterior standard deviations, is the length of the
    component of r in the column space of J. The direct solves use (K (1 + iη) − ω² M) x = f with one loss factor,
    which tests the basis for any kind of damping.
    """
    if model.block.size == model.full.size:
        return None
    shift, direct, n_lines = 0.0, 0.0, 0
    with single_thread(), phase("certificate", len(theta)) as under_way:
        for i in range(len(theta)):
            one, own = theta[i : i + 1], values[i : i + 1]
            solved = model.at(one, own)
            found = solved.frfs(model.lines.omega)
            exact = model.on(enlarge(model.full, model.rows, model.block, one[0], model.lines)).at(one, own)
            error = _as_real((found - exact.frfs(model.lines.omega))[0] / model.lines.unit)
            slopes = solved.slopes(model.lines.omega)[0] / model.lines.unit[..., None]
            J = np.concatenate([slopes.real, slopes.imag]).reshape(len(error), -1)
            scale = np.linalg.norm(J, axis=0)
            Q = np.linalg.qr(J[:, scale > 0.0] / scale[scale > 0.0])[0]
            shift = max(shift, float(np.linalg.norm(Q.T @ error)))
            at = np.unique(np.linspace(0, len(model.lines.omega) - 1, 5).astype(int)[1:4])
            direct = max(direct, _direct_error(model, one, at))
            n_lines += len(at)
            under_way.advance()
    return FRFCertificate(len(theta), shift, n_lines, direct)


def _direct_error(model: FRFModel, theta: FloatArray, at: FloatArray) -> float:
    """Return the largest error of the FRFs at the lines with indices `at`, compared with direct solves.

    The error is in units of `Lines.unit`. The damping is replaced by the loss factor `_LOSS`.
    """
    omega = model.lines.omega[at]
    damped = model.with_damping(Damping(loss=Source(_LOSS)))
    found = damped.at(theta, np.empty((1, 0))).frfs(omega)[0]
    K, M = sum_at(model.full.K_terms, theta[0]), sum_at(model.full.M_terms, theta[0])
    loads = model.rows.T.toarray()
    largest = 0.0
    for line, w in enumerate(omega):
        solve = ssl.splu(sp.csc_matrix(K * (1.0 + 1j * _LOSS) - w**2 * M))
        u = model.rows @ solve.solve(loads.astype(complex))
        off = np.abs(found[:, line] - u[model.responses, model.drives]) / model.lines.unit[:, at[line]]
        largest = max(largest, float(off.max()))
    return largest


def _as_real(z: ComplexArray) -> FloatArray:
    return np.concatenate([z.real, z.imag]).ravel()
