"""The report section on prior and posterior densities, and a figure of the parameter sensitivities."""

from __future__ import annotations

import numpy as np

from fmu.analysis.identifiability import Identifiability
from fmu.analysis.information import information, separation_in_words, why_unknown
from fmu.analysis.prediction import at_bounds
from fmu.numbers import names_in_words, share, significant
from fmu.report.document import Omitted, PageSection, Picture, Pictures, Text, picture
from fmu.report.plots.information import plot_marginals, plot_sensitivity
from fmu.report.run import ReportedRun

_WEAK = 0.1
LOOK_AT_MARGINALS = (
    "Look for a posterior as wide as its prior (the data do not inform it), one against a bound (they favour "
    "values beyond it), and several peaks. Star: the maximum, which may lie far from the mass of a skewed "
    "posterior."
)
LOOK_AT_SENSITIVITY = (
    "Look for pale columns (parameters that affect no mode) and for two columns that differ by less than about 1 "
    "everywhere (parameters that the modes cannot separate). Numbers: change of a frequency in standard "
    "deviations (sd) of its error, for one prior sd of the parameter, of the linearised model."
)


def marginals(run: ReportedRun) -> PageSection | Omitted:
    """Return the section on each parameter's prior and posterior density.

    Return `Omitted` if the trace has no draws from the prior, or if all posterior draws are the same.
    """
    title, found = "Prior and posterior", information(run.trace)
    if found is None:
        return Omitted(title, why_unknown(run.trace))
    left = np.sqrt(np.maximum(1.0 - found.contraction, 0.0))
    k, j = int(np.argmin(left)), int(np.argmax(left))
    said = (
        f"Narrowed most: {found.names[k]}, to {share(float(left[k]))} of its prior standard deviation; least: "
        f"{found.names[j]}, {'to ' + share(float(left[j])) if left[j] < 1.0 else 'not at all'}."
    )
    if stopped := at_bounds(run.trace):
        said += f" Against a bound: {names_in_words([one.name for one in stopped])}."
    axes = plot_marginals(run.trace, run.maxima[0].theta if run.maxima else None)
    sds = ", ".join(f"{name} {share(float(x))}" for name, x in zip(found.names, left, strict=True))
    alt = f"Densities of each parameter before and after updating. Prior standard deviation that remains: {sds}."
    drawing = picture(axes, "marginals", alt, LOOK_AT_MARGINALS)
    return PageSection("marginals", title, (Text(said), Pictures((drawing,))))


def sensitivity(run: ReportedRun, found: Identifiability) -> tuple[Text, Picture]:
    """Return sentences on the linearised model's sensitivities, and a figure of its sensitivity matrix.

    The sentences name parameters with less than a tenth of the largest sensitivity, and parameters that cannot be
    separated.
    """
    size = np.linalg.norm(found.sensitivity, axis=0)
    weak = [name for name, x in zip(found.names, size, strict=True) if x < _WEAK * size.max()]
    said = "Every parameter affects at least one mode noticeably."
    if weak:
        affect = "affects" if len(weak) == 1 else "affect"
        said = (
            f"{names_in_words(weak)} {affect} the modes less than a tenth as much as the strongest parameter does."
        )
    said = f"{said} {separation_in_words(run.trace, found)}".strip()
    alt = f"Sensitivity matrix, at most {significant(float(np.abs(found.sensitivity).max()), 2)}. {said}"
    drawing = picture(plot_sensitivity(run.trace), "sensitivity", alt, LOOK_AT_SENSITIVITY)
    return Text(said), drawing
