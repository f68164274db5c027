"""Work that a problem costs, counted in factorisations and eigenproblems of its full model: no clock."""

from contextlib import contextmanager
from dataclasses import dataclass
from unittest.mock import patch

import numpy as np

from fmu.fem.modes import eigensolver, full_block, solver, stacks
from fmu.fem.reduced import anchors, residuals


@dataclass
class Work:
    """Factorisations of sparse or dense matrices, eigenproblems of the full model, and solves with factors."""

    factorisations: int = 0
    eigenproblems: int = 0
    solves: int = 0


class _Counted:
    def __init__(self, factor, work):
        self._factor, self._work = factor, work

    def __getattr__(self, name):
        return getattr(self._factor, name)

    def solve(self, loads):
        self._work.solves += 1 if loads.ndim == 1 else loads.shape[1]
        return self._factor.solve(loads)


@contextmanager
def counted():
    """Count the work of a block."""
    work = Work()

    def factorised(*arguments, **options):
        work.factorisations += 1
        found = solver.factorise(*arguments, **options)
        return found if isinstance(found, solver.DenseFactor) else _Counted(found, work)

    def eigen(*arguments, **options):
        work.eigenproblems += 1
        return eigensolver.eigen(*arguments, **options)

    def lowest_modes(*arguments):
        found = stacks.lowest_modes(*arguments)
        work.eigenproblems += int(np.sum(np.isfinite(found[0][:, 0])))  # the others are left to `eigen`
        return found

    with (
        patch.object(eigensolver, "factorise", factorised),
        patch.object(anchors, "factorise", factorised),
        patch.object(residuals, "factorise", factorised),
        patch.object(full_block, "eigen", eigen),
        patch.object(full_block, "lowest_modes", lowest_modes),
    ):
        yield work
