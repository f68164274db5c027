"""Count how often the pairing of computed and measured modes changes over the draws of a run."""

from __future__ import annotations

import html
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from fmu.analysis.trace.modal_states import GROUP as MODES
from fmu.analysis.trace.modal_states import START
from fmu.analysis.trace.reading import array_of, check_trace, has, parameter_draws, with_group
from fmu.arguments import ArgumentError, check_arguments
from fmu.fem.modes.modal import frequency_hz
from fmu.fem.pairing.paired_structure import structure_of
from fmu.fem.reduced.reduced_structure import reduced_structures
from fmu.numbers import share, significant
from fmu.progress.phases import by_parts
from fmu.tables import data_frame
from fmu.types import AnyArray, FloatArray, IntArray

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

    from fmu.posterior.problem import UpdatingProblem


GROUP = "pairing"
"""Name of the trace group that stores which computed mode was paired with each measured mode."""
MOST_DRAWS = 2000
"""Largest number of draws examined, evenly spaced over the chains; the most probable draw is added."""
_MEANS = {
    "shape": "the log-probability jumps there if the two modes veer, but not if they cross without mixing",
    "index": "the log-probability has a kink there, and the frequency belongs to another shape",
    "soft": "the candidate modes swap weights there, without a jump",
}


@dataclass(frozen=True, eq=False)
class PairingChanges:
    """How the pairing of modes changes over the draws of a run.

    Attributes
    ----------
    labels : tuple of str
        Labels of the measured modes.
    swapped : ndarray, shape (n_modes, n_modes)
        Fraction of all draws in which the order of two measured modes is the reverse of that before updating.
    rule : {"shape", "index", "soft"} or None
        How modes are paired; None if the trace does not store the pairing. `changed` is then NaN, and `project`
        and `jumps` are 0.
    constant : bool
        Whether each measured mode is paired with a fixed mode of a block: the pairing was the same at all training
        points of the reduced model, and all draws lie within its training bounds.
    project : int
        Number of draws examined for `changed` and `gap`.
    changed : ndarray, shape (n_modes,)
        Fraction of these draws in which the measured mode is paired with a computed mode (block, and number within
        the block) that differs from that of the most probable draw.
    jumps : int
        Number of these draws with a change of this kind in any mode.
    gap : ndarray, shape (n_modes,)
        Smallest relative distance in frequency to another computed mode over these draws; infinite if there is no
        other mode. If the pairing is constant or unknown, only paired modes are compared, over all draws.
    """

    labels: tuple[str, ...]
    swapped: FloatArray
    rule: str | None
    constant: bool
    project: int
    changed: FloatArray
    jumps: int
    gap: FloatArray

    def table(self) -> pd.DataFrame:
        """Return a table of pairing changes with one row per measured mode.

        The columns are ``swapped_percent``, the largest fraction of draws in which the order with another mode is
        reversed, in %; ``swapped_with``, the labels of all modes whose order with it is reversed in any draw;
        ``other_mode_percent``, the fraction of draws, in %, in which it is paired with another computed mode than
        in the most probable draw; and ``closest_percent``, the smallest distance in frequency to another mode,
        in %. A dash in ``swapped_with`` means that no order is reversed.
        """
        return data_frame(
            {
                "swapped_percent": 100.0 * self.swapped.max(axis=1, initial=0.0),
                "swapped_with": [self._swapped_with(i) for i in range(len(self.labels))],
                "other_mode_percent": 100.0 * self.changed,
                "closest_percent": 100.0 * self.gap,
            },
            "mode",
            self.labels,
        )

    def sentences(self) -> tuple[str, ...]:
        """Return the findings as sentences, the most important first."""
        said = [*self._jumps(), *self._swaps()]
        if not said:
            said.append("In all draws the measured modes are in the same order as in the model before updating.")
        if self.constant:
            said.append("Every measured mode is paired with the same computed mode throughout (verified).")
        elif self.rule is not None and not self.jumps:
            said.append(
                f"Every measured mode is paired with the same computed mode in all {self.project} draws examined."
            )
        nearest = int(np.argmin(np.where(np.isnan(self.gap), np.inf, self.gap)))
        if np.isfinite(self.gap[nearest]):
            kind = "paired" if self.constant or self.rule is None else "computed"
            said.append(
                f"Smallest gap to another {kind} mode: {share(float(self.gap[nearest]))} in frequency, at "
                f"mode {self.labels[nearest]}."
            )
        return tuple(said)

    def __str__(self) -> str:
        return "\n".join(self.sentences())

    def _repr_html_(self) -> str:
        items = "".join(f"<li>{html.escape(sentence)}</li>" for sentence in self.sentences())
        shown = self.table().to_html(float_format=significant, border=0)
        return f"<ul>{items}</ul>{shown}"

    def _jumps(self) -> list[str]:
        of = f"of {self.project} draws examined"
        return [
            f"Mode {self.labels[i]} is not paired with the same computed mode as at the most probable draw in "
            f"{share(float(self.changed[i]))} {of}: {_MEANS[str(self.rule)]}."
            for i in np.argsort(-self.changed, kind="stable")
            if self.changed[i] > 0
        ]

    def _swaps(self) -> list[str]:
        rows, columns = np.nonzero(np.triu(self.swapped) > 0)
        order = np.argsort(-self.swapped[rows, columns], kind="stable")
        return [
            f"Modes {self.labels[i]} and {self.labels[j]} are in reversed order in "
            f"{share(float(self.swapped[i, j]))} of the draws, compared with the model before updating."
            for i, j in zip(rows[order], columns[order], strict=True)
        ]

    def _swapped_with(self, i: int) -> str:
        return ", ".join(self.labels[j] for j in np.flatnonzero(self.swapped[i] > 0)) or "–"


@check_arguments
def pairing_changes(trace: xr.DataTree) -> PairingChanges:
    """Count how often the pairing of modes changed over the retained draws of a run.

    Two kinds of change are possible. First, the *order* of the measured modes may differ from the order before
    updating. This is harmless as long as each mode keeps its shape. Second, another *computed mode* may be paired
    with a measured mode. If modes are paired one to one by MAC and veer, the log-probability then jumps, which
    violates an assumption of gradient-based samplers; with ``pairing="soft"`` it does not jump
    (`fmu.posterior.errors.mixture`). If the modes cross without mixing (one symmetric, one antisymmetric), the
    log-probability stays smooth in any case.

    Parameters
    ----------
    trace : xarray.DataTree
        Trace of an updating problem.

    Returns
    -------
    PairingChanges

    Raises
    ------
    ValueError
        If `trace` is not a trace, or lacks the frequencies at the draws or before updating.
    """
    check_trace(trace)
    if not has(trace, "posterior_predictive") or not has(trace, MODES):
        raise ArgumentError(
            "trace", "must be of an updating problem, with frequencies at the draws and before updating"
        )
    labels = tuple(map(str, trace["posterior_predictive"]["mode"].to_numpy()))
    f = array_of(trace, "posterior_predictive", "model_frequency").reshape(-1, len(labels))
    before = trace[MODES]["frequency"].sel(state=START).to_numpy()
    swapped = np.zeros((len(labels), len(labels)))
    gap = np.full(len(labels), np.inf)
    for i in range(len(labels)):
        apart = f - f[:, i : i + 1]
        swapped[i] = np.mean(apart * (before - before[i]) < 0, axis=0)
        gap[i] = np.min(np.delete(np.abs(apart), i, axis=1) / f[:, i : i + 1], initial=np.inf)
    if not has(trace, GROUP):
        return PairingChanges(labels, swapped, None, False, 0, np.full(len(labels), np.nan), 0, gap)
    kept = trace[GROUP]
    rule, constant = str(kept.attrs["rule"]), bool(kept.attrs["constant"])
    block, rank = (kept[name].transpose("sample", "mode").to_numpy() for name in ("block", "rank"))
    best = int(kept.attrs["most_probable"])
    other = (block != block[best]) | (rank != rank[best])
    if constant:
        project = len(f)
    else:
        project, gap = len(block), kept["gap"].transpose("sample", "mode").to_numpy().min(axis=0).astype(float)
    return PairingChanges(
        labels, swapped, rule, constant, project, other.mean(axis=0), int(np.sum(other.any(axis=1))), gap
    )


def jump_warnings(trace: xr.DataTree) -> list[str]:
    """Return a list with a warning if the pairing by MAC changes within the draws, so that log P jumps."""
    if not has(trace, GROUP) or trace[GROUP].attrs["rule"] != "shape":
        return []
    found = pairing_changes(trace)
    if found.jumps == 0:
        return []
    modes = ", ".join(label for label, changed in zip(found.labels, found.changed, strict=True) if changed > 0)
    return [
        f"the pairing by MAC changes in {share(found.jumps / found.project)} of the draws (measured "
        f"{'modes' if ',' in modes else 'mode'} {modes}): the log-probability jumps where these modes veer; "
        'pairing="soft" avoids jumps'
    ]


def with_pairing(trace: xr.DataTree, problem: UpdatingProblem) -> xr.DataTree:
    """Return the trace with a group that stores the paired computed modes.

    The trace is unchanged if the model is not a structure. The group has ``block`` and ``rank`` (sample, mode):
    the block of the computed mode paired with each measured mode, and its number within the block. The samples are
    the most probable draw and at most `MOST_DRAWS` draws, which ``chain`` and ``draw`` identify. ``gap`` (sample,
    mode) is the relative distance in frequency to the nearest other computed mode. If the pairing is constant
    (`PairingChanges.constant`), only one draw is stored, without the gap, at the cost of one solve. Otherwise each
    distinct draw costs two solves.
    """
    import xarray as xr

    if structure_of(problem.model) is None:
        return trace
    structure: Any = problem.model
    draws = parameter_draws(trace)
    theta = problem.model_parameters(draws.reshape(-1, draws.shape[-1]))
    highest = int(np.argmax(array_of(trace, "sample_stats", "lp")))
    constant = any(of.pairing.is_constant and of.within(theta).all() for of in reduced_structures(structure))
    picked = np.unique(np.linspace(0, len(theta) - 1, min(len(theta), MOST_DRAWS)).astype(int))
    picked = np.array([highest]) if constant else np.union1d(picked, highest)
    distinct, inverse = np.unique(theta[picked], axis=0, return_inverse=True)
    parts = by_parts("pairing", structure.modes, distinct)
    block, rank = (np.concatenate([part.block for part in parts]), np.concatenate([part.rank for part in parts]))
    dims = ("sample", "mode")
    variables: dict[str, tuple[object, AnyArray]] = {
        name: (dims, labels[inverse].astype(np.int16)) for name, labels in (("block", block), ("rank", rank))
    }
    if not constant:
        gap = nearest_other(structure, distinct, block, rank)
        variables["gap"] = (dims, gap[inverse].astype(np.float32))
    chain, draw = np.divmod(picked, draws.shape[1])
    coordinates: dict[str, object] = {"mode": list(problem.data.labels)}
    coordinates |= {"chain": ("sample", chain.astype(np.int32)), "draw": ("sample", draw.astype(np.int32))}
    attributes = {
        "rule": structure.rule.name,
        "constant": int(constant),
        "most_probable": int(np.searchsorted(picked, highest)),
    }
    return with_group(trace, GROUP, xr.Dataset(variables, coords=coordinates, attrs=attributes))


def nearest_other(structure: Any, theta: FloatArray, block: IntArray, rank: IntArray) -> FloatArray:
    """Return the relative distance in frequency from each mode to the nearest other computed mode, (n, n_modes).

    It is infinite if there is no other mode.

    Parameters
    ----------
    structure : PairedStructure or ReducedStructure
    theta : ndarray, shape (n, n_parameters)
    block, rank : ndarray of int, shape (n, n_modes)
        Blocks and ranks of the modes.
    """
    found = by_parts("pairing", structure.candidates, theta)
    hz = frequency_hz(np.concatenate([eigenvalues for eigenvalues, _, _ in found]))
    _, blocks, ranks = found[0]
    gap = np.full(block.shape, np.inf)
    for i in range(block.shape[1]):
        own = (blocks == block[:, i : i + 1]) & (ranks == rank[:, i : i + 1])
        f = np.sum(np.where(own, hz, 0.0), axis=1, keepdims=True)
        with np.errstate(divide="ignore", invalid="ignore"):
            apart = np.abs(hz / f - 1.0)
        gap[:, i] = np.min(np.where(own | np.isnan(apart), np.inf, apart), axis=1, initial=np.inf)
    return gap
