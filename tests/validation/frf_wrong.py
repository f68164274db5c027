"""FRFs of a structure whose masses differ from the model, updated without and with errors of the model.

``python -m tests.validation.frf_wrong`` prints this section of ``frfs.md`` alone.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg

import fmu
from fmu.tables import markdown_table
from tests import measured_frfs as storeys
from tests.validation.kept import Units, each, fields_of

SETS = 10
_MASSES = ((950.0, 1060.0, 1000.0), (1000.0, 1100.0, 1000.0))
_HELD = (storeys.LINES > 8.0) & (storeys.LINES < 10.0)
_ERRORS = fmu.Discrepancy("modes", sd=0.02, correlation=0.0, shape_sd=0.05)


@dataclass
class Wrong:
    """A simulated test that is updated without (index 0) and with (index 1) errors of the model.

    Attributes
    ----------
    moduli, held : list of int
        Numbers of 90 % intervals that contain the true modulus, and the held-out amplitude.
    contradicted, converged : list of bool
    """

    moduli: list[int]
    held: list[int]
    contradicted: list[bool]
    converged: list[bool]


def measured(seed: int) -> fmu.FRFData:
    """Return simulated FRFs of a building whose masses differ from the model; the second resonance is held out."""
    rng, omega = np.random.default_rng([4, seed]), 2 * np.pi * storeys.LINES
    M = np.diag(_MASSES[seed % 2])
    lam, phi = scipy.linalg.eigh(storeys.building().K(storeys.TRUTH).toarray(), M)
    wr = np.sqrt(lam)[:, None]
    g = 1.0 / (wr**2 - omega**2 + 2j * storeys.RATIOS[:, None] * wr * omega)
    H = np.array([(phi[place] * phi[2]) @ g for place, _ in storeys.POINTS]) * (1j * omega) ** 2
    sd = 0.03 * np.abs(H)
    values = H + sd * (rng.standard_normal(H.shape) + 1j * rng.standard_normal(H.shape))
    return fmu.FRFData(storeys.LINES, values, ((2, "x"),) * 2, storeys.POINTS, "accelerance", sd, use=~_HELD)


def updated(seed: int) -> Wrong:
    """Update a simulated test both ways, and compare the intervals with the truth."""
    found = Wrong([], [], [], [])
    data = measured(seed)
    for discrepancy in ((), _ERRORS):
        own = fmu.FRFErrors(data, fmu.ModalDamping(storeys.ratios()))
        problem = fmu.UpdatingProblem(
            storeys.building(), storeys.modes(), storeys.parameters(), error=own, discrepancy=discrepancy
        )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            trace = fmu.sample(problem, "mixture", draws=500, warmup=200, seed=seed + 1)
        draws = np.array([trace["posterior"][name].to_numpy().ravel() for name in storeys.NAMES])
        low, high = np.quantile(draws, [0.05, 0.95], axis=1)
        found.moduli.append(int(np.sum((low <= storeys.TRUTH) & (high >= storeys.TRUTH))))
        found.held.append(int(trace["frfs"]["held_inside"].sum()))
        diagnosis = fmu.diagnose(trace)
        found.contradicted.append("not contradicted" not in diagnosis.fit.answer)
        found.converged.append(bool(diagnosis.converged))
    return found


def wrong_page(sets: Sequence[Wrong]) -> str:
    """Return the section on wrong models."""
    n, rows = len(sets), []
    for k, errors in enumerate(("none", "`fmu.Discrepancy`")):
        moduli, held, against, converged = (
            sum(getattr(one, key)[k] for one in sets) for key in ("moduli", "held", "contradicted", "converged")
        )
        of_held = f"{held} of {2 * int(_HELD.sum()) * n}"
        rows.append((errors, f"{moduli} of {3 * n}", of_held, f"{against} of {n}", f"{converged} of {n}"))
    header = ("errors of the model", "true moduli in their intervals", "held-out amplitudes in their intervals",
              "models contradicted", "runs converged")  # fmt: skip
    return f"""## Wrong models

{n} tests of a building of three storeys are simulated, with two accelerances and 3 % noise. The floor masses
differ from the model by up to 10 %. The lines from 8 to 10 Hz, around the second resonance, are held out. The
model is updated without errors of the model, and with
`fmu.Discrepancy("modes", sd=0.02, correlation=0.0, shape_sd=0.05)`. All intervals are 90 % intervals.
`python -m tests.validation.frf_wrong` prints this section alone.

{markdown_table(header, rows)}"""


def wrong_models(units: Units) -> list[Wrong]:
    """Return the tests that are done."""
    return units.completed("wrong models", each(range(SETS)), updated, fields_of(Wrong, list))


if __name__ == "__main__":
    print(wrong_page(wrong_models(Units())))
