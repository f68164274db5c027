"""What every ``[model]`` table comes to."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from fmu.fem.separable import SeparableModel


class Built(NamedTuple):
    """A model, and the node of the model that each place named in the file is."""

    model: SeparableModel
    places: Mapping[str, Any]
