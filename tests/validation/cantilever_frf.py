"""The case cantilever-frf: simulated accelerances of the paper's cantilever, in its weak plane.

The beam of the case cantilever-young has the five moduli `MODULI` and the five damping ratios `RATIOS`. A shaker
excites it at 300 frequencies one after the other, and three accelerometers measure. The responses are those of a
direct solve of (K + iωC − ω²M) x = f at each frequency, with all degrees of freedom of the plane; the real and the
imaginary part have Gaussian errors of 5 % of |H|. This writes the case:

    python -m tests.validation.cantilever_frf fmu/cases
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import scipy.linalg as sl

import fmu
from fmu.types import ComplexArray, FloatArray
from tests import cantilever

MODULI = np.array([2.05e11, 2.16e11, 1.98e11, 2.12e11, 2.07e11])
"""N/m²."""
RATIOS = np.array([0.012, 0.009, 0.011, 0.014, 0.016])
"""Damping ratios of the five lowest bending modes in the weak plane; the last one is that of all higher modes."""
LINES = np.geomspace(20.0, 2000.0, 300)
DRIVE = ("c", "z")
RESPONSES = (("a", "z"), ("c", "z"), ("sensors", "z"))
NOISE, SEED = 0.05, 42
NAME = "cantilever-frf"
NODES = {"a": 10, "c": 30, "sensors": 49}
"""Nodes of the measured points, which are 10 mm apart."""


def accelerances(
    moduli: FloatArray = MODULI, ratios: FloatArray = RATIOS, lines: FloatArray = LINES
) -> ComplexArray:
    """Return the accelerances (n_frfs, n_lines) in m/s²/N, by direct solves."""
    names = [f"E{g}" for g in range(1, 6)]
    model = cantilever.beam(5).separable({name: [("E", name[1:])] for name in names})
    dofs = [i for i, (_, direction) in enumerate(model.dofs) if direction in ("z", "ry")]
    K, M = (matrix(moduli).toarray()[np.ix_(dofs, dofs)] for matrix in (model.K, model.M))
    places = [model.dofs[i] for i in dofs]
    lam, phi = sl.eigh(K, M)
    zeta = np.full(len(lam), ratios[-1])
    zeta[: len(ratios)] = ratios
    C = (M @ phi * (2.0 * zeta * np.sqrt(lam))) @ (phi.T @ M)
    force = np.zeros(len(dofs))
    force[places.index((NODES[DRIVE[0]], "z"))] = 1.0
    at = [places.index((NODES[place], direction)) for place, direction in RESPONSES]
    found = np.empty((len(at), len(lines)), dtype=complex)
    for j, omega in enumerate(2.0 * np.pi * lines):
        found[:, j] = -(omega**2) * np.linalg.solve(K + 1j * omega * C - omega**2 * M, force)[at]
    return found


def measure(seed: int = SEED, noise: float = NOISE, lines: FloatArray = LINES) -> fmu.FRFData:
    """Return simulated accelerances."""
    rng, exact = np.random.default_rng(seed), accelerances(lines=lines)
    sd = noise * np.abs(exact)
    values = exact + sd * (rng.standard_normal(exact.shape) + 1j * rng.standard_normal(exact.shape))
    return fmu.FRFData(lines, values, (DRIVE,) * len(RESPONSES), RESPONSES, "accelerance", sd)


def table(data: fmu.FRFData) -> str:
    """Return the text of a CSV file."""
    columns = [f"{label} {part}" for label in data.labels for part in ("re", "im", "sd")]
    values, sd = np.asarray(data.values), data.standard_deviation
    parts = np.stack([values.real, values.imag, sd], axis=1).reshape(-1, data.n_lines)
    rows = [
        ",".join([f"{frequency:.6g}", *(f"{value:.6g}" for value in row)])
        for frequency, row in zip(np.asarray(data.frequencies_hz), parts.T, strict=True)
    ]
    return "\n".join([",".join(["frequency_hz", *columns]), *rows]) + "\n"


def text() -> str:
    """Return the text of the case's TOML file."""
    paper = fmu.cases.path("cantilever-young").read_text(encoding="utf-8")
    model = paper[paper.index("[model]") : paper.index("[measurement]")]
    parameters = paper[paper.index("[[parameters]]") :]
    ratios = "".join(
        f"""
[[parameters]]
name = "zeta{i}"
start = 0.01
lower = 0.001
upper = 0.1
prior = {{ distribution = "log-normal", median = 0.01, sigma = 0.7 }}
"""
        for i in range(1, len(RATIOS) + 1)
    )
    moduli = ", ".join(f"{E / 1e11:.2f}" for E in MODULI)
    zeta = ", ".join(f"{100 * ratio:.1f}" for ratio in RATIOS)
    return f"""\
# Simulated accelerances of the paper's cantilever (cantilever-young.toml) in its weak plane: {len(LINES)}
# frequencies of a stepped sine at point c, errors of {100 * NOISE:.0f} % of |H|. The true moduli are
# {moduli} · 10¹¹ N/m², the true damping ratios {zeta} %.
# tests/validation/cantilever_frf.py writes this file and its table.

name = "{NAME}"
description = "simulated accelerances of the paper's cantilever: five moduli and five damping ratios"

[[error]]
of = "frf"
data = "{NAME}/frfs.csv"
kind = "accelerance"

[[damping]]
kind = "modal"
ratios = ["zeta1", "zeta2", "zeta3", "zeta4", "zeta5"]     # the last one is that of all higher modes

{model}{parameters.rstrip()}
{ratios}"""


def write(folder: Path) -> None:
    """Write the case to a folder."""
    (folder / NAME).mkdir(parents=True, exist_ok=True)
    (folder / NAME / "frfs.csv").write_text(table(measure()), encoding="utf-8")
    (folder / f"{NAME}.toml").write_text(text(), encoding="utf-8")


if __name__ == "__main__":
    write(Path(sys.argv[1]))
