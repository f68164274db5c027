"""The section on the agreement of test and model at each sensor, before and after updating: CoMAC and ECoMAC."""

from __future__ import annotations

import numpy as np

from fmu.analysis.trace.modal_states import GROUP, MEAN, START
from fmu.analysis.trace.reading import has
from fmu.fem.pairing.correlation import LOOK_AT_SENSORS, Correlation
from fmu.numbers import fixed
from fmu.report.document import Details, Items, Omitted, PageSection, PageTable, Part, Pictures, picture
from fmu.report.plots.correlation import plot_sensors
from fmu.report.run import ReportedRun


def sensors(run: ReportedRun) -> PageSection | Omitted:
    """Return the section with CoMAC and ECoMAC of each sensor, at the start and at the posterior mean."""
    title = "Test and model at the sensors"
    if not has(run.trace, GROUP, "measured"):
        return Omitted(title, "no shapes were measured")
    modes = run.trace[GROUP].to_dataset()
    measured = modes["measured"].transpose("place", "mode").to_numpy()
    seen = np.isfinite(measured).all(axis=1)
    places, labels = (tuple(modes[name].to_numpy().astype(str).tolist()) for name in ("place", "mode"))
    names = tuple(name for name, is_seen in zip(places, seen, strict=True) if is_seen)
    computed = {
        state: modes["component"].sel(state=state).transpose("place", "mode").to_numpy()[seen]
        for state in (START, MEAN)
    }
    before, after = (Correlation(names, labels, measured[seen], shapes) for shapes in computed.values())
    rows = tuple(
        (names[j], *(fixed(float(x[j]), 2) for x in (before.comac, after.comac, before.ecomac, after.ecomac)))
        for j in np.argsort(-after.ecomac, kind="stable")
    )
    header = ("sensor", "CoMAC before", "CoMAC after", "ECoMAC before", "ECoMAC after")
    caption = "At the start and at the posterior mean, the largest ECoMAC first."
    states = {"before updating": (before.comac, before.ecomac), "posterior mean": (after.comac, after.ecomac)}
    alt = (
        f"CoMAC and ECoMAC of {len(names)} sensors. The largest ECoMAC after updating: {rows[0][0]} {rows[0][4]}."
    )
    doubts = after.doubts_of_sensors()
    parts: list[Part] = [Items(tuple(doubts))] if doubts else []
    parts.append(Pictures((picture(plot_sensors(names, states), "sensors", alt, LOOK_AT_SENSORS),)))
    parts.append(Details("Sensor by sensor", (PageTable(caption, header, rows),)))
    return PageSection("sensors", title, tuple(parts))
