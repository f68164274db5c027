"""The gates and the page of the study of structures whose model is wrong."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from fmu.analysis.fit.check import LEVEL
from fmu.analysis.models.scatter import NEEDED
from fmu.tables import markdown_table
from tests.validation.wrong_beam import HELD, SIZES

if TYPE_CHECKING:
    from tests.validation.wrong_structures import Structure

KINDS = ("joint", "mass", "right", "thickness", "joint", "right", "mass", "thickness", "right")
"""Errors of the models of consecutive structures."""
INTERVAL = 0.9
BAND, WIDER = (0.85, 0.95), 1.15
SIGNAL, COSINE, QUALIFY, LARGEST = 3.0, 0.9, 0.5, 0.7
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

    def told(self, *kinds: str) -> list[Structure]:
        """Return the structures in which the group of the error can be told, which the draws do not decide."""
        return [one for one in self.of(*kinds) if one.signal > SIGNAL and one.cosine < COSINE]

    def false_alarms(self, with_discrepancy: bool) -> int:
        """Return how many right models are contradicted."""
        return sum(one.fit[with_discrepancy].startswith("contradicted") for one in self.of("right"))

    @property
    def failures(self) -> list[str]:
        """Gates that fail, one sentence each."""
        found = []
        for quantity in QUANTITIES:
            held, n = self.held(quantity, True, *HELD)
            if not BAND[0] * n <= held <= BAND[1] * n:
                found.append(f"With a discrepancy {held / n:.1%} of intervals of {quantity} of wrong models hold.")
        if self.widening("right") > WIDER:
            found.append(f"The intervals of right models are wider by a factor of {self.widening('right'):.2f}.")
        told, wrong = self.told(*HELD), self.of(*HELD)
        if len(told) < QUALIFY * len(wrong):
            found.append(f"The group can be told in only {len(told)} of {len(wrong)} structures.")
        largest = sum(finds_group(one) for one in told)
        if largest < LARGEST * len(told):
            found.append(f"The group of the error has the largest τ in only {largest} of {len(told)} structures.")
        # the verdict may be wrong in LEVEL of the right models, and their number is Poisson-distributed
        right = LEVEL * len(self.of("right"))
        if max(self.false_alarms(False), self.false_alarms(True)) > right + 3.0 * np.sqrt(right) + 1.0:
            found.append(f"More than {LEVEL:.0%} of right models are contradicted.")
        return found


def finds_group(one: Structure) -> bool:
    """Return whether the group of the error has the largest τ, in standard deviations of its prior."""
    relative = [tau / SIZES[group] for tau, group in zip(one.tau, HELD, strict=True)]
    return HELD[int(np.argmax(relative))] == one.kind


def page(study: Study, replicates: int, correlation: float = 0.0) -> str:
    """Return the page; `replicates` is the number of structures that `make validate` updates.

    `correlation` is the one of the scatter over the modes.
    """
    failures, n = study.failures, len(study.structures)
    verdict = "**All gates pass.**" if not failures else "\n".join(f"- **{one}**" for one in failures)
    if n < replicates:
        verdict += f"\n\nThese are {n} of the {replicates} structures of `make validate`."
    rows, sizes, groups = [], [], []
    for kind in (*HELD, "right"):
        of = study.of(kind)
        if not of:
            continue
        cells = [kind, f"{len(of)}"]
        for quantity in QUANTITIES:
            for with_discrepancy in (False, True):
                held, of_all = study.held(quantity, with_discrepancy, kind)
                cells.append(f"{100 * held / of_all:.1f} %")
        rows.append([*cells, f"{study.widening(kind):.2f}"])
        contradicted = [sum(one.fit[k].startswith("contradicted") for one in of) for k in (0, 1)]
        converged = [sum(one.converged[k] for one in of) for k in (0, 1)]
        seconds = np.median([one.processor_s for one in of], axis=0)
        sizes.append([
            kind, *(f"{one} of {len(of)}" for one in contradicted), *(f"{one} of {len(of)}" for one in converged),
            f"{seconds[0]:.1f}, {seconds[1]:.1f}",
        ])  # fmt: skip
        tau = np.median([one.tau for one in of], axis=0)
        told, needed = study.told(kind), np.array([one.needed for one in of]) >= NEEDED
        groups.append([
            kind, *(f"{100 * x:.1f} %" for x in tau), *(f"{k}" for k in np.sum(needed, axis=0)),
            *([f"{len(told)} of {len(of)}", f"{sum(map(finds_group, told))}"] if kind in HELD else ["", ""]),
        ])  # fmt: skip
    head = ["error of the model", "structures"]
    head += [f"{quantity}, {how}" for quantity in QUANTITIES for how in ("without", "with")] + ["width ratio"]
    other = ["error of the model", "contradicted, without", "with", "converged, without", "with", "CPU, s"]
    of_groups = ["error of the model", *(f"median τ, {group}" for group in HELD)]
    of_groups += [*(f"{group} needed" for group in HELD), "can be told", "largest τ"]
    every, told = study.of(*HELD), study.told(*HELD)
    coverage = [study.held(quantity, how, *HELD) for quantity in QUANTITIES for how in (False, True)]
    rows.append(["all wrong", f"{len(every)}", *(f"{100 * held / max(1, m):.1f} %" for held, m in coverage),
                 f"{study.widening(*HELD):.2f}"])  # fmt: skip
    return PAGE.format(
        verdict=verdict, n=n, correlation=f"{correlation:.1f}",
        coverage=markdown_table(head, rows, (0,)), sizes=markdown_table(other, sizes, (0,)),
        groups=markdown_table(of_groups, groups, (0,)), low=100 * BAND[0], high=100 * BAND[1], wider=WIDER,
        interval=100 * INTERVAL, signal=SIGNAL, cosine=COSINE, needed=100 * NEEDED, largest=100 * LARGEST,
        told=len(told), wrong=len(every), found=sum(map(finds_group, told)),
        raw=sum(HELD[int(np.argmax(one.tau))] == one.kind for one in told),
    )  # fmt: skip


PAGE = """# Structures whose model is wrong: coverage with and without a discrepancy

Written by `python -m tests.validation.wrong_structures results`, whose first lines say what is simulated.

{verdict}

{n} structures are updated without a discrepancy, and with embedded scatter of the joint, the thickness and the
mass (`fmu.Discrepancy(groups=("joint",), prior_sd=0.19, correlation={correlation})` and so on). The first table
has the shares of {interval:.0f} % intervals that hold the true value of a modulus, or the measurement of a mode
that the others predict. With a discrepancy {low:.0f} to {high:.0f} % of the intervals of wrong models must hold,
and intervals of the moduli of right models may be wider by a factor of {wider} in the median.
Runs that did not converge are counted.

{coverage}
The group of the error can be told if, by the linearised model and before any draw, its change of the frequencies
is more than {signal:.0f} standard deviations of what the moduli leave, and has a cosine below {cosine} with the
change by any other group. This holds for {told} of {wrong} wrong structures. In {found} of these the group of the
error has the largest posterior mean of τ in standard deviations of its prior; at least {largest:.0f} % must. By τ
itself it is the largest in {raw}. The prior standard deviation of each τ is the root mean square of the planted
errors, which a user would not know, and the design (modes, sensors, groups) was chosen among about a dozen with a
linear simulator, by the rates of this page: other designs will do worse. A group counts as needed if the
probability of a scatter is {needed:.0f} %.

{groups}
{sizes}"""
