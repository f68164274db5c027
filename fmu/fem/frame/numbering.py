"""Which degrees of freedom a frame has: supports take some away, ties make two of them one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp

from fmu.fem.frame.joints import DIRECTIONS, JointSpring
from fmu.types import IntArray

Dof = tuple[int, str]


@dataclass(frozen=True, eq=False)
class Numbering:
    """The free degrees of freedom of a frame among the six of every node.

    Attributes
    ----------
    owner : ndarray of int, shape (6 n_nodes,)
        The one of 6 · node + 0 … 5 that stands for each: itself, or that which it is tied to.
    free : ndarray of int
        Those that stand for themselves and no support holds, ascending.
    """

    owner: IntArray
    free: IntArray

    @classmethod
    def of(cls, n_nodes: int, supports: Mapping[int, Sequence[str]], springs: Sequence[JointSpring]) -> Numbering:
        """Return the numbering.

        Raises
        ------
        ValueError
            If a support or spring is at a node that does not exist, a direction is unknown, or nothing is free.
        """
        owner = np.arange(6 * n_nodes)
        for spring in springs:
            for node in spring.nodes:
                if node is not None:
                    require_node(f"spring {spring.name!r}", node, n_nodes)
            for direction in spring.tied:
                k = DIRECTIONS.index(direction)
                pair = owner[[6 * int(node) + k for node in spring.nodes if node is not None]]
                owner[np.isin(owner, pair)] = pair.min()
        fixed: set[int] = set()
        for node, directions in supports.items():
            require_node("supports", node, n_nodes)
            for direction in directions:
                if direction not in DIRECTIONS:
                    raise ValueError(f"supports: direction must be one of {DIRECTIONS} (got {direction!r})")
                fixed.add(int(owner[6 * node + DIRECTIONS.index(direction)]))
        own = np.flatnonzero(owner == np.arange(len(owner)))
        free = own[~np.isin(own, list(fixed))]
        if not len(free):
            raise ValueError(f"supports: must leave a degree of freedom free (got all {len(owner)} fixed)")
        return cls(owner, free)

    @property
    def names(self) -> list[Dof]:
        """The free degrees of freedom as (node, direction)."""
        return [_name(i) for i in self.free.tolist()]

    @property
    def ties(self) -> dict[Dof, Dof]:
        """The degrees of freedom that move as another, free one."""
        tied = np.flatnonzero((self.owner != np.arange(len(self.owner))) & np.isin(self.owner, self.free))
        return {_name(i): _name(j) for i, j in zip(tied.tolist(), self.owner[tied].tolist(), strict=True)}

    def restricted(self, matrix: Any) -> Any:
        """Return the matrix (6 n_nodes, 6 n_nodes) on the free degrees of freedom, those tied added up."""
        n = len(self.owner)
        if np.any(self.owner != np.arange(n)):
            T = sp.csr_array((np.ones(n), (np.arange(n), self.owner)), shape=(n, n))
            matrix = sp.csr_array(T.T @ matrix @ T)
        return matrix[self.free][:, self.free]


def require_node(where: str, node: int, n_nodes: int) -> None:
    """Raise ValueError unless `node` is one of 0 … n_nodes − 1."""
    if not 0 <= node < n_nodes:
        raise ValueError(f"{where}: node must lie in 0..{n_nodes - 1} (got {node})")


def _name(dof: int) -> Dof:
    return dof // 6, DIRECTIONS[dof % 6]
