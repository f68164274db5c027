"""Test–model correlation of shapes, at each sensor and for close modes, and correlation between measured modes.

After pairing, `computed` and `measured` are shapes at the same sensors, one column per measured mode. Measured
shapes are scaled to the computed shapes by least absolute deviations (`scale_shapes`), so that a single wrong
sensor has little influence.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse.csgraph import connected_components

from fmu.fem.modes.modal import mac
from fmu.numbers import fixed, names_in_words
from fmu.tables import data_frame
from fmu.types import FloatArray, IntArray

if TYPE_CHECKING:
    import pandas as pd

CLOSE = 0.01
"""Relative difference below which two frequencies are hard to tell apart."""
ALIKE = 0.8
"""MAC below which two shapes hardly belong to the same mode."""
ALIASED = 0.9
"""AutoMAC above which the sensors cannot tell two measured modes apart."""
SUSPECT, TIMES = 0.1, 3.0
"""A sensor is suspect if its ECoMAC exceeds `SUSPECT`, and `TIMES` times the median over all sensors."""
LOOK_AT_SENSORS = (
    "CoMAC is 1 and ECoMAC 0 at a sensor where measured and computed motion agree over the paired modes: look for "
    "single sensors that stand out. CoMAC near 1 with a large ECoMAC is a wrong sign or scale."
)
LOOK_AT_SHAPES = (
    "AutoMAC, the MAC of the measured shapes with each other, should be small off the diagonal: look for modes "
    "that the sensors cannot tell apart."
)
_FEWEST_SENSORS, _FEWEST_MODES = 4, 2
_MOST_NAMED = 5
_TRIED = 8
"""Number of sensors with the largest ECoMAC among which every pair is tried for a swap."""
_DEPENDENT = 1e-8
"""Singular value of unit-length shapes below which the shapes are linearly dependent."""


def scale_shapes(measured: FloatArray, computed: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the measured shapes fitted to the computed shapes, and the computed shapes scaled to mean square 1.

    Both have shape (n_sensors, n_modes). Each measured shape φ, which must not be zero, is multiplied by the
    factor c that minimises Σ_j |c φ_j − ψ_j|, where ψ is the scaled computed shape: c is the median of ψ_j/φ_j
    with weights |φ_j|. A computed shape that is zero at all sensors stays zero.
    """
    size = np.sqrt(np.mean(computed**2, axis=0))
    psi = np.divide(computed, size, out=np.zeros_like(computed), where=size > 0)
    return np.stack([_factor(phi, ref) * phi for phi, ref in zip(measured.T, psi.T, strict=True)], axis=1), psi


def _factor(phi: FloatArray, psi: FloatArray) -> float:
    moves = phi != 0.0
    ratio, weight = psi[moves] / phi[moves], np.abs(phi[moves])
    order = np.argsort(ratio)
    passed = np.cumsum(weight[order])
    return float(ratio[order][np.searchsorted(passed, 0.5 * passed[-1])])


def comac(measured: FloatArray, computed: FloatArray) -> FloatArray:
    """Return each sensor's coordinate modal assurance criterion (Lieven & Ewins 1988), shape (n_sensors,).

    CoMAC_j = (Σ_k |φ_jk ψ_jk|)² / (Σ_k φ_jk² Σ_k ψ_jk²) over the paired modes k, where φ and ψ are the measured
    and the computed shapes after `scale_shapes`. It is 1 if the components of φ and ψ at the sensor are
    proportional, whatever their signs, or all zero. It is 0 if only the measured or only the computed components
    are all zero.
    """
    phi, psi = scale_shapes(measured, computed)
    size = np.sum(phi**2, axis=1) * np.sum(psi**2, axis=1)
    still = np.all(phi == 0, axis=1) & np.all(psi == 0, axis=1)
    return np.divide(np.sum(np.abs(phi * psi), axis=1) ** 2, size, out=still.astype(float), where=size > 0)


def ecomac(measured: FloatArray, computed: FloatArray) -> FloatArray:
    """Return each sensor's enhanced CoMAC (Hunt 1992, IMAC X), shape (n_sensors,).

    ECoMAC_j = Σ_k |φ_jk − ψ_jk| / 2m over m paired modes, where φ and ψ are the measured and the computed shapes
    after `scale_shapes`. Its unit is the computed shape's root mean square. It is 0 where the shapes are equal in
    sign and size, and the mean of |ψ_jk| where only the signs are wrong.
    """
    phi, psi = scale_shapes(measured, computed)
    return np.asarray(0.5 * np.mean(np.abs(phi - psi), axis=1))


def subspace_mac(measured: FloatArray, computed: FloatArray) -> FloatArray:
    """Return cos² of the principal angles between the subspaces that two sets of shapes span, largest first.

    For m ≤ r, the smallest value is 1 if the measured shapes are independent combinations of the computed shapes
    (Björck & Golub 1973). This is so for close modes that differ only by a rotation among themselves. For two
    single shapes the value is their MAC. Linearly dependent shapes give zeros.

    Parameters
    ----------
    measured : ndarray, shape (n_sensors, m)
    computed : ndarray, shape (n_sensors, r)

    Returns
    -------
    ndarray, shape (min(n_sensors, m, r),)
    """
    cosines = np.linalg.svd(_orthonormal(measured).T @ _orthonormal(computed), compute_uv=False)
    return np.clip(cosines, 0.0, 1.0) ** 2


def _orthonormal(shapes: FloatArray) -> FloatArray:
    """Return orthonormal columns that span the shapes.

    If shapes are linearly dependent, the surplus columns are zero.
    """
    size = np.linalg.norm(shapes, axis=0)
    unit = np.divide(shapes, size, out=np.zeros_like(shapes), where=size > 0)
    U, s, _ = np.linalg.svd(unit, full_matrices=False)
    return np.asarray(U * (s > _DEPENDENT))


def close_groups(*frequencies: ArrayLike, within: float = CLOSE) -> tuple[tuple[int, ...], ...]:
    """Return groups of two or more modes with close frequencies.

    Parameters
    ----------
    *frequencies : array_like, shape (n_modes,)
        Frequencies of the same modes, such as measured and computed frequencies. Two modes are close if their
        frequencies in one of the arrays have a relative difference of less than `within`.

    Returns
    -------
    tuple of tuple of int
        Mode indices (from 0) in each group. Every mode is close to another mode in its group.
    """
    near = np.zeros((len(np.asarray(frequencies[0])),) * 2, dtype=bool)
    for f in map(np.asarray, frequencies):
        near |= np.abs(f[:, None] / f - 1.0) < within
    label = connected_components(near)[1]
    groups = (np.flatnonzero(label == k) for k in range(label.max() + 1))
    return tuple(tuple(group.tolist()) for group in groups if len(group) > 1)


@dataclass(frozen=True, eq=False)
class Correlation:
    """Comparison of the measured and computed shapes of paired modes.

    Attributes
    ----------
    sensors : tuple of str
        Place and direction of each sensor, in words.
    labels : tuple of str
        Labels of the measured modes.
    measured, computed : ndarray, shape (n_sensors, n_modes)
    groups : tuple of tuple of int
        Mode indices (from 0) in each group of close frequencies; see `close_groups`.
    """

    sensors: tuple[str, ...]
    labels: tuple[str, ...]
    measured: FloatArray
    computed: FloatArray
    groups: tuple[tuple[int, ...], ...] = ()

    @cached_property
    def comac(self) -> FloatArray:
        """CoMAC of each sensor, shape (n_sensors,)."""
        return comac(self.measured, self.computed)

    @cached_property
    def ecomac(self) -> FloatArray:
        """ECoMAC of each sensor, shape (n_sensors,)."""
        return ecomac(self.measured, self.computed)

    @cached_property
    def auto_mac(self) -> FloatArray:
        """MAC of the measured shapes with each other, shape (n_modes, n_modes)."""
        return mac(self.measured, self.measured)

    @cached_property
    def subspace(self) -> dict[int, float]:
        """Smallest cos² of the principal angles between a group's measured and computed subspaces, keyed by mode.

        Modes outside the groups are left out. Groups with at least as many modes as there are sensors are left out
        too, because they span the whole space.
        """
        few = (list(group) for group in self.groups if len(group) < len(self.sensors))
        least = {tuple(g): float(subspace_mac(self.measured[:, g], self.computed[:, g])[-1]) for g in few}
        return {k: value for group, value in least.items() for k in group}

    @property
    def suspects(self) -> IntArray:
        """Indices of suspect sensors, worst first, shape (n_suspects,).

        A sensor is suspect if its ECoMAC stands out (`SUSPECT`, `TIMES`), or if it appears to be swapped with
        another. The array is empty if there are too few sensors or modes to tell.
        """
        if not self.is_enough:
            return np.zeros(0, dtype=np.int64)
        least = max(SUSPECT, TIMES * float(np.median(self.ecomac)))
        order = np.argsort(-self.ecomac, kind="stable")
        stands_out = self.ecomac > least
        stands_out[list(self.exchanged)] = True
        return order[stands_out[order]]

    @property
    def is_enough(self) -> bool:
        """Whether there are enough sensors and modes to suspect a sensor."""
        return len(self.sensors) >= _FEWEST_SENSORS and len(self.labels) >= _FEWEST_MODES

    @cached_property
    def exchanged(self) -> tuple[int, ...]:
        """Indices of two sensors that appear to be swapped, or an empty tuple.

        Two sensors appear to be swapped if both agree with the model once their measured values are swapped. The
        tuple is empty if no two sensors do, or if there are too few sensors or modes to tell. This check does not
        compare ECoMACs with their median, because two bad sensors among few do not stand out from the median.
        """
        worst = np.argsort(-self.ecomac, kind="stable")[:_TRIED].tolist()
        if not self.is_enough or self.ecomac[worst[0]] <= SUSPECT:
            return ()
        errors = {pair: self._ecomac_exchanged(pair) for pair in combinations(worst, 2)}
        pair = min(errors, key=lambda one: float(errors[one].sum()))
        before, after = self.ecomac[list(pair)], errors[pair][list(pair)]
        is_explained = before.min() > SUSPECT > after.max() and TIMES * after.sum() < before.sum()
        return tuple(sorted(pair)) if is_explained else ()

    def _ecomac_exchanged(self, pair: tuple[int, ...]) -> FloatArray:
        """Return each sensor's ECoMAC after swapping the measured values of two sensors, shape (n_sensors,)."""
        order = np.arange(len(self.sensors))
        order[list(pair)] = pair[::-1]
        return ecomac(self.measured[order], self.computed)

    def doubts_of_sensors(self) -> list[str]:
        """Return warnings about two swapped sensors, if any, and about the five worst of the other suspects."""
        phi, psi = scale_shapes(self.measured, self.computed)
        middle, found = float(np.median(self.ecomac)), []
        if self.exchanged:
            before, after = (
                names_in_words([fixed(of[j], 2) for j in self.exchanged])
                for of in (self.ecomac, self._ecomac_exchanged(self.exchanged))
            )
            both = names_in_words([self.sensors[j] for j in self.exchanged])
            found.append(
                f"Sensors {both}: exchanged, they would agree with the model (ECoMAC {before}; exchanged "
                f"{after}); look at their cables and places."
            )
        for j in [j for j in self.suspects.tolist() if j not in self.exchanged][:_MOST_NAMED]:
            turned = 0.5 * float(np.mean(np.abs(phi[j] + psi[j])))
            look = "look at its place and direction, and at the model there"
            if turned < max(SUSPECT, TIMES * middle):
                look = "with the opposite sign it would agree"
            found.append(
                f"Sensor {self.sensors[j]}: test and model disagree (ECoMAC {fixed(self.ecomac[j], 2)}, median of "
                f"all sensors {fixed(middle, 2)}; CoMAC {fixed(self.comac[j], 2)}); {look}."
            )
        return found

    def sensors_in_doubt(self) -> str:
        """Return the worst suspects, at most five, as text such as ``"sensors 3 x and 6 x"``.

        The text is empty if no sensor is suspect.
        """
        named = [self.sensors[j] for j in sorted(self.suspects[:_MOST_NAMED].tolist())]
        return f"sensor{'s' * (len(named) > 1)} {names_in_words(named)}" if named else ""

    def doubts_of_modes(self) -> list[str]:
        """Return a warning for each pair of measured modes that look alike at the sensors."""
        above = np.argwhere(np.triu(self.auto_mac, 1) > ALIASED).tolist()
        return [
            f"The measured shapes of modes {self.labels[i]} and {self.labels[k]} are alike at the sensors "
            f"(AutoMAC {fixed(self.auto_mac[i, k], 2)}): other sensors would tell the modes apart."
            for i, k in above
        ]

    def notes(self) -> list[str]:
        """Return a sentence for each group of close modes that agree as a subspace but not mode by mode."""
        found = []
        for group in self.groups:
            alike = [float(mac(self.computed[:, [k]], self.measured[:, [k]])[0, 0]) for k in group]
            if self.subspace.get(group[0], 0.0) >= ALIKE and min(alike) < ALIKE:
                found.append(
                    f"Modes {names_in_words([self.labels[k] for k in group])} are close: their measured shapes "
                    f"lie in the space of the computed ones (subspace MAC {fixed(self.subspace[group[0]], 2)}), "
                    f"turned into each other (MAC {names_in_words([fixed(x, 2) for x in alike])})."
                )
        return found

    def table(self) -> pd.DataFrame:
        """Return a table with columns ``comac`` and ``ecomac``, one row per sensor, by descending ``ecomac``."""
        columns = {"comac": self.comac, "ecomac": self.ecomac}
        return data_frame(columns, "sensor", self.sensors).sort_values("ecomac", ascending=False, kind="stable")
