"""Information from alternatives to a planned test: other modes, repeats, and structural changes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from fmu.analysis.plan.design import Design
from fmu.analysis.plan.sensitivities import Sensitivities
from fmu.analysis.plan.sensors.information import Readings
from fmu.tables import data_frame
from fmu.types import FloatArray, IntArray

if TYPE_CHECKING:
    import pandas as pd

AGAIN = "the same test again"
"""Row name, in the table of second tests, of a repeat without a structural change."""
REPEATS = (1, 2, 3, 5, 10, 20)
ENOUGH = 0.95
"""More repeats are not worthwhile if they leave the sds above this fraction of their value."""


def mode_table(design: Design, chosen: Sequence[int], labels: Sequence[str]) -> pd.DataFrame:
    """Return a table of each mode's information at the chosen sensors, in nats. Drift is ignored.

    Columns: ``frequency_hz`` at the reference parameters; ``alone``, the information from this mode only;
    ``needed``, the information lost without this mode; ``frequency_only``, the information lost if its mode shape
    is not measured; ``twice_as_accurate``, the gain if its frequency error is halved.
    """
    every = list(design.modes)
    whole = design.readings().value_of(chosen)
    rows = []
    for place, i in enumerate(every):
        others = [k for k in every if k != i]
        alone = design.readings([i]).value_of(chosen)
        without = design.readings(others).value_of(chosen) if others else 0.0
        frequency = design.frequency_information([i], design.frequency_sd[[place]])
        prior = np.eye(len(design.scale)) + frequency
        shapeless = design.readings(others, prior=prior).value_of(chosen) if others else _of(design, prior)
        halved = design.frequency_sd.copy()
        halved[place] *= 0.5
        better = design.readings(frequency_sd=halved).value_of(chosen)
        rows.append((alone, whole - without, whole - shapeless, better - whole))
    alone, needed, shape, better = np.array(rows).T
    columns = {
        "frequency_hz": design.found.nominal.frequencies[0, every],
        "alone": alone,
        "needed": needed,
        "frequency_only": shape,
        "twice_as_accurate": better,
    }
    return data_frame(columns, "mode", labels)


def _of(design: Design, matrix: FloatArray) -> float:
    readings = design.readings()
    return readings.value(replace(readings.start(), matrix=matrix))


def repeat_table(design: Design, chosen: Sequence[int], drift: float) -> pd.DataFrame:
    """Return a table of the information from the mean of n repeated tests, one row per n.

    Repeats divide the variance of the measurement errors by n. A drift, with the same relative size in all
    frequencies, remains. All repeats have the same parameter values, also of parameters that form populations.
    Columns: ``information`` in nats; ``median_sd``, the median over the parameters of the expected standard
    deviation relative to its value before the test.

    Parameters
    ----------
    design : Design
        The design with the errors of one test, without the drift.
    chosen : sequence of int
        Candidates to be measured.
    drift : float
        Relative standard deviation of the frequencies that repeats do not reduce.
    """
    rows = []
    for n in REPEATS:
        readings = _mean_of(design, n, drift)
        state = readings.with_sensors(chosen)
        rows.append((readings.value(state), float(np.median(design.sd_of(state) / design.prior_sd))))
    information, sd = np.array(rows).T
    return data_frame({"information": information, "median_sd": sd}, "tests", REPEATS)


def _mean_of(design: Design, n: int, drift: float) -> Readings:
    """Return the readings of the mean of n repeated tests."""
    return design.readings(
        frequency_sd=np.sqrt(design.frequency_sd**2 / n + drift**2), shape_sd=design.shape_sd / np.sqrt(n)
    )


def enough_repeats(table: pd.DataFrame) -> int | None:
    """Return the number of tests beyond which the standard deviations hardly fall.

    They hardly fall if the next number of tests in the table lowers their median by less than 5 %. Return None if
    each step in the table lowers it by at least 5 %.
    """
    sd = table["median_sd"].to_numpy()
    return next((int(table.index[k]) for k in range(len(sd) - 1) if sd[k + 1] > ENOUGH * sd[k]), None)


def change_table(
    design: Design,
    chosen: Sequence[int],
    changes: Mapping[str, tuple[Sensitivities, tuple[int, ...]]],
    drift: float,
) -> pd.DataFrame:
    """Return a table of second tests, each with one structural change, the most informative first.

    Columns: ``gain``, the information in nats that the second test adds to the first; ``median_sd`` and
    ``largest_sd``, the median and the largest ratio of a parameter's standard deviation after both tests to its
    value before them. The row `AGAIN` is a second test without a change. Both tests then have the same drift; the
    drift of a changed structure is independent of it. `changes` maps each name to the changed structure's
    sensitivities and the indices of its measured modes.
    """
    sd = np.sqrt(design.frequency_sd**2 + drift**2)
    state = design.readings(frequency_sd=sd).with_sensors(chosen)
    rows: dict[str, tuple[float, float, float]] = {}
    for name, (found, modes) in {AGAIN: (design.found, design.modes), **changes}.items():
        mine, others = _common(design.found, found)
        target = _part(design.target, mine)
        other = replace(design, found=_rows(found, others), modes=modes, target=target)
        before = replace(design, found=_rows(design.found, mine), target=target).readings(frequency_sd=sd)
        start = replace(state, matrix=state.matrix[mine], lost=state.lost[mine], size=state.size[mine])
        if name == AGAIN:
            readings = _mean_of(other, 2, drift)
        else:
            readings = other.readings(frequency_sd=sd, prior=start.matrix)
        after = readings.with_sensors(chosen)
        ratio = design.sd_of(after) / design.prior_sd
        rows[name] = (
            readings.value(after) - before.value(start),
            float(np.median(ratio)),
            float(np.max(ratio)),
        )
    order = sorted(rows, key=lambda name: -rows[name][0])
    columns = zip(*(rows[name] for name in order), strict=True)
    return data_frame(
        {key: np.array(c) for key, c in zip(("gain", "median_sd", "largest_sd"), columns, strict=True)},
        "second_test",
        order,
    )


def _common(one: Sensitivities, other: Sensitivities) -> tuple[IntArray, IntArray]:
    """Return the draws that two sensitivities share, as row indices into each of them."""
    n = max(len(s.seen.frequencies) if s.kept is None else len(s.kept) for s in (one, other))
    masks = [np.ones(n, dtype=bool) if s.kept is None else s.kept for s in (one, other)]
    both = masks[0] & masks[1]
    first, second = (np.flatnonzero(both[mask]) for mask in masks)
    return first, second


def _rows(found: Sensitivities, rows: IntArray) -> Sensitivities:
    seen = found.seen
    parts = (seen.frequencies, seen.shapes, seen.frequency_slopes, seen.shape_slopes)
    f, phi, df, dphi = (None if part is None else part[rows] for part in parts)
    assert f is not None  # for the type checker: only slopes may be missing
    assert phi is not None
    return replace(found, seen=replace(seen, frequencies=f, shapes=phi, frequency_slopes=df, shape_slopes=dphi))


def _part(target: FloatArray | None, rows: IntArray) -> FloatArray | None:
    return None if target is None else target[rows]
