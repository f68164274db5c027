"""A multi-storey frame of more than 10⁴ degrees of freedom with eight uncertain moduli."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

import fmu
from fmu.fem.frame.components import DIRECTIONS, ElementGroup, Material, Section
from fmu.posterior.priors.base import Normal

STOREYS, ZONES = 70, 4
X_AXES, Y_AXES = np.arange(6) * 6.0, np.arange(4) * 5.0
HEIGHT = 3.5
N_MODES = 6


def tower() -> fmu.Frame:
    """Return the frame: columns and floor beams in four zones over the height, clamped at the foundation."""
    nx, ny = len(X_AXES), len(Y_AXES)
    number = np.arange((STOREYS + 1) * nx * ny).reshape(STOREYS + 1, nx, ny)
    x, y = np.meshgrid(X_AXES, Y_AXES, indexing="ij")
    nodes = np.concatenate(
        [np.stack([x.ravel(), y.ravel(), np.full(nx * ny, HEIGHT * k)], axis=1) for k in range(STOREYS + 1)]
    )
    material = Material(E=3.3e10, nu=0.2, rho=2500.0)
    groups = []
    for zone, floors in enumerate(np.array_split(np.arange(1, STOREYS + 1), ZONES)):
        columns = np.concatenate([np.stack([number[k - 1].ravel(), number[k].ravel()], axis=1) for k in floors])
        beams = []
        for k in floors:
            beams += [np.stack([a, b], axis=1) for a, b in pairwise(number[k])]
            beams += [np.stack([a, b], axis=1) for a, b in pairwise(number[k].T)]
        side = 0.9 - 0.12 * zone
        groups.append(ElementGroup(f"columns{zone + 1}", columns, Section.rectangle(side, 0.8 * side), material))
        groups.append(
            ElementGroup(
                f"beams{zone + 1}",
                np.concatenate(beams),
                Section.rectangle(0.4, 0.7),
                material,
                y_direction=(1.0, 1.0, 0.0),
            )
        )
    supports = {int(n): DIRECTIONS for n in number[0].ravel()}
    return fmu.Frame(nodes=nodes, groups=groups, supports=supports)


def tower_problem() -> fmu.UpdatingProblem:
    """Return the updating problem: eight moduli, the lowest modes measured with 0.5 % error."""
    names = [f"{kind}{zone + 1}" for kind in ("columns", "beams") for zone in range(ZONES)]
    model = tower().separable({f"E_{name}": [("E", name)] for name in names})
    parameters = [
        fmu.Parameter(
            f"E_{name}",
            start=3.3e10,
            lower=2.3e10,
            upper=4.3e10,
            prior=Normal(sd=0.5e10, mean=3.3e10),
            unit="N/m²",
        )
        for name in names
    ]
    truth = np.array([3.0e10, 3.1e10, 3.4e10, 3.6e10, 3.5e10, 3.2e10, 3.0e10, 3.3e10])
    from fmu.fem.modes.eigensolver import eigen
    from fmu.fem.modes.modal import frequency_hz

    measured = frequency_hz(eigen(model.K(truth), model.M(truth), N_MODES)[0])
    return fmu.UpdatingProblem.reduced(
        model,
        fmu.ModalData(measured),
        parameters,
        beta=1.0 / (2.0 * (0.005 * measured) ** 2),
        name="tower",
    )
