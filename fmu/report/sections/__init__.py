"""The sections of a report, written by functions that return a `PageSection` or `Omitted`.

To add a section to the page of a sampler, write a function of a `ReportedRun` in a module of this package and
list it in `OF_A_SAMPLER`.
"""

from __future__ import annotations

from importlib import import_module

from fmu.report.document import Omitted, PageSection
from fmu.report.run import ReportedRun

OF_A_SAMPLER = (
    "tests.losses",
    "updating.parameters",
    "frf.functions.frfs",
    "updating.frequencies",
    "updating.maxima",
    "updating.evidence",
    "tests.population",
    "information.marginals",
    "structure.identifiability",
    "structure.mac",
    "structure.pairing",
    "structure.shapes",
    "sensors.sensors",
    "fit.checks",
    "prediction.predictive",
    "prediction.left_out",
    "chains.reliability",
    "chains.paths",
    "chains.settling",
    "chains.pairs",
    "chains.energies",
    "origin.cost",
    "origin.certificate",
    "origin.settings",
)
"""The sections on the page of a sampler, in this order, as ``MODULE.FUNCTION``."""


def of_a_sampler(run: ReportedRun) -> list[PageSection | Omitted]:
    """Return all sections on one run's page, including those that are omitted."""
    found = []
    for name in OF_A_SAMPLER:
        module, _, function = name.rpartition(".")
        found.append(getattr(import_module(f"{__name__}.{module}"), function)(run))
    return found
