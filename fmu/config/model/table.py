"""What every ``[model]`` table comes to."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from fmu.config.mistakes import Mistake
from fmu.config.parameters import ParameterTable, Target
from fmu.fem.black_box import BlackBoxModel
from fmu.fem.modes.separable import SeparableModel


class Built(NamedTuple):
    """A model, and the node of the model that each place named in the file is."""

    model: SeparableModel | BlackBoxModel
    places: Mapping[str, Any]


def without_targets(parameters: Sequence[ParameterTable]) -> list[Mistake]:
    """Return the keys of parameters that say what of a frame they are, in a file without a frame."""
    return [
        Mistake(f"parameters.{i}.{key}", "is allowed for frames only")
        for i, table in enumerate(parameters)
        for key in Target.model_fields
        if key in table.model_fields_set
    ]
