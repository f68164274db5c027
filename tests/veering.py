"""Three masses on springs, two of them nearly alike and weakly coupled: their modes veer inside one block.

K = 1000 N/m · (θ₁ e₁e₁ᵀ + θ₂ e₂e₂ᵀ + 9 e₃e₃ᵀ + c (e₁ − e₂)(e₁ − e₂)ᵀ + 0.1 (e₂ − e₃)(e₂ − e₃)ᵀ), M = 1 kg · I.
Where θ₁ passes θ₂ the lower two eigenvalues come as near as about 2c and their shapes turn into each other.
"""

import numpy as np

import fmu

SENSORS = ((0, "x"), (1, "x"), (2, "x"))
SHAPES = np.array([[1.0, 0.05], [-0.05, 1.0], [0.0, 0.01]])
"""Measured: the first mass moves in the first mode, the second in the second."""


def veering_model(c):
    """Return the structure with a coupling of `c`."""
    first, second, link, anchor = (np.zeros((3, 3)) for _ in range(4))
    first[0, 0] = second[1, 1] = 1.0
    link[:2, :2] = [[1.0, -1.0], [-1.0, 1.0]]
    anchor[1:, 1:] = [[0.1, -0.1], [-0.1, 9.1]]
    K = [
        fmu.Term(1e3 * first, (1.0, 0.0)),
        fmu.Term(1e3 * second, (0.0, 1.0)),
        fmu.Term(1e3 * (c * link + anchor), (0.0, 0.0)),
    ]
    return fmu.SeparableModel(K, [fmu.Term(np.eye(3), (0.0, 0.0))])


def veering_problem(c=0.02, pairing="shape", frequencies=(5.0, 5.1), error="frequency", sd_hz=0.05, **options):
    """Return a problem of two measured modes, θ₁ and θ₂ in 0.8 … 1.3."""
    plain = isinstance(error, str)
    data = fmu.ModalData(frequencies, sensors=SENSORS, shapes=SHAPES, sd_hz=sd_hz if plain else None)
    parameters = [
        fmu.Parameter("k1", start=0.9, lower=0.8, upper=1.3),
        fmu.Parameter("k2", start=1.0, lower=0.8, upper=1.3),
    ]
    return fmu.UpdatingProblem.reduced(veering_model(c), data, parameters, pairing=pairing, error=error, **options)
