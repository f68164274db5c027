"""A shear frame of four storeys whose four frequencies four different frames have: the classic non-uniqueness.

The stiffnesses of the storeys under known equal masses are not determined by the frequencies. For the factors
`TRUTH` there are four solutions of comparable probability, and a local maximum that holds nothing, to which a
quarter of all climbs leads.
"""

import numpy as np

import fmu
from fmu.fem.pairing.paired_structure import PairedStructure
from fmu.fem.reduced.reduced_structure import train
from tests.shear_building import frequencies_hz, shear_building

STOREYS, STIFFNESS, MASS = 4, 2e8, 1e5  # N/m, kg
TRUTH = (1.5, 1.5, 2.0, 1.3)
LOWER, UPPER = 0.2, 6.0
SD = 0.005
"""Relative error of a frequency."""


def four_storeys():
    """Return the updating problem. The reduced model spans all degrees of freedom: it is exact."""
    names = [f"k{j}" for j in range(1, STOREYS + 1)]
    numbers = tuple(range(1, STOREYS + 1))
    sensors = tuple((j, "x") for j in numbers)
    model = shear_building(names, STIFFNESS, MASS, dofs=sensors)
    paired = PairedStructure.of(
        model, pairing="index", numbers=numbers, sensors=sensors, reference=np.ones(STOREYS), shapes=None
    )
    reduced, _ = train(paired, np.full(STOREYS, LOWER), np.full(STOREYS, UPPER))
    return fmu.UpdatingProblem(
        reduced,
        fmu.ModalData(frequencies_hz(model, TRUTH)[0], numbers),
        [fmu.Parameter(name, start=1.0, lower=LOWER, upper=UPPER) for name in names],
        error=fmu.FrequencyErrors("relative", sd=SD),
        name="four storeys",
    )
