"""The evidence of the problem: what its runs and its maxima say of the model as a whole."""

from __future__ import annotations

from collections.abc import Mapping

from fmu.analysis.evidence.text import PSEUDO, WHAT, found_evidences, is_pseudo
from fmu.report.document import Omitted, PageSection, PageTable, Text
from fmu.report.run import ReportedRun


def evidences(runs: Mapping[str, ReportedRun]) -> PageSection | Omitted:
    """Return every log-evidence that there is, with its error, what it rests on and whether it is reliable."""
    title = "Evidence"
    first = next(iter(runs.values()))
    known = [run.maxima for run in runs.values() if run.maxima is not None]
    maxima = max(known, key=lambda found: found.log_evidence, default=None)
    found = found_evidences(
        {name: run.trace for name, run in runs.items()},
        {name: run.diagnosis for name, run in runs.items()},
        maxima,
    )
    if not found:
        nothing = "no maxima are known, and there is no run of parallel tempering"
        return Omitted(title, PSEUDO if is_pseudo(first.trace) else nothing)
    rows = tuple((f"{one.basis[0].upper()}{one.basis[1:]}", one.value, one.is_reliable) for one in found)
    table = PageTable(
        "Natural logarithm, ± its standard error", ("from", "log-evidence", "reliable"), rows, words=(2,)
    )
    return PageSection("evidence", title, (Text(WHAT), table))
