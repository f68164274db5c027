"""Doubts about the tests of one structure: labels that no other test has, and tests that were entered twice."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fmu.formats.shown import names_shown
from fmu.posterior.joint.modal_test import Test
from fmu.types import FloatArray

_LEAST_SCATTER = 1e-3
_BY_CHANCE = 0.01


def doubts_of_tests(tests: Sequence[Test]) -> list[str]:
    """Return sentences on tests that share no mode with any other test, and on tests with equal frequencies."""
    found, alike = [], dict[object, list[Test]]()
    for test in tests:
        labels = test.data.labels
        alike.setdefault((test.group, labels), []).append(test)
        others = {label for other in tests if other is not test for label in other.data.labels}
        if others and not others & set(labels):
            found.append(
                f"No other test has a mode of {test.name} ({names_shown(labels)}): if its modes are those of "
                "other tests, give them the same labels."
            )
    for same in alike.values():
        found += _entered_twice(same)
    return found


def _entered_twice(tests: Sequence[Test]) -> list[str]:
    """Return a sentence on each set of tests with the same frequencies, unless these may be equal by chance.

    `tests` have the same modes. Frequencies may be equal by chance if the expected number of equal pairs of tests
    exceeds `_BY_CHANCE`. Two independent normal values with the standard deviation s, rounded to the resolution r,
    are equal with a probability of about r/(2√π s). Here s is the scatter over the tests, but at least 0.1 % of
    the mean.
    """
    f = np.array([test.data.frequencies_hz for test in tests])
    scatter = np.maximum(f.std(axis=0), _LEAST_SCATTER * f.mean(axis=0))
    agree = np.minimum(_resolution(f) / (2.0 * np.sqrt(np.pi) * scatter), 1.0)
    if 0.5 * len(f) * (len(f) - 1) * np.prod(agree) > _BY_CHANCE:
        return []
    _, row, counts = np.unique(f, axis=0, return_inverse=True, return_counts=True)
    names = np.array([test.name for test in tests])
    return [
        f"The tests {names_shown(names[row == k].tolist())} have exactly the same frequencies: if they are one "
        "test that was entered more than once, leave the others out, as each counts as a test of its own."
        for k in np.flatnonzero(counts > 1)
    ]


def _resolution(f: FloatArray) -> FloatArray:
    """Return the resolution of each column of `f` (n, m), shape (m,): the unit of its last given decimal."""
    decimals = [[len(np.format_float_positional(x, trim="-").partition(".")[2]) for x in row] for row in f]
    return np.asarray(10.0 ** -np.max(decimals, axis=0))
