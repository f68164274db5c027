"""Large structures as files of ``fmu run``: frames, space frames, plates of hexahedra, wing boxes of shells."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp
from scipy.io import mmwrite

from fmu.fem.modes.eigensolver import eigen
from fmu.fem.modes.modal import frequency_hz
from fmu.types import FloatArray
from tests.validation import space_frame, wing_box
from tests.validation.scale_model import BOUND, NOISE, SD, Size, frame_model, measured_by
from tests.validation.scale_model import E as CONCRETE

SIDES, CELLS = (2.5, 0.9, 0.1), (100, 36, 4)
"""Length, width and thickness of the plate, m, and the cubes along each."""
ZONES = (3, 2)
"""Along its length and across: each has a modulus of its own."""
STEEL, NU, RHO = 2.1e11, 0.3, 7850.0
N_MODES, WING_MODES = 8, 6


def write_frame(folder: Path, size: Size, n_parameters: int) -> Path:
    """Write the problem of a frame, its matrices as .npz files; return the problem file."""
    model = frame_model(size, n_parameters)
    matrices = [term.matrix for term in model.K_terms]
    (mass,) = (term.matrix for term in model.M_terms)
    for name, matrix in _named(matrices, mass):
        sp.save_npz(folder / f"{name}.npz", sp.csr_matrix(matrix))
    return _problem(folder, "frame", ".npz", n_parameters, CONCRETE, measured_by(model, n_parameters))


def write_plate(folder: Path, cells: tuple[int, int, int] = CELLS) -> Path:
    """Write the problem of a plate, its matrices in the Matrix Market format; return the problem file."""
    stiffness, mass = plate(cells)
    measured = _measured(stiffness, mass, STEEL, N_MODES)
    for name, matrix in _named(stiffness, mass):
        mmwrite(folder / f"{name}.mtx", sp.coo_array(matrix), precision=17, symmetry="symmetric")
    return _problem(folder, "plate", ".mtx", len(stiffness), STEEL, measured)


def write_wing(folder: Path, cells: tuple[int, int, int]) -> Path:
    """Write the problem of a wing box of shells, its matrices as .npz files; return the problem file."""
    stiffness, mass, _ = wing_box.matrices(*wing_box.wing_box(cells))
    measured = _measured(list(stiffness.values()), mass, wing_box.E, WING_MODES)
    for name, matrix in _named(list(stiffness.values()), mass):
        sp.save_npz(folder / f"{name}.npz", sp.csr_matrix(matrix), compressed=False)
    return _problem(folder, "wing", ".npz", len(stiffness), wing_box.E, measured)


def write_space_frame(folder: Path, bays: tuple[int, int]) -> Path:
    """Write the problem of a space frame, its matrices as .npz files; return the problem file."""
    stiffness, mass = space_frame.matrices(bays)
    measured = _measured(stiffness, mass, space_frame.STEEL.E, WING_MODES)
    for name, matrix in _named(stiffness, mass):
        sp.save_npz(folder / f"{name}.npz", sp.csr_matrix(matrix), compressed=False)
    return _problem(folder, "space-frame", ".npz", len(stiffness), space_frame.STEEL.E, measured)


def _measured(stiffness: Sequence[Any], mass: Any, modulus: float, n_modes: int) -> FloatArray:
    """Return frequencies of a true structure with noise, Hz, shape (n_modes,)."""
    rng = np.random.default_rng(1)
    truth = modulus * (1.0 + SD * np.clip(rng.standard_normal(len(stiffness)), -2.0, 2.0))
    K = sum(weight * matrix for weight, matrix in zip(truth, stiffness, strict=True))
    return frequency_hz(eigen(sp.csr_array(K), mass, n_modes)[0]) * (1.0 + NOISE * rng.standard_normal(n_modes))


def plate(cells: tuple[int, int, int] = CELLS) -> tuple[list[Any], Any]:
    """Return the stiffness of each zone at a modulus of 1 N/m², and the mass, of a plate clamped at x = 0.

    Trilinear hexahedra; csr_array of the free degrees of freedom.
    """
    import skfem
    from skfem.helpers import ddot, dot, sym_grad, trace

    axes = (np.linspace(0.0, side, n + 1) for side, n in zip(SIDES, cells, strict=True))
    mesh = skfem.MeshHex.init_tensor(*axes)
    element = skfem.ElementVector(skfem.ElementHex1())

    @skfem.BilinearForm
    def energy(u: Any, v: Any, _: Any) -> Any:
        strain, virtual = sym_grad(u), sym_grad(v)
        shear, lame = 0.5 / (1.0 + NU), NU / (1.0 + NU) / (1.0 - 2.0 * NU)
        return 2.0 * shear * ddot(strain, virtual) + lame * trace(strain) * trace(virtual)

    @skfem.BilinearForm
    def inertia(u: Any, v: Any, _: Any) -> Any:
        return RHO * dot(u, v)

    def basis(elements: Any = None) -> Any:
        return skfem.Basis(mesh, element, intorder=2, elements=elements)

    whole = basis()
    free = whole.complement_dofs(whole.get_dofs(lambda at: at[0] == 0.0))

    def held(matrix: Any) -> Any:
        part = sp.csr_array(matrix)[free][:, free]
        return 0.5 * (part + part.T)

    centre = mesh.p[:, mesh.t].mean(axis=1)
    along, across = (np.floor(n * centre[i] / SIDES[i]).astype(int) for i, n in enumerate(ZONES))
    zone = along * ZONES[1] + across
    stiffness = [held(energy.assemble(basis(np.flatnonzero(zone == k)))) for k in range(ZONES[0] * ZONES[1])]
    return stiffness, held(inertia.assemble(whole))


def _named(stiffness: Sequence[Any], mass: Any) -> list[tuple[str, Any]]:
    return [*((f"K{k}", matrix) for k, matrix in enumerate(stiffness, 1)), ("M", mass)]


def _problem(
    folder: Path, name: str, suffix: str, n_parameters: int, modulus: float, measured: FloatArray
) -> Path:
    """Write the problem file: a modulus a stiffness matrix, with the priors of `scale_problem`."""
    parts = [f'name = "{name}"\ndescription = "the study of large structures"']
    parts.append('[model]\ntype = "matrices"')
    for k in range(1, n_parameters + 1):
        parts.append(f'[[model.stiffness]]\nfile = "K{k}{suffix}"\npowers = {{ E{k} = 1 }}')
    parts.append(f'[[model.mass]]\nfile = "M{suffix}"')
    frequencies, sd = (json.dumps([float(f"{f:.8g}") for f in of]) for of in (measured, NOISE * measured))
    parts.append(f"[measurement]\nfrequencies = {frequencies}\nsd = {sd}")
    for k in range(1, n_parameters + 1):
        parts.append(
            f'[[parameters]]\nname = "E{k}"\nunit = "N/m²"\nstart = {modulus:g}\n'
            f"lower = {modulus * (1.0 - BOUND * SD):g}\nupper = {modulus * (1.0 + BOUND * SD):g}\n"
            f'prior = {{ distribution = "normal", mean = {modulus:g}, sd = {SD * modulus:g} }}'
        )
    file = folder / f"{name}.toml"
    file.write_text("\n\n".join(parts) + "\n", encoding="utf-8")
    return file
