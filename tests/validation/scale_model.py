"""A regular frame of any size with any number of uncertain moduli: what the study of scale is made on."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

import fmu
from fmu.fem.frame.components import DIRECTIONS, ElementGroup, Material, Section
from fmu.fem.modes.eigensolver import eigen
from fmu.fem.modes.modal import frequency_hz
from fmu.posterior.priors.base import Normal
from fmu.types import FloatArray

N_MODES, NOISE = 10, 0.005
"""Frequencies measured, and the relative standard deviation of their errors."""
E, SD, BOUND = 3.3e10, 0.07, 3.0
"""Young's modulus of concrete, N/m²; the relative standard deviation of its prior; how many of them to a bound."""
BAYS, HEIGHT = (5.0, 4.0), 3.5
CONCRETE = Material(E=E, nu=0.2, rho=2500.0)


@dataclass(frozen=True)
class Size:
    """Storeys, and axes of columns both ways: six degrees of freedom at every node above the foundation."""

    storeys: int
    x_axes: int
    y_axes: int

    @property
    def n_dof(self) -> int:
        """Free degrees of freedom."""
        return 6 * self.storeys * self.x_axes * self.y_axes


def frame(size: Size, n_parameters: int) -> fmu.Frame:
    """Return a frame whose columns and whose floor beams are grouped by storeys, clamped at the foundation.

    Parameters
    ----------
    size : Size
    n_parameters : int
        Groups, at least two and at most two a storey: one half of columns, one half of beams.
    """
    nx, ny = size.x_axes, size.y_axes
    number = np.arange((size.storeys + 1) * nx * ny).reshape(size.storeys + 1, nx, ny)
    z, x, y = np.meshgrid(np.arange(size.storeys + 1), np.arange(nx), np.arange(ny), indexing="ij")
    nodes = np.stack([BAYS[0] * x.ravel(), BAYS[1] * y.ravel(), HEIGHT * z.ravel()], axis=1)
    floors = np.arange(1, size.storeys + 1)
    groups = []
    for i, part in enumerate(np.array_split(floors, (n_parameters + 1) // 2)):
        columns = np.concatenate([np.stack([number[k - 1].ravel(), number[k].ravel()], axis=1) for k in part])
        side = 0.9 - 0.5 * (part[0] - 1) / size.storeys
        groups.append(ElementGroup(f"columns{i + 1}", columns, Section.rectangle(side, 0.8 * side), CONCRETE))
    for i, part in enumerate(np.array_split(floors, n_parameters // 2)):
        lines = [pair for k in part for plan in (number[k], number[k].T) for pair in pairwise(plan)]
        beams = np.concatenate([np.stack(pair, axis=1) for pair in lines])
        section = Section.rectangle(0.4, 0.7)
        groups.append(ElementGroup(f"beams{i + 1}", beams, section, CONCRETE, y_direction=(1.0, 1.0, 0.0)))
    return fmu.Frame(nodes=nodes, groups=groups, supports={int(n): DIRECTIONS for n in number[0].ravel()})


def measured_by(model: fmu.SeparableModel, n_parameters: int) -> FloatArray:
    """Return the ten lowest frequencies of a true frame, Hz, with noise."""
    rng = np.random.default_rng(1)
    truth = E * (1.0 + SD * np.clip(rng.standard_normal(n_parameters), -2.0, 2.0))
    exact = frequency_hz(eigen(model.K(truth), model.M(truth), N_MODES)[0])
    return exact * (1.0 + NOISE * rng.standard_normal(N_MODES))


def frame_model(size: Size, n_parameters: int) -> fmu.SeparableModel:
    """Return the matrices of a frame, a modulus a group."""
    whole = frame(size, n_parameters)
    return whole.separable({f"E_{group.name}": [("E", group.name)] for group in whole.groups})


def scale_problem(size: Size, n_parameters: int, reduction: bool | float) -> fmu.UpdatingProblem:
    """Return the updating problem: a modulus a group; the ten lowest frequencies of a true frame with noise."""
    model = frame_model(size, n_parameters)
    measured = measured_by(model, n_parameters)
    parameters = [
        fmu.Parameter(
            name,
            start=E,
            lower=E * (1.0 - BOUND * SD),
            upper=E * (1.0 + BOUND * SD),
            prior=Normal(sd=SD * E, mean=E),
            unit="N/m²",
        )
        for name in (f"E{k}" for k in range(1, n_parameters + 1))
    ]
    data = fmu.ModalData(measured, sd_hz=NOISE * measured)
    return fmu.UpdatingProblem.reduced(model, data, parameters, reduction=reduction, name="frame")
