"""Where in the box a slow model can be solved, learnt from where it failed."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from fmu.numbers import significant
from fmu.types import BoolArray, FloatArray

_STRICT = 1e6  # penalty of a point on the wrong side: failures of a solver are no noise
_WORDS_DEPTH = 3
EDGE = 0.9
"""Largest |margin| of points that may be on either side: at those solved and failed next to the edge it is 1."""


class Feasibility:
    """Which points can be solved: a support-vector machine where some failed, otherwise all of them.

    Parameters
    ----------
    x : ndarray, shape (N, d)
        Points that were solved or failed, in scaled coordinates.
    failed : ndarray of bool, shape (N,)
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
        """Return whether points (n, d) may be solved, (n,): all but those beyond the nearest failures.

        A point that is wrongly taken for one that can be solved is found out when it is solved. One that is
        wrongly taken for a failure would never be solved.
        """
        return self.margin(x) > -EDGE

    def margin(self, x: FloatArray) -> FloatArray:
        """Return how far points (n, d) are on the side of those solved, (n,); 1 at the nearest of these."""
        if not self.n_failed:
            return np.full(len(x), np.inf)
        squares = np.zeros((len(x), len(self._support)))
        for j in range(x.shape[1]):
            squares += (x[:, j, None] - self._support[:, j]) ** 2
        return np.sum(self._weight * np.exp(-self._gamma * squares), axis=1) + self._offset


def failed_region(theta: FloatArray, failed: BoolArray, names: Sequence[str]) -> str:
    """Return in words where a model failed: bounds that hold for failed points and for few others.

    They are the leaf with the most failures of a decision tree of depth three.

    Parameters
    ----------
    theta : ndarray, shape (N, d)
    failed : ndarray of bool, shape (N,)
    names : sequence of str, d
    """
    from sklearn.tree import DecisionTreeClassifier

    scale = np.ptp(theta, axis=0)
    scale[scale == 0.0] = 1.0
    tree = DecisionTreeClassifier(max_depth=_WORDS_DEPTH, random_state=0).fit(theta / scale, failed)
    leaf = tree.apply(theta / scale)
    of_leaf = {int(one): int(np.sum(failed[leaf == one])) for one in np.unique(leaf)}
    chosen = max(of_leaf, key=lambda one: of_leaf[one])
    inside = leaf == chosen
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
    where = " and ".join(bounds) if bounds else "nearly everywhere"
    return (
        f"{of_leaf[chosen]} of its {int(np.sum(failed))} failures are where {where}; "
        f"{int(np.sum(inside & ~failed))} points there were solved"
    )
