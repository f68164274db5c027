"""``[[discrepancy]]``: errors of the model itself."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from fmu.config.tables import Name, Positive, TomlTable
from fmu.posterior.discrepancy.embedded import Discrepancy


class DiscrepancyTable(TomlTable):
    """Error of the model itself, as a wrong model has no parameters that fit all modes."""

    kind: Literal["embedded", "modes"]
    """Each mode sees parameters of its own, or frequencies and shapes have errors whatever the parameters. Of
    frequency response functions "modes", with sd and correlation."""
    tau: Positive | None = None
    """The scatter: relative, or of a parameter that may be 0 in units of its start. Inferred if not given."""
    prior_sd: Positive = 0.1
    """Standard deviation of the half-normal priors of an inferred tau, sd and shape_sd."""
    by: Literal["common", "group"] = "common"
    """Whether all parameters have the same scatter, or each group its own."""
    groups: list[Name] = []
    """Groups, or names of parameters, that scatter; all if not given."""
    sd: Positive | None = None
    """With kind = "modes", the standard deviation of relative errors of frequencies. Inferred if not given."""
    correlation: Annotated[float, Field(ge=0, le=1)] | Literal["inferred"] | None = None
    """Correlation of the errors of two frequencies, inferred if not given (kind = "modes"), or of the scatter of a
    parameter in two modes, 0 if not given (kind = "embedded")."""
    shape_sd: Positive | None = None
    """With kind = "modes", of a component of a shape whose largest component is 1. Inferred if not given."""
    length: Positive | None = None
    """With kind = "modes", the distance in m over which the correlation of two sensors' errors falls to 1/e."""
    name: Name | None = None
    """Name of the inferred number, "tau" or "model error" if not given; with by = "group" the group follows."""

    def build(self) -> Discrepancy:
        """Return the discrepancy."""
        return Discrepancy(**dict(self) | {"groups": tuple(self.groups)})
