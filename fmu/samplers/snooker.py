"""The snooker move for emcee, with the acceptance factor of ter Braak & Vrugt (2008)."""

from __future__ import annotations

import numpy as np
from emcee.moves import RedBlueMove

from fmu.types import FloatArray


class SnookerMove(RedBlueMove):
    """Move a walker x along the line through another walker z.

    The candidate is x* = x + γ e (z₁ − z₂)·e with e = (x − z)/|x − z|, where z₁ and z₂ are two further walkers.
    The acceptance factor is (|x* − z|/|x − z|)^(ndim−1). This class replaces emcee's own ``DESnookerMove`` (up to
    3.1.6), which divides by the square root of |x − z| and takes half the exponent, and so does not leave the
    target invariant.

    Parameters
    ----------
    gamma : float
        Length factor γ of the jump; ter Braak & Vrugt recommend 1.7.

    References
    ----------
    ter Braak & Vrugt (2008), Statistics and Computing 18, 435-446, eq. (4)-(5).
    """

    def __init__(self, gamma: float = 1.7) -> None:
        self.gamma = gamma
        super().__init__()

    def get_proposal(
        self, s: FloatArray, c: list[FloatArray], random: np.random.RandomState
    ) -> tuple[FloatArray, FloatArray]:
        """Return candidates for the walkers `s` (n, ndim), and the logarithms of their acceptance factors, (n,).

        Each candidate uses three different walkers from `c`, the rest of the ensemble. A walker at the same point
        as its z stays there.
        """
        rest = np.concatenate(c, axis=0)
        n, ndim = s.shape
        z, z1, z2 = rest[np.argsort(random.rand(n, len(rest)), axis=1)[:, :3].T]
        before = np.linalg.norm(s - z, axis=1)
        apart = before > 0  # two walkers at the same point define no line: no move
        e = (s - z) / np.where(apart, before, 1.0)[:, None]
        q = s + self.gamma * e * np.sum((z1 - z2) * e, axis=1, keepdims=True)
        after = np.linalg.norm(q - z, axis=1)
        factor = np.zeros(n)
        with np.errstate(divide="ignore"):  # a candidate on z itself has factor 0
            factor[apart] = (ndim - 1) * (np.log(after[apart]) - np.log(before[apart]))
        return q, factor
