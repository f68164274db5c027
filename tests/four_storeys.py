"""A shear frame of four storeys whose four frequencies four different frames have: the classic non-uniqueness.

The stiffnesses of the storeys under known equal masses are not determined by the frequencies. For the factors
`TRUTH` there are four solutions of comparable probability, and a local maximum that holds nothing, to which a
quarter of all climbs leads.
"""

import numpy as np

import fmu
from fmu.fem.pairing.paired_model import PairedStructure

STOREYS, STIFFNESS, MASS = 4, 2e8, 1e5  # N/m, kg
TRUTH = (1.5, 1.5, 2.0, 1.3)
LOWER, UPPER = 0.2, 6.0
SD = 0.005
"""Relative error of a frequency."""


def storey(j):
    """Return the stiffness matrix of storey `j`, from 0."""
    drift = np.zeros(STOREYS)
    drift[j] = 1.0
    if j:
        drift[j - 1] = -1.0
    return STIFFNESS * np.outer(drift, drift)


def frequencies(theta):
    """Return the four frequencies in Hz, without anything of fmu."""
    K = sum(x * storey(j) for j, x in enumerate(theta))
    return np.sqrt(np.linalg.eigvalsh(K) / MASS) / (2.0 * np.pi)


def four_storeys():
    """Return the updating problem. The reduced model spans all degrees of freedom: it is exact."""
    names = [f"k{j}" for j in range(1, STOREYS + 1)]
    numbers = tuple(range(1, STOREYS + 1))
    sensors = tuple((j, "x") for j in numbers)
    model = fmu.SeparableModel.from_terms(
        names,
        stiffness=[(storey(j), name) for j, name in enumerate(names)],
        mass=[MASS * np.eye(STOREYS)],
        dofs=sensors,
    )
    paired = PairedStructure.of(
        model, pairing="index", numbers=numbers, sensors=sensors, reference=np.ones(STOREYS), shapes=None
    )
    paired.train(np.full(STOREYS, LOWER), np.full(STOREYS, UPPER))
    return fmu.UpdatingProblem(
        paired,
        fmu.ModalData(frequencies(TRUTH), numbers),
        [fmu.Parameter(name, start=1.0, lower=LOWER, upper=UPPER) for name in names],
        error=fmu.FrequencyErrors("relative", sd=SD),
        name="four storeys",
    )
