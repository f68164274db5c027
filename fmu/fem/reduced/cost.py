"""Cost estimates for solving one block, from matrix sizes alone, and memory estimates for a run.

Decisions based on these costs do not depend on a clock.

The unit is about one second on a core from 2020. The constants for full solves were fitted to frames, shells and
solids with 900 to 100 000 degrees of freedom, solved by SuperLU and LAPACK. The constants for reduced solves were
fitted to 45 to 480 vectors and 5 to 50 terms in batches of 64 (results/scale.md). The fits agree mostly within a
third. Costs are compared only with each other and with the limit `fmu.fem.reduced.training.CHEAP`. On other
machines, the ratios of costs are correct within a factor of two.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass

from fmu.engines.memory import free_memory
from fmu.fem.modes.eigensolver import DENSE_LIMIT
from fmu.fem.modes.full_block import FullBlock, memory_of_terms
from fmu.fem.modes.separable import SeparableModel
from fmu.fem.modes.solver import LARGE, Factor
from fmu.fem.reduced.shared import MEMORY
from fmu.numbers import significant

# Cost of a factorisation per entry of the factors, and per square of the number of entries divided by the number
# of rows; cost of a solve per entry.
_AN_ENTRY, _AN_ELIMINATION, _A_SOLVE = 2e-8, 5e-11, 6e-10
# Number of Lanczos iterations of an eigenproblem, and the cost of an iteration besides its linear solve.
_ITERATIONS, _AN_ITERATION = 40, 1.2e-4
# Cost of a reduced solve, of its terms, and of its eigenproblem: with a regular or possibly singular mass matrix.
_A_REDUCED_SOLVE, _A_TERM, _STANDARD, _SINGULAR = 1e-4, 2.5e-10, 1.6e-10, 4e-10
_PAYS = 3.0
# Number of factors that exist at a time (of an anchor point and of a count of eigenvalues), and number of vectors
# to which training led in frames, solids and shells.
_FACTORS, _VECTORS = 2, 80


@dataclass(frozen=True)
class Cost:
    """Sizes of one large block that determine how much its solves cost.

    Attributes
    ----------
    n_dof : int
        Number of degrees of freedom.
    n_entries : int
        Number of entries in the factors of the stiffness matrix.
    n_terms : int
        Number of stiffness terms, plus the number of mass terms if parameters change the mass.
    massless : bool
        Whether the mass matrix is singular.
    """

    n_dof: int
    n_entries: int
    n_terms: int
    massless: bool

    @classmethod
    def of(cls, block: FullBlock, factor: Factor) -> Cost | None:
        """Return a block's cost, given its stiffness factors.

        Return None for a block of at most `DENSE_LIMIT` degrees of freedom, which is solved densely.
        """
        if block.size <= DENSE_LIMIT:
            return None
        n_terms = len(block.K_terms) + (0 if block.constant_mass else len(block.M_terms))
        return cls(block.size, factor.n_entries, n_terms, block.massless)

    @property
    def solve(self) -> float:
        """Cost of one iteration with existing factors: one linear solve, and all other operations."""
        return _AN_ITERATION + _A_SOLVE * self.n_entries

    @property
    def full(self) -> float:
        """Cost of computing the lowest modes of the full block at one theta."""
        elimination = _AN_ENTRY * self.n_entries + _AN_ELIMINATION * self.n_entries**2 / self.n_dof
        return elimination + _ITERATIONS * self.solve

    def of_reduced(self, size: int) -> float:
        """Return the cost of computing all modes in a basis with `size` vectors at one theta."""
        eigenproblem = (_SINGULAR if self.massless else _STANDARD) * size**3
        return _A_REDUCED_SOLVE + _A_TERM * self.n_terms * size**2 + eigenproblem

    def visit(self, size: int, count: int) -> float:
        """Return the cost of error bounds for `count` modes at one theta, in a space with `size` vectors."""
        return 2.0 * self.of_reduced(size) + count * self.solve

    def most_vectors(self) -> int:
        """Return the size of the largest basis whose solve costs at most a third of a full solve."""
        sizes = range(2, self.n_dof)
        return 1 + bisect_right(sizes, self.full, key=lambda size: _PAYS * self.of_reduced(size))


def memory_in_words(model: SeparableModel) -> str:
    """Return a sentence on the memory that a run with a reduced model needs, or "" if no factors are stored.

    Factors are stored for blocks with at least `LARGE` degrees of freedom that have been solved. If too little
    memory is free for the run, the sentence says so. The constants were determined from frames, solids and shells
    (results/large-structures.md), where the estimates agree with the measured peaks within a fifth.
    """
    kept = [model.last_factor(dofs).factor for dofs in model.blocks if len(dofs) >= LARGE]
    of_factors = sum(factor.n_bytes for factor in kept if factor is not None)
    if not of_factors:
        return ""
    terms = (*model.K_terms, *model.M_terms)
    held, needed = memory_of_terms(model.K_terms, model.M_terms)
    vector = 8 * model.n_dof * _VECTORS
    needed += _FACTORS * of_factors + vector + min(vector * len(terms), MEMORY)
    free = free_memory()
    is_short = free is not None and needed > held + of_factors + free
    beside = (
        f", but only {significant(free / 2**30, 2)} GiB more are free" if is_short and free is not None else ""
    )
    by = ", in single precision" if any(factor is not None and factor.is_single for factor in kept) else ""
    return (
        f"A run takes about {significant(needed / 2**30, 2)} GiB of memory, of which the factors of one stiffness "
        f"matrix take {significant(of_factors / 2**30, 2)} GiB{by}{beside}."
    )
