"""Updating from frequency response functions (FRFs): calibration, coverage, repeated runs, size, memory and speed.

    python -m tests.validation.frfs OUT [--kept DIRECTORY] [--minutes M]

Writes ``frfs.md``.
"""

from __future__ import annotations

import resource
import subprocess
import sys
import time
import warnings
from collections.abc import Callable
from copy import copy
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec

import numpy as np
import pandas as pd

import fmu
from fmu.analysis.trace.reading import parameter_draws
from fmu.posterior.problem import UpdatingProblem
from fmu.types import FloatArray
from tests import measured_frfs as storeys
from tests.validation import frfs_page as text
from tests.validation.cantilever_frf import NODES, measure
from tests.validation.frf_damage import damage_page, damaged_pairs
from tests.validation.frf_structures import frame_problem, many_lines, ratio_to_eigh
from tests.validation.frf_wrong import wrong_models, wrong_page
from tests.validation.frfs_page import RANKED, STARTS
from tests.validation.kept import Units, each, fields_of, study_parser
from tests.validation.sections import write_sections

_SETS, _HITS = 200, 100
_GAIN_SD, _DELAY_SD = 0.05, 1e-3
EVEN = np.arange(20.0, 2000.1, 0.5)
"""Equally spaced frequency lines, as experimental modal analysis needs them, Hz."""


@dataclass
class Set:
    """One simulated test of a building of three storeys.

    Attributes
    ----------
    seed : int
    ranks : list of int
        Ranks of the true values among `RANKED` draws. The gain error is the last one.
    inside : list of bool
        Whether each 90 % interval contains the true value.
    converged : bool
    seconds : float
        Processor time.
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
    """Draw moduli, damping ratios, a delay and a gain error from their priors, update, and return the ranks."""
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
    some = draws[rng.permutation(len(draws))[:RANKED]]
    (term,) = problem.likelihood.responses
    best, width = term.gains(some)
    gains = best[:, 1] + width[:, 1] * rng.standard_normal(RANKED)
    truth, every = np.r_[theta, gain], np.column_stack([some, gains])
    low, high = np.quantile(draws, [0.05, 0.95], axis=0)
    inside = ((theta >= low) & (theta <= high)).tolist()
    return Set(seed, np.sum(every < truth, axis=0).tolist(), inside, converged, time.process_time() - began)


def of_hits(seed: int) -> Set:
    """Update with standard deviations estimated from five hits, and compare the intervals with the true values."""
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
    ranks = np.sum(draws < truth, axis=0) * (RANKED + 1) // (len(draws) + 1)
    inside = ((truth >= low) & (truth <= high)).tolist()
    return Set(seed, ranks.tolist(), inside, converged, time.process_time() - began)


@dataclass
class Start:
    """A run from one starting point.

    Attributes
    ----------
    problem : str
    seed : int
    converged : bool
    off : float
        Largest difference between a posterior mean and that of the reference run, in combined Monte-Carlo standard
        errors.
    maxima : int
        Number of maxima that the search found.
    seconds : float
        Processor time.
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
    return problem, reference, problem.sample_prior(np.random.default_rng(5), STARTS)


def started(key: tuple[str, int]) -> Start:
    """Search for the maxima of a problem from one starting point, sample, and compare with the reference run."""
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
    return text.large(
        seconds=seconds,
        clock=clock,
        trained=trained,
        vectors=term.model.block.size,
        points=term.model.n_solves,
        converged=bool(fmu.diagnose(trace).converged),
        off=np.max(np.abs(summary["mean"] - truth) / summary["sd"]),
        shift=trace.attrs["frf_certificate_shift"],
        direct=trace.attrs["frf_certificate_direct_error"],
    )


def memory() -> str:
    """Return the section on the memory of a batch of gradients."""
    code = "from tests.validation.frfs import print_peak; print_peak()"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return text.memory(*map(float, found.stdout.split()[-3:]))


def print_peak() -> None:
    """Print the peak memory of this process before and after a batch of gradients, GiB, and its processor time."""
    problem, theta = many_lines()
    problem.log_prob(theta[:1])
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    began = time.process_time()
    problem.log_prob_and_grad(theta)
    seconds = time.process_time() - began
    print(before, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20, seconds)


def speed() -> str:
    """Return the section on speed."""
    return text.speed(*ratio_to_eigh())


def adds() -> str:
    """Return the section that compares natural frequencies with FRFs of the same test."""
    problem = fmu.cases.load("cantilever-frf")
    (term,) = problem.likelihood.responses
    peaks = term.data.pick_frequencies(5)
    f = np.asarray(peaks.frequencies_hz)
    modes = fmu.ModalData(f, sd_hz=0.005 * f, numbers=tuple(range(1, len(f) + 1)), sensors=problem.data.sensors)
    of_modes = fmu.UpdatingProblem.reduced(problem.model.structure, modes, problem.parameters[:5])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        one, other = (fmu.summary(fmu.sample(p, "mixture", seed=1)) for p in (of_modes, problem))
    return text.adds(problem.names[:5], one, other)


def identified() -> str:
    """Return the section that compares modes identified by sdypy-EMA with FRFs of the same test."""
    if find_spec("sdypy") is None:
        return text.not_identified()
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
    converged = sum(bool(fmu.diagnose(trace).converged) for trace in traces)
    return text.identified(case.names, f, damping, [fmu.summary(trace) for trace in traces], EVEN, converged)


def channels() -> str:
    """Return the section on one channel with a wrong gain and one with a delay."""
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
    group = trace["frfs"].to_dataset()  # type: ignore[index]
    label, name = f"{first[0]} {first[1]}", f"delay of {second[0]} {second[1]}"
    return text.channels(
        gain=float(group["gain"].sel(channel=label)),
        gain_sd=float(group["gain_sd"].sel(channel=label)),
        delay=table["mean"][name],
        delay_sd=table["sd"][name],
        off=np.max(np.abs(table["mean"][:5] - right["mean"][:5]) / right["sd"][:5]),
        with_both=fmu.diagnose(trace).fit.answer,
        without=fmu.diagnose(without).fit.answer,
    )


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
    keys = [(name, seed) for name in PROBLEMS for seed in range(STARTS)]
    starts = units.completed("starts", each(keys), started, fields_of(Start))
    pairs, wrong = damaged_pairs(units), wrong_models(units)
    page = [
        text.head(sbc, hits, starts, pairs, units.processor_s / 60.0),
        *parts,
        text.calibration(sbc),
        text.hits(hits),
        text.starts(starts),
        damage_page(pairs),
        wrong_page(wrong),
    ]
    (asked.out / "frfs.md").write_text("\n".join(page), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
