"""Compare the error bounds of reduced models' frequencies with the errors found by full solves.

    python -m tests.validation.bound OUT [--kept DIRECTORY] [--minutes M] [--quick]

Writes ``bound.md``. Exit code 1 if an error exceeds its bound, or if the bound is far above the error.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import chain
from typing import Any, NamedTuple

import numpy as np

import fmu
from fmu import cases
from fmu.fem.modes.modal import ModalSolution, is_rigid
from fmu.fem.pairing.paired_structure import PairedStructure
from fmu.fem.reduced.basis import ReducedBlock
from fmu.fem.reduced.points import box_points
from fmu.fem.reduced.reduced_structure import ReducedStructure, reduced_structures, train
from fmu.fem.reduced.residuals import FrequencyBound
from fmu.numbers import MISSING, significant, whole
from fmu.tables import markdown_table
from fmu.types import FloatArray
from tests.fem.reduced.test_frequency_bound import BUILT, box
from tests.validation.kept import Units, fields_of, study_parser
from tests.validation.scale_model import Size, scale_problem

SEED = 2000
POINTS, FEWEST = 1000, 10
"""Points at which small structures are solved; the largest are solved at 10 × `FEWEST` points."""
AT_ONCE = 16
MOST_RATIO = 5.0
"""Largest median ratio of bound to error."""
UNIT = 2.0**-53
ROUNDINGS, SOLVER = 10.0, 1e-11
"""Rounding allowed: of a reduced eigenvalue, in `UNIT` times the highest one; and of a full solve, relative."""


class Case(NamedTuple):
    """A trained structure, its box, and the number of points at which it is solved."""

    name: str
    structure: ReducedStructure
    lower: FloatArray
    upper: FloatArray
    points: int


@dataclass(frozen=True)
class Found:
    """Result of a case. Errors and bounds are relative errors of frequencies.

    Attributes
    ----------
    basis : int
        Size of the reduced model.
    points, compared : int
        Number of points, and of elastic modes at all points.
    exceeded : int
        Number of modes whose error exceeds the bound by more than the rounding allowed.
    error, bound : float
        The largest error and the largest bound.
    ratios : ndarray
        Bound over error, for errors larger than ten times the rounding allowed.
    """

    name: str
    n_dof: int
    n_parameters: int
    basis: int
    points: int
    compared: int
    exceeded: int
    error: float
    bound: float
    ratios: FloatArray

    @property
    def is_sound(self) -> bool:
        """Whether no error exceeds its bound, and the bound is close enough to the error."""
        return self.exceeded == 0 and (len(self.ratios) == 0 or float(np.median(self.ratios)) <= MOST_RATIO)


def examined(case: Case) -> Found:
    """Compare errors and bounds of all trained modes, at points in the box, on its faces and at its corners."""
    full, reduced = case.structure.truth.blocks, case.structure.cheap.blocks
    points = box_points(case.lower, case.upper, 2 ** int(np.ceil(np.log2(case.points))), SEED)
    theta = points[np.random.default_rng(SEED).permutation(len(points))[: case.points]]
    bound = FrequencyBound(full, reduced, case.lower, case.upper, {})
    error, limit, rounding = [], [], []
    for b, block in enumerate(reduced):
        if not isinstance(block, ReducedBlock):
            continue
        labels = np.broadcast_to(np.arange(block.n_trained), (len(theta), block.n_trained))
        for first in range(0, len(theta), AT_ONCE):
            rows = slice(first, first + AT_ONCE)
            exact = full[b].eigenvalues(theta[rows], block.n_trained)
            found = block.eigenvalues(theta[rows], block.n_modes)
            modes = ModalSolution(exact, None, np.full_like(labels[rows], b), labels[rows])
            kept = np.isfinite(exact) & ~is_rigid(exact)
            lam = np.where(kept, exact, 1.0)
            error.append((np.sqrt(np.maximum(found[:, : block.n_trained], 0.0) / lam) - 1.0)[kept])
            limit.append(bound(theta[rows], modes)[kept])
            rounding.append((ROUNDINGS * UNIT * found[:, -1:] / lam)[kept] + SOLVER)
    errors, limits, lost = map(np.concatenate, (error, limit, rounding))
    clear = errors > 10.0 * lost
    return Found(
        case.name,
        sum(len(block.dofs) for block in full),
        len(case.lower),
        sum(case.structure.sizes),
        len(theta),
        len(errors),
        int(np.sum(errors > limits + lost)),
        float(errors.max()),
        float(limits.max()),
        limits[clear] / errors[clear],
    )


Group = Callable[[], list[Case]]
"""Function that makes the cases that are trained together."""


def shipped() -> Iterator[tuple[str, Group]]:
    """Yield the built-in cases."""
    for name in cases.names():
        yield name, lambda name=name: _of_problem(name, cases.load(name), POINTS)


def frames() -> Iterator[tuple[str, Group]]:
    """Yield the frames of the study of scale."""
    for size, n_parameters, tolerance, points in (
        (Size(3, 3, 2), 5, 1e-6, POINTS),
        (Size(12, 3, 2), 2, 1e-5, POINTS),
        (Size(28, 3, 2), 2, 1e-6, POINTS),
        (Size(28, 3, 2), 5, 1e-6, POINTS),
        (Size(28, 3, 2), 20, 1e-3, POINTS),
        (Size(70, 6, 4), 5, 1e-6, 10 * FEWEST),
        (Size(70, 6, 4), 50, 1e-3, 10 * FEWEST),
    ):
        name, of = f"frame, `{significant(tolerance, 1)}`", (size, n_parameters, tolerance)
        yield (
            f"{name}, {size}, {n_parameters}",
            lambda name=name, of=of, points=points: _of_problem(name, scale_problem(*of), points),
        )


def chains() -> Iterator[tuple[str, Group]]:
    """Yield small chains: free, with massless places, with crossing modes, with vanishing springs, and others."""
    for built in BUILT:
        yield built.__name__, lambda built=built: [_of_chain(built)]


def _of_problem(name: str, problem: fmu.UpdatingProblem | fmu.JointProblem, points: int) -> list[Case]:
    """Return the structures of a problem, one per test, each with the box for which it was trained."""
    every = reduced_structures(problem.model)
    return [Case(name, one, one.lower[0], one.upper[0], points) for one in every]


def _of_chain(built: Callable[[], Any]) -> Case:
    model, lower, upper = box(built)
    middle = 0.5 * (lower + upper)
    paired = PairedStructure.of(model, pairing="index", numbers=(2, 3, 4, 5), sensors=(), reference=middle)
    reduced, _ = train(paired, lower, upper, 1e-6)
    assert isinstance(reduced, ReducedStructure)  # narrowed for the type checker
    return Case(f"chain, {built.__name__}", reduced, lower, upper, POINTS)


def page(found: list[Found]) -> str:
    """Return the page in Markdown."""
    header = (
        "structure", "DOF", "parameters", "basis", "points", "modes compared", "errors above the bound",
        "largest error", "largest bound", "bound / error, median", "bound / error, smallest",
    )  # fmt: skip
    lines = []
    for of in found:
        ratios = [significant(float(f(of.ratios)), 3) if len(of.ratios) else MISSING for f in (np.median, np.min)]
        counts = map(whole, (of.n_dof, of.n_parameters, of.basis, of.points, of.compared, of.exceeded))
        lines.append((of.name, *counts, significant(of.error, 2), significant(of.bound, 2), *ratios))
    exceeded = sum(of.exceeded for of in found)
    medians = [(of.name, float(np.median(of.ratios))) for of in found if len(of.ratios)]
    loose = [f"{name} ({significant(ratio, 2)})" for name, ratio in medians if ratio > MOST_RATIO]
    said = f"Errors that exceed their bounds: {whole(exceeded)}." if exceeded else "No error exceeds its bound."
    if loose:
        said += f" Median ratios of bound to error above {MOST_RATIO:g}: {', '.join(loose)}."
    elif medians:
        largest = significant(max(ratio for _, ratio in medians), 2)
        said += f" The median ratio of bound to error is at most {largest}."
    return PAGE.format(said=said, most=MOST_RATIO, table=markdown_table(header, lines, words=(0,)))


def main(arguments: Sequence[str] | None = None) -> int:
    """Examine all cases and write the page."""
    parser = study_parser(__doc__)
    parser.add_argument("--quick", action="store_true", help="small structures alone")
    asked = parser.parse_args(arguments)
    groups = chain(*([] if asked.quick else [shipped(), frames()]), chains())
    found = Units(asked.kept, asked.minutes).completed(
        "structures",
        groups,
        lambda group: [asdict(examined(case)) for case in group()],
        lambda of: [fields_of(Found, np.array)(one) for one in of],
    )
    every = [one for of in found for one in of]
    (asked.out / "bound.md").write_text(page(every), encoding="utf-8")
    return 0 if all(of.is_sound for of in every) else 1


PAGE = """# Error bounds of reduced frequencies

Does the bound on the error of a reduced model's frequencies hold, and is it close to the error? **{said}**

The bound follows from the residuals of the reduced modes (`fmu.fem.reduced.residuals`). For the errors, the full
model is solved at points in the box of the parameters, on its faces and at its corners. Training has used none of
these points. All modes are compared for which the basis was trained. A median ratio of bound to error above
{most:g} fails.

- Errors and bounds are relative errors of frequencies. Rounding is allowed for: ten times the unit roundoff of
  the highest reduced eigenvalue, and 1e-11 for the full solve. Ratios are only of errors above ten times this
  allowance. A ratio down to 0.9 is therefore within the allowance.
- A block that is not reduced has only rounding errors, and its bound is zero.
- The frames are the models of [scale.md](scale.md), with the tolerance of their training.
- The chains have 60 masses and springs: with a stiffness for each half (halves), without a support (free), with
  uncertain masses (heavy), with a stiffness t³ and a mass t (plate), with every third mass missing (massless), as
  two weakly coupled chains with crossing modes (twins), and with a support that may become 10 000 times softer
  (vanishing) or vanish (gone).

{table}"""


if __name__ == "__main__":
    sys.exit(main())
