"""Error models (distributions of the differences between measured and computed quantities) and likelihoods.

Reading order: base, noise; frequency, student, shape, mac; quantities; slopes, surrogate_variance, likelihood,
mixture; residual.
"""

from fmu.posterior.errors.base import ErrorModel
from fmu.posterior.errors.frequency import FrequencyErrors
from fmu.posterior.errors.mac import MACErrors
from fmu.posterior.errors.quantities import MassErrors, StaticErrors
from fmu.posterior.errors.shape import ShapeErrors
from fmu.posterior.errors.student import StudentErrors

ERROR_MODELS: dict[str, type[ErrorModel]] = {
    "frequencies": FrequencyErrors,
    "robust-frequencies": StudentErrors,
    "shapes": ShapeErrors,
    "mac": MACErrors,
    "mass": MassErrors,
    "static": StaticErrors,
}
"""Error models, keyed by ``of`` in a problem file. The table's other keys are arguments (`fmu.config.errors`)."""
