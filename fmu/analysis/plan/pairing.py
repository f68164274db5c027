"""Check that the modes could be paired by MAC at the planned sensors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fmu.analysis.plan.design import Design
from fmu.fem.modes.modal import assign, mac
from fmu.types import FloatArray

MOST_WRONG = 0.05
"""Largest fraction of simulated tests in which a mode may be paired wrongly."""
_TESTS = 10  # simulated tests at each draw


@dataclass(frozen=True, eq=False)
class Pairing:
    """Result of pairing simulated tests by MAC.

    Attributes
    ----------
    wrong : ndarray, shape (m,)
        Fraction of the tests in which each measured mode was paired with the wrong mode.
    taken_for : ndarray of int, shape (m,)
        Index of the mode with which each mode was most often confused; its own index if it was never confused.
    """

    wrong: FloatArray
    taken_for: FloatArray

    @property
    def ok(self) -> bool:
        """Whether each mode is paired wrongly in at most `MOST_WRONG` of the tests."""
        return bool(np.all(self.wrong <= MOST_WRONG))


def check_pairing(design: Design, rows: Sequence[int], rng: np.random.Generator) -> Pairing:
    """Simulate ten tests at each draw, and pair the measured mode shapes by MAC with all computed modes.

    The computed modes include the spare ones above the measured modes. Errors of the model are drawn in each test.

    Parameters
    ----------
    design : Design
    rows : sequence of int
        Channels at which the shapes are measured.
    rng : Generator
    """
    shapes, picked = design.found.seen.shapes[:, list(rows)], list(design.modes)
    f = design.found.seen.frequencies
    n, q, k = shapes.shape
    counts = np.zeros((len(picked), k))
    sd = np.hypot(design.shape_sd, design.shape_sd_of_model) * design.largest[:, :, picked]
    slopes = design.found.seen.shape_slopes
    assert slopes is not None  # for the type checker
    of_model = slopes[:, list(rows)][:, :, picked, len(design.parameters) :]
    for _ in range(_TESTS):
        measured = shapes[:, :, picked] + sd * rng.standard_normal((n, q, len(picked)))
        measured += np.einsum("nqmz,nz->nqm", of_model, rng.standard_normal((n, of_model.shape[3])))
        column = assign(np.nan_to_num(mac(shapes, measured)), f, f[:, picked])
        for i in range(len(picked)):
            counts[i] += np.bincount(column[:, i], minlength=k)
    right = counts[range(len(picked)), picked].copy()
    counts[range(len(picked)), picked] = 0.0
    wrong = 1.0 - right / (n * _TESTS)
    return Pairing(wrong, np.where(counts.any(axis=1), np.argmax(counts, axis=1), picked))
