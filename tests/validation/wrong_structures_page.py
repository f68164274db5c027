"""The gates and the page of the study of structures whose model is wrong."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from fmu.tables import markdown_table

if TYPE_CHECKING:
    from tests.validation.wrong_structures import Structure

KINDS = ("joint", "mass", "right", "thickness", "joint", "right", "mass", "thickness", "right")
"""Errors of the models of consecutive structures."""
INTERVAL = 0.9
BAND, WIDER = (0.85, 0.95), 1.15
QUANTITIES = ("moduli", "held-out modes")


@dataclass(frozen=True)
class Study:
    """All structures, and the gates."""

    structures: Sequence[Structure]

    def of(self, *kinds: str) -> list[Structure]:
        """Return the structures whose model has an error of these kinds."""
        return [one for one in self.structures if one.kind in kinds]

    def held(self, quantity: str, with_discrepancy: bool, *kinds: str) -> tuple[int, int]:
        """Return how many intervals hold their quantity, and their number."""
        found = [
            inside
            for one in self.of(*kinds)
            for inside in (one.parameters if quantity == QUANTITIES[0] else one.modes)[with_discrepancy]
        ]
        return sum(found), len(found)

    def widening(self, *kinds: str) -> float:
        """Return the median ratio of the widths of intervals of moduli, with a discrepancy to without."""
        ratios = [np.divide(one.widths[1], one.widths[0]) for one in self.of(*kinds)]
        return float(np.median(np.concatenate(ratios))) if ratios else np.nan

    @property
    def failures(self) -> list[str]:
        """Gates that fail, one sentence each."""
        found = []
        for quantity in QUANTITIES:
            held, n = self.held(quantity, True, "joint", "mass", "thickness")
            if not BAND[0] * n <= held <= BAND[1] * n:
                found.append(f"With a discrepancy {held / n:.1%} of intervals of {quantity} of wrong models hold.")
        if self.widening("right") > WIDER:
            found.append(f"The intervals of right models are wider by a factor of {self.widening('right'):.2f}.")
        return found


def page(study: Study, replicates: int) -> str:
    """Return the page; `replicates` is the number of structures that `make validate` updates."""
    failures, n = study.failures, len(study.structures)
    verdict = "**All gates pass.**" if not failures else "\n".join(f"- **{one}**" for one in failures)
    if n < replicates and not failures:
        verdict = (
            f"**No gate fails, but {n} of the {replicates} structures of `make validate` decide nothing yet.**"
        )
    rows, sizes = [], []
    for kind in ("joint", "mass", "thickness", "right"):
        of = study.of(kind)
        if not of:
            continue
        cells = [kind, f"{len(of)}"]
        for quantity in QUANTITIES:
            for with_discrepancy in (False, True):
                held, of_all = study.held(quantity, with_discrepancy, kind)
                cells.append(f"{100 * held / of_all:.1f} %")
        rows.append([*cells, f"{study.widening(kind):.2f}"])
        contradicted = [sum(one.fit[k] == "contradicted" for one in of) for k in (0, 1)]
        converged = [sum(one.converged[k] for one in of) for k in (0, 1)]
        tau = np.array([one.tau for one in of])
        seconds = np.median([one.processor_s for one in of], axis=0)
        sizes.append([
            kind, *(f"{one} of {len(of)}" for one in contradicted), *(f"{one} of {len(of)}" for one in converged),
            f"{np.median(tau[:, 0]):.3f}", f"{seconds[0]:.1f}, {seconds[1]:.1f}",
        ])  # fmt: skip
    head = ["error of the model", "structures"]
    head += [f"{quantity}, {how}" for quantity in QUANTITIES for how in ("without", "with")] + ["width ratio"]
    other = [
        "error of the model",
        "contradicted, without",
        "with",
        "converged, without",
        "with",
        "median τ",
        "CPU, s",
    ]
    return PAGE.format(
        verdict=verdict, n=n, replicates=replicates, coverage=markdown_table(head, rows, (0,)),
        sizes=markdown_table(other, sizes, (0,)), low=100 * BAND[0], high=100 * BAND[1], wider=WIDER,
        interval=100 * INTERVAL,
    )  # fmt: skip


PAGE = """# Structures whose model is wrong: coverage with and without a discrepancy

Written by `python -m tests.validation.wrong_structures results`, whose first lines say what is simulated.

{verdict}

{n} structures of the {replicates} of `make validate` are updated without a discrepancy, and with embedded
scatter, common to all regions (`fmu.Discrepancy()`). The first table has the shares of {interval:.0f} % intervals
that hold the true value of a modulus, or the measurement of a mode that the others predict. With a discrepancy
{low:.0f} to {high:.0f} % of the intervals of wrong models must hold, and intervals of the moduli of right models
may be wider by a factor of {wider} in the median. Runs that did not converge are counted.

{coverage}
{sizes}"""
