"""Error models: how far measured and computed modes may differ. One file an error model, settings and formulas.

Reading order: base, noise; frequency, student, shape, mac; quantities; likelihood, mixture; residual.
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
"""By the name that ``of`` has in a problem file; its other keys are the arguments (`fmu.config.errors`)."""
