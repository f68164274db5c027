"""``[model] type = "opensees"``: a Python file whose function ``build(theta)`` creates the model with openseespy.

Loading this kind of problem file runs the code in the Python file.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, StringConstraints

from fmu.arguments import ArgumentError
from fmu.config.mistakes import PYTHON_FILE, BrokenError
from fmu.config.models.python import import_function
from fmu.config.parameters import ModelTable, ParameterTable
from fmu.config.tables import Built, FileName
from fmu.fem.exports.recovery import NotSeparableError
from fmu.fem.frame.stability import require_stable
from fmu.fem.programs.opensees import MODES, MOST_DOFS, OpenSeesModel, from_opensees

WHERE = "model.file"


class OpenSeesTable(ModelTable):
    """An OpenSees model. Set ``free = true`` if the structure is intentionally unsupported."""

    type: Literal["opensees"]
    file: Annotated[str, StringConstraints(max_length=500, pattern=PYTHON_FILE)]
    """A Python file in the folder of this file; its function build(theta) creates the model from parameters in SI
    units."""
    per_theta: bool = False
    """Whether the model is assembled and solved anew at every theta. If not, the dependence of its matrices on the
    parameters is found from their values at several theta: sums of products of powers."""
    modes: Annotated[int, Field(ge=1, le=MOST_DOFS)] = MODES
    """With per_theta: number of modes to compute."""
    step: Annotated[float, Field(gt=0, le=0.1)] = 1e-4
    """With per_theta: central-difference step, relative to the range of each parameter."""
    store: FileName = "solves"
    """With per_theta: folder, relative to the folder of this file, for solves that took 0.05 s or longer."""
    free: bool = False

    def build(self, folder: Path, parameters: Sequence[ParameterTable]) -> Built:
        """Import the file, and return the model that its ``build`` function creates.

        Raise BrokenError on failure.
        """
        build = import_function(f"{self.file.removesuffix('.py')}:build", folder, WHERE)
        start = np.array([table.start for table in parameters], dtype=float)
        bounds = [[np.nan if end is None else end for end in (table.lower, table.upper)] for table in parameters]
        lower, upper = np.array(bounds, dtype=float).T
        try:
            if self.per_theta:
                store = folder / self.store
                anew = OpenSeesModel(build, start, modes=self.modes, step=self.step, store=store)
                return Built(anew, {}, anew.assembled.n_dof)
            model = from_opensees(build, [table.name for table in parameters], start, lower, upper)
        except NotSeparableError as error:
            advice = "; with per_theta = true the model may depend on the parameters in any way"
            raise BrokenError(ArgumentError(WHERE, f"{error}{advice}")) from error
        except ValueError as error:
            wrong = ArgumentError.of(error).replace_key("build", "")
            raise BrokenError(ArgumentError(WHERE, str(wrong))) from error
        try:
            require_stable(model, start, self.free)
        except ValueError as error:
            raise BrokenError(ArgumentError(WHERE, f"{error}, at the start")) from error
        return Built(model, {}, model.n_dof)
