"""Updating from frequency response functions: calibration, coverage, repeated searches, size, memory and speed.

    python -m tests.validation.frfs OUT [--kept DIRECTORY] [--minutes M]

Writes ``frfs.md``.
"""

from __future__ import annotations

import resource
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec

import numpy as np
import pandas as pd
from scipy import stats

import fmu
from fmu.analysis.trace.reading import parameter_draws
from fmu.numbers import significant, whole
from fmu.posterior.problem import UpdatingProblem
from fmu.types import FloatArray
from tests import measured_frfs as storeys
from tests.validation.cantilever_frf import MODULI, NODES, NOISE, RATIOS, measure
from tests.validation.frf_damage import damage
from tests.validation.frf_structures import frame_problem, many_lines, ratio_to_eigh
from tests.validation.frf_wrong import wrong_models
from tests.validation.kept import Units, each, fields_of, study_parser
from tests.validation.sections import write_sections

_SETS, _HITS, _STARTS = 200, 100, 40
_RANKED = 63
_GAIN_SD, _DELAY_SD = 0.05, 1e-3
EVEN = np.arange(20.0, 2000.1, 0.5)
"""Lines that a library of modal analysis takes, Hz."""


@dataclass
class Set:
    """One simulated test of three storeys.

    Attributes
    ----------
    seed : int
    ranks : list of int
        Ranks of the true values among `_RANKED` draws; of the gain error last.
    inside : list of bool
        Whether each 90 % interval holds the true value.
    converged : bool
    seconds : float
        Of one core.
    """

    seed: int
    ranks: list[int]
    inside: list[bool]
    converged: bool
    seconds: float


def _posed(data: fmu.FRFData, start: FloatArray, frequencies: FloatArray, **options: object) -> UpdatingProblem:
    own = fmu.FRFErrors(data, fmu.ModalDamping(storeys.ratios()), **options)  # type: ignore[arg-type]
    parameters = [
        fmu.Parameter(name, float(value), 0.6, 1.6, fmu.Normal(mean=1.0, sd=0.15))
        for name, value in zip(storeys.NAMES, start, strict=True)
    ]
    modes = fmu.ModalData(frequencies, sd_hz=0.01 * frequencies, numbers=(1, 2, 3), sensors=storeys.POINTS)
    return fmu.UpdatingProblem(storeys.building(), modes, parameters, error=own)


def _sampled(problem: UpdatingProblem, seed: int) -> tuple[FloatArray, bool, object]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        trace = fmu.sample(problem, "mixture", draws=500, warmup=200, seed=seed)
    return parameter_draws(trace).reshape(-1, problem.ndim), bool(fmu.diagnose(trace).converged), trace


def calibrated(seed: int) -> Set:
    """Return the ranks of true moduli, damping ratios, a delay and a gain error that were drawn from their
    priors."""
    began, rng = time.process_time(), np.random.default_rng([1, seed])
    dummy = storeys.simulate(noise=0.05)
    base = storeys.POINTS[1]
    problem = _posed(
        dummy, np.ones(3), storeys.frequencies(np.ones(3)), gain_sd={base: _GAIN_SD}, delay_sd={base: _DELAY_SD}
    )
    theta = problem.sample_prior(rng, 1)[0]
    (term,) = problem.likelihood.responses
    gain, delay = _GAIN_SD * rng.standard_normal(), theta[-1]
    omega = 2 * np.pi * storeys.LINES
    H = storeys.receptances(theta[:3], theta[3:6]) * (1j * omega) ** 2
    H = H * np.array([np.ones(len(omega)), (1.0 + gain) * np.exp(-1j * delay * omega)])
    sd = 0.05 * np.abs(H)
    noise = rng.standard_normal(H.shape) + 1j * rng.standard_normal(H.shape)
    data = fmu.FRFData(storeys.LINES, H + sd * noise, dummy.drives, dummy.responses, "accelerance", sd)
    f = storeys.frequencies(theta[:3]) * (1.0 + 0.01 * rng.standard_normal(3))
    problem = _posed(data, np.ones(3), f, gain_sd={base: _GAIN_SD}, delay_sd={base: _DELAY_SD})
    draws, converged, _ = _sampled(problem, seed)
    some = draws[rng.permutation(len(draws))[:_RANKED]]
    (term,) = problem.likelihood.responses
    best, width = term.gains(some)
    gains = best[:, 1] + width[:, 1] * rng.standard_normal(_RANKED)
    truth, every = np.r_[theta, gain], np.column_stack([some, gains])
    low, high = np.quantile(draws, [0.05, 0.95], axis=0)
    inside = ((theta >= low) & (theta <= high)).tolist()
    return Set(seed, np.sum(every < truth, axis=0).tolist(), inside, converged, time.process_time() - began)


def of_hits(seed: int) -> Set:
    """Return whether the intervals hold true values where five hits gave the standard deviations of 2000 lines."""
    began, rng = time.process_time(), np.random.default_rng([2, seed])
    lines = np.linspace(1.0, 16.0, 1000)
    H = storeys.receptances(lines=lines) * (2j * np.pi * lines) ** 2
    sd = 0.1 * np.abs(H)
    noise = rng.standard_normal((5, *H.shape)) + 1j * rng.standard_normal((5, *H.shape))
    data = fmu.FRFData.from_hits(lines, H + sd * noise, ((2, "x"),) * 2, storeys.POINTS)
    f = storeys.frequencies(storeys.TRUTH) * (1.0 + 0.01 * rng.standard_normal(3))
    draws, converged, _ = _sampled(_posed(data, np.ones(3), f), seed)
    truth = np.r_[storeys.TRUTH, storeys.RATIOS]
    low, high = np.quantile(draws, [0.05, 0.95], axis=0)
    ranks = np.sum(draws < truth, axis=0) * (_RANKED + 1) // (len(draws) + 1)
    inside = ((truth >= low) & (truth <= high)).tolist()
    return Set(seed, ranks.tolist(), inside, converged, time.process_time() - began)


@dataclass
class Start:
    """A run from a start of its own.

    Attributes
    ----------
    problem : str
    seed : int
    converged : bool
    off : float
        Largest difference from the reference mean, in Monte-Carlo standard errors of both.
    maxima : int
        Number of maxima that the search found.
    seconds : float
    """

    problem: str
    seed: int
    converged: bool
    off: float
    maxima: int
    seconds: float


def _of_storeys(start: FloatArray) -> UpdatingProblem:
    f = storeys.frequencies(storeys.TRUTH) * [1.005, 0.996, 1.003]
    return _posed(storeys.simulate(noise=0.03), start, f)


def _with_start(problem: UpdatingProblem, start: FloatArray) -> UpdatingProblem:
    other = copy(problem)
    other.start = start
    return other


PROBLEMS: dict[str, Callable[[], UpdatingProblem]] = {
    "three storeys": lambda: _of_storeys(np.ones(3)),
    "cantilever-frf": lambda: fmu.cases.load("cantilever-frf"),
    "frame of 144 DOF": lambda: frame_problem((6, 2, 2), 4)[0],
}


@cache
def _referred(name: str) -> tuple[fmu.UpdatingProblem, pd.DataFrame, FloatArray]:
    """Return a problem, the summary of a long run, and starts drawn from the prior."""
    problem = PROBLEMS[name]()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        reference = fmu.summary(fmu.sample(problem, "mixture", draws=4000, warmup=500, seed=1000))
    return problem, reference, problem.sample_prior(np.random.default_rng(5), _STARTS)


def started(key: tuple[str, int]) -> Start:
    """Return a run of a problem from a start of its own."""
    name, seed = key
    problem, reference, points = _referred(name)
    began = time.process_time()
    posed = _with_start(problem, points[seed])
    found = fmu.find_map(posed, starts=16, seed=seed + 1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        trace = fmu.sample(posed, "mixture", draws=500, warmup=200, seed=seed + 1, maxima=found)
    own = fmu.summary(trace)
    error = np.hypot(own["mcse_mean"], reference["mcse_mean"])
    off = float(np.max(np.abs(own["mean"] - reference["mean"]) / error))
    converged = bool(fmu.diagnose(trace).converged)
    return Start(name, seed, converged, off, len(found.maxima), time.process_time() - began)


def starts_page(runs: Sequence[Start]) -> str:
    """Return the section on repeated searches."""
    rows = []
    for name in PROBLEMS:
        own = [run for run in runs if run.problem == name]
        good = [run for run in own if run.converged]
        wrong = sum(run.off > 5.0 for run in good)
        several = sum(run.maxima > 1 for run in own)
        seconds = float(np.median([run.seconds for run in own]))
        most = max(run.off for run in good)
        rows.append(f"| {name} | {len(own)} | {len(good)} | {wrong} | {most:.1f} | {several} | {seconds:.1f} |")
    table = "\n".join(rows)
    return f"""## Runs from {_STARTS} starts

Each start is drawn from the prior; its search has 16 starts of its own, and the run 500 draws a chain. "Off" is
the largest difference of a mean from that of a run of 4000 draws a chain, in Monte-Carlo standard errors of both.
With six to ten parameters and {_STARTS} runs a few differences of more than 3 are expected by chance.

| problem | runs | converged | of these off by more than 5 | most off | runs with several maxima | s of one core |
| :-- | --: | --: | --: | --: | --: | --: |
{table}
"""


def calibration_page(sets: Sequence[Set]) -> str:
    """Return the section on simulation-based calibration."""
    names = ["k1", "k2", "k3", "zeta1", "zeta2", "zeta3", "delay", "gain"]
    ranks, inside = np.array([one.ranks for one in sets]), np.array([one.inside for one in sets])
    rows = []
    for j, name in enumerate(names):
        counts = np.histogram(ranks[:, j], bins=np.arange(0, _RANKED + 2, 8))[0]
        p = stats.chisquare(counts).pvalue
        share = f"{100 * inside[:, j].mean():.1f} %" if j < inside.shape[1] else ""
        rows.append(f"| {name} | {p:.2f} | {share} | {' '.join(map(str, counts))} |")
    converged, seconds = sum(one.converged for one in sets), np.median([one.seconds for one in sets])
    table = "\n".join(rows)
    return f"""## Simulation-based calibration

{len(sets)} sets of moduli, damping ratios, a gain error (sd 5 %, integrated out) and a delay (sd 1 ms) of one of
two channels, drawn from their priors; each with 120 lines of two accelerances with 5 % noise, updated by the
mixture sampler ({converged} of {len(sets)} runs converged, {seconds:.1f} s of one core each).
Ranks of the true value among {_RANKED} draws in eight bins; p of a chi-square test of uniform ranks.

| parameter | p | 90 % intervals that hold the true value | ranks |
| :-- | --: | --: | :-- |
{table}
"""


def hits_page(sets: Sequence[Set]) -> str:
    """Return the section on standard deviations from five hits."""
    inside = np.array([one.inside for one in sets])
    shares = ", ".join(f"{100 * share:.0f}" for share in inside.mean(axis=0))
    every, n = 100 * inside.mean(), len(sets)
    width = 100 * 1.645 * np.sqrt(0.09 / n)
    return f"""## Standard deviations from five hits

{n} tests of 2000 lines (two accelerances) with 10 % noise a hit; the scatter of five hits gives the standard
deviations, and the errors are Student's. 90 % intervals hold the true value of k1, k2, k3, zeta1, zeta2 and zeta3
in {shares} % of the tests; {every:.1f} % together (one parameter alone: 90 ± {width:.0f} % by chance). Converged:
{sum(one.converged for one in sets)} of {n}.
"""


def large() -> str:
    """Return the section on a frame of 10 080 DOF."""
    began, clock = time.process_time(), time.perf_counter()
    problem, truth = frame_problem((70, 6, 4), 5)
    trained = time.process_time() - began
    (term,) = problem.likelihood.responses
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        trace = fmu.sample(problem, "mixture", seed=1)
    seconds, clock = time.process_time() - began, time.perf_counter() - clock
    summary = fmu.summary(trace)
    off = np.max(np.abs(summary["mean"] - truth) / summary["sd"])
    shift, direct = trace.attrs["frf_certificate_shift"], trace.attrs["frf_certificate_direct_error"]
    verdict = "Converged" if fmu.diagnose(trace).converged else "Not converged"
    return f"""## 10 080 DOF, 10 FRFs of 400 lines, 5 moduli and 5 damping ratios

Simulation of the data, training and a run to its verdict: {seconds:.0f} s of one core ({clock:.0f} s by the clock
beside other work), {trained:.0f} s of them before the run. The basis has {term.model.block.size} vectors from
{term.model.n_solves} points. {verdict}; the true values lie within {off:.1f} posterior standard deviations. By the
certificate the errors of the basis move the posterior by at most {shift:.3f} of its standard deviations, and
direct solves of the full structure differ from it by {direct:.1e} standard deviations of the data.
"""


def memory() -> str:
    """Return the section on the memory of a batch of gradients."""
    code = "from tests.validation.frfs import print_peak; print_peak()"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    before, peak, seconds = map(float, found.stdout.split()[-3:])
    return f"""## 10 000 lines of 20 FRFs

A batch of 64 gradients takes {seconds:.1f} s of one core. The process has {before:.2f} GiB before it, and
{peak:.2f} GiB at its peak.
"""


def print_peak() -> None:
    """Print the memory of this process before and at the peak of a batch of gradients, GiB, and its seconds."""
    problem, theta = many_lines()
    problem.log_prob(theta[:1])
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    began = time.process_time()
    problem.log_prob_and_grad(theta)
    seconds = time.process_time() - began
    print(before, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20, seconds)


def speed() -> str:
    """Return the section on speed."""
    size, eigh, value, gradient, density, both = ratio_to_eigh()
    return f"""## Speed

Three accelerances of 300 lines of the cantilever, 5 moduli and 5 damping ratios, a batch of 64, in one run, per
theta: `numpy.linalg.eigh` of {size} × {size} {eigh:.0f} µs; the FRFs {value / eigh:.1f} times that; the FRFs and
all ten derivatives of a function of them {gradient / eigh:.1f} times; the whole log-probability
{density / eigh:.1f} times, with its gradient {both / eigh:.1f} times.
"""


def adds() -> str:
    """Return the section on the same test as modes and as FRFs."""
    problem = fmu.cases.load("cantilever-frf")
    (term,) = problem.likelihood.responses
    peaks = term.data.pick_frequencies(5)
    f = np.asarray(peaks.frequencies_hz)
    modes = fmu.ModalData(f, sd_hz=0.005 * f, numbers=tuple(range(1, len(f) + 1)), sensors=problem.data.sensors)
    of_modes = fmu.UpdatingProblem.reduced(problem.model.structure, modes, problem.parameters[:5])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        one, other = (fmu.summary(fmu.sample(p, "mixture", seed=1)) for p in (of_modes, problem))
    rows = []
    for name in problem.names[:5]:
        pair = " | ".join(f"{table['mean'][name]:.4g} ± {table['sd'][name]:.2g}" for table in (one, other))
        rows.append(f"| {name} | {pair} | {one['sd'][name] / other['sd'][name]:.0f} |")
    lines = "\n".join(rows)
    return f"""## What FRFs add

The case cantilever-frf as five frequencies, picked from its FRFs, with errors of 0.5 %, and as FRFs.

| modulus, N/m² | from the frequencies | from the FRFs | ratio of the standard deviations |
| :-- | --: | --: | --: |
{lines}
"""


def identified() -> str:
    """Return the section on the same test as modes that a library identifies and as FRFs."""
    heading = "## The same test as modes identified by sdypy-EMA, and as FRFs\n\n"
    if find_spec("sdypy") is None:
        return f"{heading}Not measured: sdypy-EMA was not installed (`pip install '.[ema]'`).\n"
    case, data = fmu.cases.load("cantilever-frf"), measure(lines=EVEN)
    modes, damping, _ = data.identify_modes(5)
    f = np.asarray(modes.frequencies_hz)
    sensors = [(NODES[place], direction) for place, direction in modes.sensors]
    known = fmu.ModalData(f, sd_hz=0.005 * f, sensors=sensors, shapes=modes.shapes)
    structure, moduli = case.model.structure, case.parameters[:5]
    shapes = fmu.ShapeErrors(sd=0.05)
    errors = fmu.FRFErrors(data, fmu.ModalDamping(case.parameters[5:]), places=NODES)
    problems = (
        fmu.UpdatingProblem.reduced(structure, known, moduli),
        fmu.UpdatingProblem.reduced(structure, known, moduli, error=[fmu.FrequencyErrors(), shapes]),
        fmu.UpdatingProblem.reduced(structure, known, moduli, error=errors),
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        traces = [fmu.sample(problem, "mixture", seed=1) for problem in problems]
    tables = [fmu.summary(trace) for trace in traces]
    rows = []
    for j, name in enumerate(case.names[:5]):
        cells = " | ".join(f"{table['mean'][name]:.4g} ± {table['sd'][name]:.2g}" for table in tables)
        rows.append(f"| {name} | {MODULI[j]:.4g} | {cells} |")
    for j, name in enumerate(case.names[5:10]):
        of = tables[-1]
        rows.append(
            f"| {name} | {RATIOS[j]:g} | – | {damping[j]:.4g} | {of['mean'][name]:.4g} ± {of['sd'][name]:.2g} |"
        )
    converged = sum(bool(fmu.diagnose(trace).converged) for trace in traces)
    lines = "\n".join(rows)
    found = ", ".join(significant(value, 4) for value in f)
    return f"""{heading}The beam of cantilever-frf, measured at {whole(len(EVEN))} lines {EVEN[1] - EVEN[0]:g} Hz
apart with errors of {100 * NOISE:g} % of |H|: the five modes that sdypy-EMA identifies from the FRFs ({found} Hz),
with errors of 0.5 % of their frequencies, and of 5 % of their shapes too; and the FRFs. {converged} of 3 runs
converged. A damping ratio of the modes is that of sdypy-EMA, without an error.

| parameter | true | frequencies | frequencies and shapes | FRFs |
| :-- | --: | --: | --: | --: |
{lines}
"""


def channels() -> str:
    """Return the section on a channel with a wrong gain and one with a delay."""
    case = fmu.cases.load("cantilever-frf")
    (term,) = case.likelihood.responses
    data, gain, delay = term.data, 1.4, 4e-4
    first, second = list(dict.fromkeys(data.responses))[:2]
    wrong, sd = np.array(data.values), np.array(data.sd)
    omega = 2 * np.pi * np.asarray(data.frequencies_hz)
    for row, response in enumerate(data.responses):
        if response == first:
            wrong[row] *= gain
            sd[row] *= gain
        if response == second:
            wrong[row] *= np.exp(-1j * omega * delay)
    own = {"drives": data.drives, "responses": data.responses, "kind": data.kind}
    changed = fmu.FRFData(data.frequencies_hz, wrong, sd=sd, **own)
    moduli, ratios = case.parameters[:5], case.parameters[5:]
    modes = fmu.ModalData(case.data.frequencies_hz, sd_hz=case.data.sd_hz, numbers=case.data.numbers)

    def run(data: fmu.FRFData, **options: object) -> tuple[pd.DataFrame, object]:
        errors = fmu.FRFErrors(data, fmu.ModalDamping(ratios), places=NODES, **options)  # type: ignore[arg-type]
        problem = fmu.UpdatingProblem.reduced(case.model.structure, modes, moduli, pairing="index", error=errors)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            trace = fmu.sample(problem, "mixture", seed=1)
        return fmu.summary(trace), trace

    right, _ = run(data)
    table, trace = run(changed, gain_sd={first: 0.5}, delay_sd={second: 1e-3})
    _, without = run(changed)
    off = np.max(np.abs(table["mean"][:5] - right["mean"][:5]) / right["sd"][:5])
    group = trace["frfs"].to_dataset()  # type: ignore[index]
    label = f"{first[0]} {first[1]}"
    found = float(group["gain"].sel(channel=label)), float(group["gain_sd"].sel(channel=label))
    name = f"delay of {second[0]} {second[1]}"
    return f"""## A channel with gain 1.4, and one with a delay of 0.4 ms

The case cantilever-frf with both put into its data. With `gain_sd` 0.5 and `delay_sd` 1 ms of these channels: gain
{1 + found[0]:.4f} ± {found[1]:.4f}, delay {1e3 * table["mean"][name]:.4f} ± {1e3 * table["sd"][name]:.4f} ms; the
moduli differ from those of the right data by at most {off:.1f} of their standard deviations; the model:
{fmu.diagnose(trace).fit.answer}. With both left out the model is {fmu.diagnose(without).fit.answer}.
"""


SECTIONS: dict[str, Callable[[], str]] = {
    "speed": speed,
    "adds": adds,
    "identified": identified,
    "channels": channels,
    "memory": memory,
    "large": large,
}


def main() -> int:
    """Write frfs.md."""
    asked = study_parser(__doc__).parse_args()
    units = Units(asked.kept, asked.minutes)
    parts = write_sections(SECTIONS, units)
    sbc = units.completed("calibrations", each(range(_SETS)), calibrated, fields_of(Set, list))
    hits = units.completed("sets of hits", each(range(_HITS)), of_hits, fields_of(Set, list))
    keys = [(name, seed) for name in PROBLEMS for seed in range(_STARTS)]
    starts = units.completed("starts", each(keys), started, fields_of(Start))
    head = (
        "# Updating from frequency response functions\n\n"
        "Written by `make validate` (`python -m tests.validation.frfs results`), in "
        f"{units.processor_s / 60.0:.0f} minutes of one core.\n"
    )
    page = [
        head,
        *parts,
        calibration_page(sbc),
        hits_page(hits),
        starts_page(starts),
        damage(units),
        wrong_models(units),
    ]
    (asked.out / "frfs.md").write_text("\n".join(page), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
