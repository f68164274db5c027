"""The text of the page of the study of frequency response functions (FRFs)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from scipy import stats

from fmu.numbers import fixed, listed, significant, whole, with_sd
from fmu.tables import markdown_table
from fmu.types import FloatArray
from tests.validation.cantilever_frf import MODULI, NOISE, RATIOS

if TYPE_CHECKING:
    import pandas as pd

    from tests.validation.frf_damage import Pair
    from tests.validation.frfs import Set, Start

RANKED, STARTS = 63, 40
"""Number of posterior draws among which a true value is ranked; number of runs of each problem."""
OFF = 5.0
"""Monte-Carlo standard errors beyond which a mean counts as wrong."""
PARAMETERS = ("k1", "k2", "k3", "zeta1", "zeta2", "zeta3", "delay", "gain")
GPA = 1e9


def head(
    sets: Sequence[Set], hits: Sequence[Set], starts: Sequence[Start], pairs: Sequence[Pair], minutes: float
) -> str:
    """Return the first lines: the question, the verdict and the method."""
    inside = np.mean([one.inside for one in sets])
    of_hits = np.mean([one.inside for one in hits])
    p = p_of_ranks(np.array([one.ranks for one in sets]))
    good = [run for run in starts if run.converged]
    off = sum(run.off > OFF for run in good)
    lost = [p > 0.5 for one in pairs for j, p in enumerate(one.beyond) if j == one.storey]
    sound = [p > 0.5 for one in pairs for j, p in enumerate(one.beyond) if j != one.storey]
    return f"""# Updating from frequency response functions

Does updating from frequency response functions (FRFs) give correct posteriors, and how much time and memory does
it take? **90 % intervals contain {100 * inside:.1f} % of the true values if the standard deviations of the FRFs
are known, and {100 * of_hits:.1f} % if they are estimated from five hits. The smallest of {len(p)} p-values for
uniform ranks is {significant(min(p), 2)}. A posterior mean is off by more than {OFF:g} Monte-Carlo standard
errors in {off} of {len(good)} converged runs from random starting points. Damage is found in {sum(lost)} of
{len(lost)} damaged storeys, and reported in {sum(sound)} of {len(sound)} undamaged ones.** All tests are
simulated; each section describes its tests. The study took {minutes:.0f} minutes of processor time.
"""


def speed(size: int, eigh: float, value: float, gradient: float, density: float, both: float) -> str:
    """Return the section on speed, from microseconds per parameter vector."""
    rows = [
        (name, significant(seconds / eigh, 2))
        for name, seconds in (
            ("FRFs", value),
            ("FRFs and all ten derivatives of a scalar function of them", gradient),
            ("log-probability", density),
            ("log-probability and its gradient", both),
        )
    ]
    return f"""## Speed

The cantilever has five moduli, five damping ratios and three accelerances of 300 frequency lines. Times are per
parameter vector in a batch of 64, and relative to `numpy.linalg.eigh` of a matrix as large as the reduced basis,
{size} × {size}, which takes {eigh:.0f} µs.

{markdown_table(("computation", "time / `eigh`"), rows)}"""


def adds(names: Sequence[str], frequencies: pd.DataFrame, frfs: pd.DataFrame) -> str:
    """Return the section that compares natural frequencies with FRFs, from the summaries of both posteriors."""
    rows = [
        (
            name,
            _estimate(frequencies, name, GPA),
            _estimate(frfs, name, GPA),
            fixed(frequencies["sd"][name] / frfs["sd"][name], 0),
        )
        for name in names
    ]
    header = ("modulus, GPa", "from the frequencies", "from the FRFs", "ratio of the standard deviations")
    return f"""## FRFs compared with natural frequencies

The case cantilever-frf is updated twice: with five natural frequencies that are picked from its FRFs and have
errors of 0.5 %, and with the FRFs. Cells show posterior mean ± standard deviation.

{markdown_table(header, rows)}"""


_IDENTIFIED = "## FRFs compared with modes identified by sdypy-EMA"


def not_identified() -> str:
    """Return the section on identified modes where the library is missing."""
    return f"{_IDENTIFIED}\n\nNot measured: sdypy-EMA was not installed (`pip install '.[ema]'`).\n"


def identified(
    names: Sequence[str],
    f: FloatArray,
    damping: FloatArray,
    tables: Sequence[pd.DataFrame],
    lines: FloatArray,
    converged: int,
) -> str:
    """Return the section that compares identified modes with FRFs.

    `f` and `damping` are of the identified modes; `tables` are the summaries of the posteriors from frequencies,
    from frequencies and shapes, and from FRFs.
    """
    rows = [
        (f"{name}, GPa", significant(true / GPA, 4), *(_estimate(table, name, GPA) for table in tables))
        for name, true in zip(names[:5], MODULI, strict=True)
    ]
    rows += [
        (name, significant(true, 4), "–", significant(ratio, 4), _estimate(tables[-1], name))
        for name, true, ratio in zip(names[5:10], RATIOS, damping, strict=True)
    ]
    return f"""{_IDENTIFIED}

The beam of cantilever-frf is measured at {whole(len(lines))} lines, {lines[1] - lines[0]:g} Hz apart, with
errors of {100 * NOISE:g} % of |H|. From these FRFs sdypy-EMA identifies five modes, at {listed(f, 4)} Hz. The
beam is updated with their frequencies (errors of 0.5 %), with their frequencies and shapes (errors of 5 %), and
with the FRFs; {converged} of 3 runs converged. Cells show posterior mean ± standard deviation. The damping
ratios in the fourth column are the estimates of sdypy-EMA, which gives no standard errors.

{markdown_table(("parameter", "true", "frequencies", "frequencies and shapes", "FRFs"), rows)}"""


def channels(
    gain: float, gain_sd: float, delay: float, delay_sd: float, off: float, with_both: str, without: str
) -> str:
    """Return the section on errors of channels; `gain` is the error of a gain of 1, delays are in seconds."""
    return f"""## A channel with a wrong gain, and one with a delay

In the data of cantilever-frf, one channel gets a gain of 1.4, and another one a delay of 0.4 ms. With inferred
errors of these channels (`gain_sd` 0.5, `delay_sd` 1 ms), the posterior gives a gain of
{with_sd(1.0 + gain, gain_sd)} and a delay of {with_sd(1e3 * delay, 1e3 * delay_sd)} ms. The mean moduli differ
from those of the correct data by at most {off:.1f} posterior standard deviations, and the model is {with_both}.
Without errors of the channels, the model is {without}.
"""


def memory(before: float, peak: float, seconds: float) -> str:
    """Return the section on the memory of a batch of gradients, in GiB and processor seconds."""
    return f"""## Memory for 20 FRFs of 10 000 lines

A batch of 64 gradients takes {seconds:.1f} s of processor time. The peak memory of the process is {before:.2f} GiB
before this batch and {peak:.2f} GiB after it.
"""


def large(
    *,
    seconds: float,
    clock: float,
    trained: float,
    vectors: int,
    points: int,
    converged: bool,
    off: float,
    shift: float,
    direct: float,
) -> str:
    """Return the section on a frame of 10 080 DOF.

    `trained` are the seconds before the run, `off` the largest error of a mean in posterior standard deviations,
    `shift` and `direct` the errors in the certificate of the basis.
    """
    return f"""## A frame of 10 080 DOF with 10 FRFs of 400 lines

Five moduli and five damping ratios are updated. Simulating the data, training the reduced basis and sampling
take {seconds:.0f} s of processor time ({clock:.0f} s of wall time); {trained:.0f} s of these precede the
sampling. The basis has {vectors} vectors from {points} training points. The run
{"converged" if converged else "did **not** converge"}. The posterior means are within {off:.1f} posterior
standard deviations of the true values. According to the certificate, the errors of the basis shift the posterior
by at most {shift:.3f} posterior standard deviations. Direct solves of the full structure differ from the basis
by {significant(direct, 2)} standard deviations of the data.
"""


def calibration(sets: Sequence[Set]) -> str:
    """Return the section on simulation-based calibration."""
    ranks, inside = np.array([one.ranks for one in sets]), np.array([one.inside for one in sets])
    rows = []
    for j, (name, p) in enumerate(zip(PARAMETERS, p_of_ranks(ranks), strict=True)):
        held = f"{100 * inside[:, j].mean():.1f} %" if j < inside.shape[1] else ""
        rows.append((name, f"{p:.2f}", held, " ".join(map(str, histogram(ranks[:, j])))))
    converged, seconds = sum(one.converged for one in sets), np.median([one.seconds for one in sets])
    header = ("parameter", "p", "90 % intervals with the true value", "rank histogram")
    return f"""## Simulation-based calibration

{len(sets)} parameter sets of a building of three storeys are drawn from the prior: moduli, damping ratios, and a
gain error (standard deviation 5 %, integrated out) and a delay (standard deviation 1 ms) of one of two channels.
Each test has two accelerances of 120 lines with 5 % noise, and is updated with the mixture sampler. {converged} of
{len(sets)} runs converged; a run takes {seconds:.1f} s of processor time. The true value is ranked among {RANKED}
posterior draws; the rank histogram has eight bins, and p is from the chi-square test of uniform ranks.

{markdown_table(header, rows, (0, 3))}"""


def histogram(ranks: Sequence[int]) -> list[int]:
    """Return the numbers of ranks in eight equal bins."""
    return np.histogram(ranks, bins=np.arange(0, RANKED + 2, 8))[0].tolist()


def p_of_ranks(ranks: np.ndarray) -> list[float]:
    """Return the p-value of the chi-square test of uniform ranks for each column of `ranks`."""
    return [float(stats.chisquare(histogram(column)).pvalue) for column in ranks.T]


def hits(sets: Sequence[Set]) -> str:
    """Return the section on standard deviations from five hits."""
    inside = np.array([one.inside for one in sets])
    shares = ", ".join(f"{100 * share:.0f}" for share in inside.mean(axis=0))
    every, n = 100 * inside.mean(), len(sets)
    width = 100 * 1.645 * np.sqrt(0.09 / n)
    return f"""## Standard deviations from five hits

{n} tests have 2000 lines (two accelerances) with 10 % noise per hit. The scatter of five hits gives the standard
deviations; the likelihood is therefore Student's t. {sum(one.converged for one in sets)} of {n} runs converged.
The 90 % intervals of k1, k2, k3, zeta1, zeta2 and zeta3 contain the true value in {shares} % of the tests,
together in {every:.1f} %. For a single parameter with correct intervals, this share is between {90 - width:.0f}
and {90 + width:.0f} % with a probability of 90 %.
"""


def starts(runs: Sequence[Start]) -> str:
    """Return the section on runs from several starting points."""
    rows = []
    for name in dict.fromkeys(run.problem for run in runs):
        own = [run for run in runs if run.problem == name]
        good = [run for run in own if run.converged]
        rows.append(
            (
                name,
                whole(len(own)),
                whole(len(good)),
                whole(sum(run.off > OFF for run in good)),
                fixed(max((run.off for run in good), default=np.nan), 1),
                whole(sum(run.maxima > 1 for run in own)),
                fixed(float(np.median([run.seconds for run in own])), 1),
            )
        )
    header = (
        "problem", "runs", "converged", f"difference above {OFF:g}", "largest difference",
        "runs that found several maxima", "median CPU, s",
    )  # fmt: skip
    return f"""## Runs from {STARTS} starting points

The starting points are drawn from the prior. Each run searches for maxima from 16 starts, and then samples 500
draws per chain. The *difference* is the largest one between a posterior mean of the run and of a reference run
with 4000 draws per chain, in combined Monte-Carlo standard errors; it is given for converged runs. With six to
ten parameters and {STARTS} runs per problem, about one difference above 3 is expected by chance.

{markdown_table(header, rows)}"""


def _estimate(table: pd.DataFrame, name: str, unit: float = 1.0) -> str:
    return with_sd(table["mean"][name] / unit, table["sd"][name] / unit)
