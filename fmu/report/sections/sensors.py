"""Report section on how well test and model agree at the sensors (CoMAC, ECoMAC), before and after updating."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from fmu.analysis.fit.measured_shapes import correlations_of, paired_mac, sensor_warnings
from fmu.analysis.trace.modal_states import MEAN, START
from fmu.fem.pairing.correlation import LOOK_AT_SENSORS, Correlation
from fmu.numbers import fixed
from fmu.report.document import Details, Items, Omitted, PageSection, PageTable, Part, Pictures, Text, picture
from fmu.report.plots.correlation import plot_sensors
from fmu.report.run import ReportedRun


def sensors(run: ReportedRun) -> PageSection | Omitted:
    """Return the section with each sensor's CoMAC and ECoMAC, at the starting point and at the posterior mean.

    With several tests, the table shows only each test's worst mode and worst sensor, at the posterior mean. Return
    `Omitted` if no shapes were measured.
    """
    title = "Test and model at the sensors"
    before, after = (correlations_of(run.trace, state) for state in (START, MEAN))
    if not after:
        return Omitted(title, "no shapes were measured")
    parts = _of_one(before[""], after[""]) if "" in after else _of_several(run, after)
    return PageSection("sensors", title, tuple(parts))


def _of_one(before: Correlation, after: Correlation) -> list[Part]:
    """Return the warnings, figure and table for the sensors of a single test."""
    names = after.sensors
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
    return parts


def _of_several(run: ReportedRun, found: Mapping[str, Correlation]) -> list[Part]:
    """Return the warnings about sensors in several tests, and each test's worst mode and sensor."""
    alike = {mode: after for mode, _, after in paired_mac(run.trace)}
    rows = []
    for test in sorted(found, key=lambda name: -float(found[name].ecomac.max())):
        one = found[test]
        mode = min(one.labels, key=lambda label: alike[f"{test}: {label}"])
        j = int(np.argmax(one.ecomac))
        values = (fixed(float(of[j]), 2) for of in (one.comac, one.ecomac))
        rows.append((test, mode, fixed(alike[f"{test}: {mode}"], 2), one.sensors[j], *values))
    header = ("test", "worst mode", "its MAC", "worst sensor", "its CoMAC", "its ECoMAC")
    caption = "At the posterior mean, the test with the largest ECoMAC first."
    doubts = sensor_warnings(run.trace)
    said: Part = (
        Items(tuple(doubts)) if doubts else Text(f"No sensor stands out in any of the {len(found)} tests.")
    )
    return [
        said,
        Text(LOOK_AT_SENSORS),
        Details("Test by test", (PageTable(caption, header, tuple(rows), (1, 3)),)),
    ]
