"""Classification of the box into regions where a slow model can be solved and where it fails."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from fmu.numbers import names_in_words, significant
from fmu.types import BoolArray, FloatArray

if TYPE_CHECKING:
    from sklearn.tree import DecisionTreeClassifier

_STRICT = 1e6  # penalty of a misclassified point: failures of a solver are not noise
_WORDS_DEPTH = 3
_NAMED = 0.2
"""Smallest number of failures in a region that is described, relative to the region with the most failures."""
EDGE = 0.9
"""Largest |margin| of an undecided point; it is 1 at the solved and failed points nearest to the boundary."""


class Feasibility:
    """Support-vector classifier for the points at which a model can be solved.

    If no solve failed, every point is classified as feasible.

    Parameters
    ----------
    x : ndarray, shape (N, d)
        Points at which the model was called, in scaled coordinates.
    failed : ndarray of bool, shape (N,)
        Whether the solve at each point failed; at least one solve must have succeeded.
    """

    def __init__(self, x: FloatArray, failed: BoolArray) -> None:
        self.n_failed = int(np.sum(failed))
        if not self.n_failed:
            return
        from sklearn.svm import SVC

        machine = SVC(C=_STRICT, kernel="rbf", gamma=1.0 / x.shape[1]).fit(x, ~failed)
        self._support, self._weight = machine.support_vectors_, machine.dual_coef_[0]
        self._gamma, self._offset = 1.0 / x.shape[1], float(machine.intercept_[0])

    def __call__(self, x: FloatArray) -> BoolArray:
        """Return a mask (n,) that is False for points x (n, d) with a margin of −`EDGE` or less.

        Undecided points count as feasible. If that is wrong, solving the point shows it, whereas a point wrongly
        classified as infeasible would never be solved.
        """
        return self.margin(x) > -EDGE

    def margin(self, x: FloatArray) -> FloatArray:
        """Return the classification margin (n,) of points x (n, d). It is infinite if no solve has failed.

        It is 1 at the solved points nearest to the boundary, and −1 at the nearest failures.
        """
        if not self.n_failed:
            return np.full(len(x), np.inf)
        squares = np.zeros((len(x), len(self._support)))
        for j in range(x.shape[1]):
            squares += (x[:, j, None] - self._support[:, j]) ** 2
        return np.sum(self._weight * np.exp(-self._gamma * squares), axis=1) + self._offset


def failed_region(theta: FloatArray, failed: BoolArray, names: Sequence[str]) -> str:
    """Return a phrase that describes where a model failed, by bounds that few of the solved points satisfy.

    The regions are leaves of a decision tree of depth three. A leaf is named if it has at least a fifth as many
    failures as the worst leaf.

    Parameters
    ----------
    theta : ndarray, shape (N, d)
        Points at which the model was called.
    failed : ndarray of bool, shape (N,)
        Whether the solve at each point failed.
    names : sequence of str
        Names of the d parameters.
    """
    from sklearn.tree import DecisionTreeClassifier

    scale = np.ptp(theta, axis=0)
    scale[scale == 0.0] = 1.0
    tree = DecisionTreeClassifier(max_depth=_WORDS_DEPTH, random_state=0).fit(theta / scale, failed)
    leaf = tree.apply(theta / scale)
    of_leaf = {int(one): int(np.sum(failed[leaf == one])) for one in np.unique(leaf)}
    least = max(_NAMED * max(of_leaf.values()), 1.0)
    named = [one for one in sorted(of_leaf, key=lambda one: -of_leaf[one]) if of_leaf[one] >= least]
    regions = [f"{of_leaf[one]} where {_bounds_of(tree, leaf == one, theta, scale, names)}" for one in named]
    there, n_failed = np.isin(leaf, named), int(np.sum(failed))
    other = n_failed - sum(of_leaf[one] for one in named)
    rest = [f"{other} elsewhere"] if other else []
    return (
        f"of its {n_failed} failures {names_in_words([*regions, *rest])}; "
        f"{int(np.sum(there & ~failed))} points {'there' if len(named) == 1 else 'in these regions'} were solved"
    )


def _bounds_of(
    tree: DecisionTreeClassifier, inside: BoolArray, theta: FloatArray, scale: FloatArray, names: Sequence[str]
) -> str:
    """Return a phrase with the bounds of the tree leaf that contains the points `inside` (N,).

    Return "nearly everywhere" if the leaf has no bounds.
    """
    path = np.flatnonzero(tree.decision_path(theta[inside][:1] / scale).toarray()[0])
    lowest: dict[int, float] = {}
    highest: dict[int, float] = {}
    for node, following in pairwise(path):
        j = int(tree.tree_.feature[node])
        value = float(tree.tree_.threshold[node] * scale[j])
        if following == tree.tree_.children_left[node]:
            highest[j] = min(value, highest.get(j, np.inf))
        else:
            lowest[j] = max(value, lowest.get(j, -np.inf))
    bounds = [f"{names[j]} is above {significant(value, 3)}" for j, value in sorted(lowest.items())]
    bounds += [f"{names[j]} is below {significant(value, 3)}" for j, value in sorted(highest.items())]
    return " and ".join(bounds) if bounds else "nearly everywhere"
