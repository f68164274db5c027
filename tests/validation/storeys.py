"""An updating problem that is cheap and whose posterior is bounded, skewed and correlated.

A building of three storeys: the stiffness of the first, that of the two others and the mass of the top floor
are uncertain, as factors of their design values, and the first two frequencies are measured. Two numbers do not
determine three factors: the posterior is a ridge, cut off by the bounds that truncate the prior.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

import fmu
from fmu.fem.modes.terms import Term
from fmu.fem.pairing.modal_model import ModalModel
from fmu.posterior.priors.base import Normal
from fmu.types import FloatArray

STIFFNESS, MASS = 4e7, 2e4  # N/m, kg
DESIGN_HZ = np.array([3.17, 8.88])  # all factors 1
SD_HZ = np.array([0.1, 0.3])
MODEST = Normal(sd=0.3, mean=1.0)
PARAMETERS = (
    fmu.Parameter("k1", start=1.0, lower=0.7, upper=1.4, prior=MODEST),
    fmu.Parameter("k2", start=1.0, lower=0.7, upper=1.4, prior=MODEST),
    fmu.Parameter("m3", start=1.0, lower=0.6, upper=1.3, prior=MODEST),
)


def reduced_model() -> ModalModel:
    """Return the first two frequencies as a function of the three factors, by fmu's reduced model.

    Its basis spans all three degrees of freedom: the reduction is exact.
    """
    first = np.diag([1.0, 0.0, 0.0])
    others = np.array([[1.0, -1.0, 0.0], [-1.0, 2.0, -1.0], [0.0, -1.0, 1.0]])
    floors, top = np.diag([1.0, 1.0, 0.0]), np.diag([0.0, 0.0, 1.0])
    model = fmu.SeparableModel(
        [Term(sp.csr_array(STIFFNESS * first), (1, 0, 0)), Term(sp.csr_array(STIFFNESS * others), (0, 1, 0))],
        [Term(sp.csr_array(MASS * floors), (0, 0, 0)), Term(sp.csr_array(MASS * top), (0, 0, 1))],
    )
    return problem(model, DESIGN_HZ, reduction=True).model


def problem(
    model: fmu.SeparableModel | ModalModel, measured_hz: FloatArray, reduction: bool = False
) -> fmu.UpdatingProblem:
    """Return the updating problem for the given measurement, in Hz."""
    data = fmu.ModalData(measured_hz)
    beta = 1.0 / (2.0 * SD_HZ**2)
    return fmu.UpdatingProblem.reduced(model, data, PARAMETERS, pairing="index", beta=beta, reduction=reduction)
