"""What solves of one block cost, counted from sizes: decisions that rest on it do not depend on a clock.

The unit is about a second of one core of 2020. The constants were fitted to solves of frames, shells and solids of
900 to 100 000 degrees of freedom by SuperLU and LAPACK; what is compared are ratios, which hold within a factor of
two on other machines too.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass

from fmu.fem.modes.eigensolver import DENSE_LIMIT
from fmu.fem.modes.full_block import FullBlock
from fmu.fem.modes.solver import Factor

# A factorisation, by the entries of the factors and by their square over the rows; a solve with them.
_AN_ENTRY, _AN_ELIMINATION, _A_SOLVE = 2e-8, 5e-11, 6e-10
# Lanczos iterations of an eigenproblem, and what one costs besides its solve.
_ITERATIONS, _AN_ITERATION = 40, 1.2e-4
# A reduced solve, its terms, and its eigenproblem: with a mass matrix that may be singular it takes longer.
_A_REDUCED_SOLVE, _A_TERM, _STANDARD, _SINGULAR = 1e-4, 1e-9, 2.5e-10, 6e-10
_PAYS = 3.0


@dataclass(frozen=True)
class Cost:
    """The cost of solving one large block.

    Attributes
    ----------
    n_dof : int
    n_entries : int
        Of the factors of its stiffness matrix.
    n_terms : int
        Of stiffness and mass.
    massless : bool
        Whether degrees of freedom have no mass.
    """

    n_dof: int
    n_entries: int
    n_terms: int
    massless: bool

    @classmethod
    def of(cls, block: FullBlock, factor: Factor) -> Cost | None:
        """Return the cost of a block, given the factors of its stiffness; None of a small one."""
        if block.size <= DENSE_LIMIT:
            return None
        n_terms = len(block.K_terms) + (0 if block.constant_mass else len(block.M_terms))
        return cls(block.size, factor.n_entries, n_terms, block.massless)

    @property
    def solve(self) -> float:
        """Of one right-hand side with the factors at hand."""
        return _AN_ITERATION + _A_SOLVE * self.n_entries

    @property
    def full(self) -> float:
        """Cost of the lowest modes of the full block at one theta."""
        elimination = _AN_ENTRY * self.n_entries + _AN_ELIMINATION * self.n_entries**2 / self.n_dof
        return elimination + _ITERATIONS * self.solve

    def of_reduced(self, size: int) -> float:
        """Of all modes in a basis of `size` vectors, at one theta."""
        eigenproblem = (_SINGULAR if self.massless else _STANDARD) * size**3
        return _A_REDUCED_SOLVE + _A_TERM * self.n_terms * size**2 + eigenproblem

    def visit(self, size: int, count: int) -> float:
        """Of the bounds of `count` modes by their residuals in a space of `size` vectors, at one theta."""
        return 2.0 * self.of_reduced(size) + count * self.solve

    def most_vectors(self) -> int:
        """Return the size of the largest basis whose solves take a third of a full one."""
        sizes = range(2, self.n_dof)
        return 1 + bisect_right(sizes, self.full, key=lambda size: _PAYS * self.of_reduced(size))
