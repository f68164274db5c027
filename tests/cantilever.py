"""The paper's cantilever in Python, to hold the built-in files against.

Boulkaibet, Marwala, Mthembu, Friswell & Adhikari, section 5.

A steel beam of 500 mm × 60 mm × 10 mm, clamped at one end, with three accelerometers of 40 g each at 490 mm; 50
Euler–Bernoulli elements with rotary inertia. The weak plane (bending across the 10 mm) is the plane in which the
accelerometers measure. x runs along the beam, z across the thickness.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from fmu.fem.frame.components import DIRECTIONS, ElementGroup, Material, PointMass, Section
from fmu.fem.frame.frame import Frame
from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.parameters import Parameter
from fmu.posterior.priors.base import Normal
from fmu.posterior.problem import UpdatingProblem

LENGTH, WIDTH, THICKNESS = 0.5, 0.06, 0.01
N_ELEMENTS = 50
SENSOR_NODE = 49
SENSOR_MASS = 3 * 0.040
MEASURED_HZ = (31.9, 197.9, 553.0, 1082.2, 1781.5)
NUMBERS = (1, 3, 5, 7, 9)


def beam(n_groups: int, E: float = 2.1e11) -> Frame:
    """Return the beam, its elements in `n_groups` equal groups named ``"1"``, ``"2"``, … from the clamp."""
    nodes = np.zeros((N_ELEMENTS + 1, 3))
    nodes[:, 0] = np.linspace(0.0, LENGTH, N_ELEMENTS + 1)
    elements = np.stack([np.arange(N_ELEMENTS), np.arange(1, N_ELEMENTS + 1)], axis=1)
    section = Section.rectangle(width=WIDTH, height=THICKNESS)
    material = Material(E=E, nu=0.3, rho=7850.0)
    return Frame(
        nodes=nodes,
        groups=[
            ElementGroup(str(g + 1), part, section, material, y_direction=(0.0, 1.0, 0.0))
            for g, part in enumerate(np.split(elements, n_groups))
        ],
        supports={0: DIRECTIONS},
        masses=[PointMass(SENSOR_NODE, SENSOR_MASS)],
    )


def measurement() -> ModalData:
    """Return the five measured frequencies, with the numbers that the paper gives them, for either pairing."""
    return ModalData(MEASURED_HZ, numbers=NUMBERS, sensors=((SENSOR_NODE, "z"),), counterparts=(1, 2, 3, 4, 5))


def young(pairing: str = "shape", beta: ArrayLike = 1.0) -> UpdatingProblem:
    """Return the problem of section 5.1: Young's moduli of five groups of ten elements."""
    names = [f"E{g}" for g in range(1, 6)]
    model = beam(5).separable({name: [("E", name[1:])] for name in names})
    parameters = [
        Parameter(name, start=2.4e11, lower=1.7e11, upper=2.5e11, prior=Normal(sd=2e11), unit="N/m²")
        for name in names
    ]
    return UpdatingProblem.reduced(
        model, measurement(), parameters, pairing=pairing, beta=beta, name=f"cantilever-young, by {pairing}"
    )


def section(pairing: str = "shape", beta: ArrayLike = 1.0) -> UpdatingProblem:
    """Return the problem of section 5.2: second moments of area and areas of the beam's two halves.

    The start I = 7e-9 m⁴ is the one that reproduces the initial column of Table 4; the paper prints 5e-9.
    """
    model = beam(2).separable(
        {"Ix1": [("Iy", "1")], "Ix2": [("Iy", "2")], "Ax1": [("A", "1")], "Ax2": [("A", "2")]}
    )
    parameters = [
        Parameter(name, start=7e-9, lower=3.5e-9, upper=7.5e-9, prior=Normal(sd=5e-9), unit="m⁴")
        for name in ("Ix1", "Ix2")
    ] + [
        Parameter(name, start=8e-4, lower=4.5e-4, upper=9e-4, prior=Normal(sd=5e-4), unit="m²")
        for name in ("Ax1", "Ax2")
    ]
    return UpdatingProblem.reduced(
        model, measurement(), parameters, pairing=pairing, beta=beta, name=f"cantilever-section, by {pairing}"
    )
