"""How far a sampler is: of one that goes on from what its groups have kept, of a finished one from its trace."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fmu.analysis.convergence.effective import live_diagnostics
from fmu.runs.group_reading import KeptGroup
from fmu.samplers.loop.group import DRAWS, WARMUP

_FEWEST = 20  # draws, before which their diagnostics mean nothing


@dataclass(frozen=True)
class Progress:
    """How far a group of chains is, or all of a sampler's together. NaN and None: not known.

    Attributes
    ----------
    group : str
        Such as ``2/4``; empty for all together.
    phase : str
        "warmup", "draws", or empty: nothing is kept yet.
    done : int
        Steps of the phase; of all together, those of the group that is furthest behind.
    total : int or None
    kept_s : float or None
        Seconds since it was kept last.
    accept : float
        Share of the moves of the phase that were accepted.
    rhat, ess : float
        The worst among the parameters, of the draws of all groups; of a single group NaN.
    solves, failed : int
        Warm-up included.
    solves_per_s : float
    remaining_s : float or None
        Seconds of work that are left, at the pace so far.
    """

    group: str = ""
    phase: str = ""
    done: int = 0
    total: int | None = None
    kept_s: float | None = None
    accept: float = np.nan
    rhat: float = np.nan
    ess: float = np.nan
    solves: int = 0
    failed: int = 0
    solves_per_s: float = np.nan
    remaining_s: float | None = None


def of_group(
    kept: KeptGroup | None, label: str, warmup: int, draws: int | None, now: float, runs: bool
) -> Progress:
    """Return how far a group is.

    Parameters
    ----------
    kept : KeptGroup or None
    label : str
    warmup : int
        Steps of the warm-up.
    draws : int or None
        Steps asked for after it, where that is known beforehand.
    now : float
        Seconds since 1970.
    runs : bool
        Whether it has gone on since.
    """
    if kept is None:
        return Progress(label)
    phase = WARMUP if kept.done[WARMUP] < warmup else DRAWS
    if kept.phase == DRAWS:  # it may have been carried on
        draws = max(kept.total, draws or 0)
    elapsed_s, kept_s = sum(kept.elapsed_s.values()), max(now - kept.at, 0.0)
    left_s = _left_s(kept, warmup, draws)
    return Progress(
        label,
        phase,
        kept.done[phase],
        warmup if phase == WARMUP else draws,
        kept_s,
        kept.accept,
        solves=kept.solves,
        failed=kept.failed,
        solves_per_s=kept.solves / elapsed_s if elapsed_s > 0 else np.nan,
        remaining_s=left_s if left_s is None or not runs else max(left_s - kept_s, 0.0),
    )


def together(groups: Sequence[Progress], kept: Sequence[KeptGroup | None]) -> Progress:
    """Return how far all groups of a sampler are together."""
    begun = [group for group in groups if group.phase]
    if not begun:
        return Progress()
    phase = WARMUP if any(group.phase != DRAWS for group in groups) else DRAWS
    behind = [group for group in begun if group.phase == phase] or begun
    totals = [group.total for group in behind if group.total is not None]
    left = [group.remaining_s for group in groups]
    accept = [group.accept for group in behind if not np.isnan(group.accept)]
    live = _diagnostics(kept)
    elapsed_s = max(sum(one.elapsed_s.values()) for one in kept if one is not None)
    solves = sum(group.solves for group in groups)
    return Progress(
        "",
        phase,
        min(group.done if group.phase else 0 for group in groups if group.phase in ("", phase)),
        max(totals, default=None),
        min(group.kept_s for group in begun if group.kept_s is not None),
        float(np.mean(accept)) if accept else np.nan,
        rhat=live.get("rhat", np.nan),
        ess=live.get("ess", np.nan),
        solves=solves,
        failed=sum(group.failed for group in groups),
        solves_per_s=solves / elapsed_s if elapsed_s > 0 else np.nan,
        remaining_s=None if None in left else max(s for s in left if s is not None),
    )


def of_trace(path: Path) -> Progress:
    """Return what a trace says.

    Raises
    ------
    OSError, ValueError
        If it is missing, or damaged.
    """
    from fmu.analysis.trace.conversion import load_trace
    from fmu.analysis.trace.reading import parameter_draws, walkers_of

    trace = load_trace(path)
    attrs, stats = trace.attrs, [trace[group] for group in ("warmup_sample_stats", "sample_stats")]
    solves, wall_s = int(attrs["n_solves"]) + int(attrs["warmup_n_solves"]), float(attrs["wall_s"])
    draws, live = int(attrs["draws"]), live_diagnostics(parameter_draws(trace), walkers_of(trace))
    return Progress(
        phase=DRAWS,
        done=draws,
        total=draws,
        accept=float(stats[1]["accepted"].mean()),
        rhat=live["rhat"],
        ess=live["ess"],
        solves=solves,
        failed=sum(int(group["n_nonfinite"].sum()) for group in stats if "n_nonfinite" in group),
        solves_per_s=solves / wall_s if wall_s > 0 else np.nan,
    )


def _left_s(kept: KeptGroup, warmup: int, draws: int | None) -> float | None:
    """Return the seconds that were left, at the pace of the phase, or of the warm-up before the first draw."""
    done, elapsed_s = kept.done[kept.phase], kept.elapsed_s[kept.phase]
    if draws is None or done == 0:
        return None
    left = warmup - kept.done[WARMUP] + draws - kept.done[DRAWS]
    return max(left, 0) * elapsed_s / done


def _diagnostics(kept: Sequence[KeptGroup | None]) -> dict[str, float]:
    """Return R-hat and effective sample size of the draws that all groups have."""
    draws = [one.draws for one in kept if one is not None and one.draws is not None]
    steps = min((x.shape[1] for x in draws), default=0)
    if len(draws) < len(kept) or steps < _FEWEST:
        return {}
    return live_diagnostics(np.concatenate([x[:, :steps] for x in draws]))
