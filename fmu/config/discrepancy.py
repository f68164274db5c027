"""``[[discrepancy]]``: errors of the model itself."""

from __future__ import annotations

from typing import Literal

from fmu.config.tables import Name, Positive, TomlTable
from fmu.posterior.discrepancy.embedded import Discrepancy


class DiscrepancyTable(TomlTable):
    """Scatter of the parameters over the modes, as a wrong model has none that fit all modes."""

    kind: Literal["embedded"]
    """Each mode sees parameters of its own."""
    tau: Positive | None = None
    """The scatter: relative, or of a parameter that may be 0 in units of its start. Inferred if not given."""
    prior_sd: Positive = 0.1
    """Standard deviation of the half-normal prior of an inferred scatter."""
    by: Literal["common", "group"] = "common"
    """Whether all parameters have the same scatter, or each group its own."""
    groups: list[Name] = []
    """Groups, or names of parameters, that scatter; all if not given."""
    name: Name = "tau"
    """Name of the inferred scatter; with by = "group" the name of the group follows."""

    def build(self) -> Discrepancy:
        """Return the discrepancy."""
        return Discrepancy(self.kind, self.tau, self.prior_sd, self.by, tuple(self.groups), self.name)
