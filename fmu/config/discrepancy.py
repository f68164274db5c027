"""``[[discrepancy]]``: model discrepancy."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from fmu.config.tables import Name, Positive, TomlTable
from fmu.posterior.discrepancy.embedded import Discrepancy


class DiscrepancyTable(TomlTable):
    """Model discrepancy: the errors that no parameter values can remove, because the model is imperfect."""

    kind: Literal["embedded", "modes"]
    """"embedded": each mode has its own parameter values. "modes": frequencies and shapes have errors that do not
    depend on the parameters. For frequency response functions only "modes" is allowed, which needs sd and
    correlation."""
    tau: Positive | None = None
    """The scatter relative to the parameter or, if the parameter may be 0, to its starting value (or to the scale
    of its prior, if it starts at 0). Inferred if not given."""
    prior_sd: Positive = 0.1
    """Standard deviation of the half-normal priors of an inferred tau, sd and shape_sd."""
    by: Literal["common", "group"] = "common"
    """Whether all parameters have the same scatter or each group its own."""
    groups: list[Name] = []
    """Groups, or names of parameters, that scatter; all if not given."""
    sd: Positive | None = None
    """With kind = "modes", the standard deviation of the relative frequency errors. Inferred if not given."""
    correlation: Annotated[float, Field(ge=0, le=1)] | Literal["inferred"] | None = None
    """With kind = "modes", correlation of the errors of two frequencies; inferred if not given. With kind =
    "embedded", correlation of the scatter of a parameter in two modes; 0 if not given."""
    shape_sd: Positive | None = None
    """With kind = "modes", the standard deviation of the errors of shapes scaled to a largest component of 1; for
    frequency response functions, of residues relative to their root mean square. Inferred if not given."""
    length: Positive | None = None
    """With kind = "modes", the distance in m over which the correlation of the errors at two sensors falls to 1/e.
    The errors are independent if not given."""
    name: Name | None = None
    """Name of the inferred quantity; "tau" or "model error" if not given. With by = "group" the group's name is
    appended."""

    def build(self) -> Discrepancy:
        """Return the discrepancy described by this table."""
        return Discrepancy(**dict(self) | {"groups": tuple(self.groups)})
