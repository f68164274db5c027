"""Surrogates: exact posteriors, small budgets, interruptions and difficult functions.

    python -m tests.validation.surrogate OUT [--kept DIRECTORY] [--minutes M]

Writes ``surrogate.md``. The parts "others" need nautilus-sampler (`make bench` installs it). The exit code is 1
if a gate fails or a part is missing.
"""

from __future__ import annotations

import os
import random
import resource
import signal
import subprocess
import sys
import time
import warnings
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

import fmu
from fmu.analysis.maxima.search import find_map
from fmu.analysis.maxima.starts import choose_starts, components
from fmu.analysis.trace.conversion import to_trace
from fmu.analysis.trace.reading import parameter_draws
from fmu.samplers.loop.run import run
from fmu.samplers.registry import make_sampler
from fmu.surrogates.error_limits import ErrorLimits
from fmu.surrogates.learning import CHECKS
from fmu.surrogates.selection import error_variances, stratify
from tests.benchmarks.peers.posteriors import of_unit_cube
from tests.validation import surrogate_cases
from tests.validation.kept import Units, study_parser
from tests.validation.surrogate_cases import POOR, PoorCase, cases, grid_moments, storeys, through, two_storeys
from tests.validation.surrogate_page import N_CASES, page, passed

SEED = 1
DRAWS, WARMUP = 2000, 500
MOST_SOLVES = 500_000
ESS = 400
"""Effective sample size at which the Monte-Carlo error of a mean is 0.05 posterior standard deviations."""
BUDGETS = 200
CHOICES, CANDIDATES = 400, 300
KILLS = 10
SEEDS = 60
SD = np.array([0.01, 0.03])


def known_posterior(number: int) -> dict[str, Any]:
    """Compare the posterior of a surrogate with the exact posterior.

    Importance weights turn draws from the surrogate's posterior into draws from the exact one. The difference
    between their moments with and without weights has almost no Monte-Carlo error. An independent run with the
    exact posterior shows whether the surrogate misses a part of it.
    """
    case = cases()[number]()
    given = through(case)
    began = time.process_time()
    surrogate = fmu.surrogate(given, seed=SEED)
    learning_s = time.process_time() - began
    exact, found = (
        fmu.sample(problem, draws=DRAWS, warmup=WARMUP, seed=seed)
        for problem, seed in ((case.exact, 11), (surrogate, 12))
    )
    draws = parameter_draws(found).reshape(-1, case.exact.ndim)
    error = case.exact.log_prob(draws) - surrogate.log_prob(draws)
    w = np.exp(error - error.max())
    of_mean, of_sd = shifts(draws, error)
    true, ours = fmu.summary(exact), fmu.summary(found)
    mcse = np.hypot(true["sd"] / np.sqrt(true["ess_bulk"]), ours["sd"] / np.sqrt(ours["ess_bulk"]))
    return {
        "name": case.name,
        "parameters": case.exact.ndim,
        "most": case.most,
        "solves": surrogate.model.certificate.solves,
        "shift": surrogate.model.certificate.shift,
        "mean": of_mean,
        "sd": of_sd,
        "log_prob_sd": float(error.std()),
        "kept": float(w.sum() ** 2 / np.sum(w**2) / len(w)),
        "apart": float(np.max(np.abs(ours["mean"] - true["mean"]) / mcse)),
        "learning_s": learning_s,
    }


def others(number: int) -> dict[str, Any]:
    """Return the solves of other samplers to an ESS of 400, on the posterior from the structure's matrices."""
    case = cases()[number]()
    problem = case.exact
    found = {"name": case.name}
    for name in ("mixture", "hmc", "emcee"):
        trace = fmu.sample(problem, name, until_ess=ESS, max_solves=MOST_SOLVES, seed=13)
        # a function has no gradients: HMC would need differences, and the mixture few or none
        found[name] = needed(trace, 2 * problem.ndim + 1 if name == "hmc" else 1)
    import nautilus

    sampler = nautilus.Sampler(
        of_unit_cube(problem), problem.log_likelihood, n_dim=problem.ndim, vectorized=True, seed=SEED
    )
    if sampler.run(n_eff=ESS, n_like_max=MOST_SOLVES):
        found["nautilus"] = float(sampler.n_like)
    return found


def needed(trace: Any, per_gradient: int) -> float:
    """Return the solves from the start of warm-up until every parameter has an ESS of 400, by proportion."""
    summary = fmu.summary(trace)
    solves = {
        name: float(trace.attrs[f"{name}n_solves"]) + (per_gradient - 1) * float(trace.attrs[f"{name}n_gradients"])
        for name in ("warmup_", "")
    }
    return solves["warmup_"] + solves[""] * ESS / min(summary["ess_bulk"].min(), summary["ess_tail"].min())


def small_budgets() -> dict[str, Any]:
    """Return the reported and real errors of 200 surrogates that learn from the first design only."""
    rng = np.random.default_rng(SEED)
    reported, real = [], []
    for k in range(BUDGETS):
        truth = rng.uniform([3e7, 2e7], [7e7, 5e7])
        sd = SD * 10.0 ** rng.uniform(-1.5, 0.0)
        problem = two_storeys(storeys, storeys(truth) + sd * rng.standard_normal(2), sd)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            surrogate = fmu.surrogate(problem, seed=k, max_solves=22, tolerance=1e-6)
        best = fmu.find_map(problem, 16)[0]
        mean, width = grid_moments(problem, best.mean, best.sd)
        shifted, _ = grid_moments(surrogate, mean, width)
        reported.append(float(surrogate.model.certificate.shift))
        real.append(float(np.max(np.abs(shifted - mean) / width)))
    return {"reported": reported, "real": real}


def held() -> list[dict[str, Any]]:
    """Return how often the error limit of a certificate holds, for surrogates with few solves.

    The real errors are known from the importance weights of all draws. Each limit uses a random choice of draws,
    as `fmu.surrogate` makes it.
    """
    found = []
    rng = np.random.default_rng(SEED)
    for number, budgets in enumerate(((30, 34, 38), (30, 34, 38), (70, 110, 150), (60, 110, 160))):
        case = cases()[number]()
        for most in budgets:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                surrogate = fmu.surrogate(through(case), seed=SEED, max_solves=most, tolerance=1e-3)
                trace = fmu.sample(surrogate, draws=1000, warmup=WARMUP, seed=12)
            draws = np.unique(parameter_draws(trace).reshape(-1, case.exact.ndim), axis=0)
            error = case.exact.log_prob(draws) - surrogate.log_prob(draws)
            real = float(max(shifts(draws, error)))
            variance, _ = error_variances(surrogate.likelihood, surrogate.model, draws)
            expected = float(np.sqrt(variance.mean()))
            limits = []
            for _ in range(CHOICES):
                some = rng.choice(len(draws), min(CANDIDATES, len(draws)), replace=False)
                chosen = some[stratify(variance[some], CHECKS, rng)]
                limits.append(ErrorLimits.of(error[chosen], draws, expected).shift)
            found.append(
                {
                    "name": case.name,
                    "solves": surrogate.model.certificate.solves,
                    "sd": float(error.std()),
                    "real": real,
                    "limit": float(np.median(limits)),
                    "held": float(np.mean(np.array(limits) >= real)),
                }
            )
    return found


def shifts(draws: Any, error: Any) -> tuple[float, float]:
    """Return the largest shift of a mean, in sds, and relative change of an sd, by weights exp(error)."""
    w = np.exp(error - error.max())
    w /= w.sum()
    mean = w @ draws
    sd = np.sqrt(w @ (draws - mean) ** 2)
    of_mean, of_sd = np.abs(draws.mean(axis=0) - mean) / sd, np.abs(draws.std(axis=0) / sd - 1.0)
    return float(np.max(of_mean)), float(np.max(of_sd))


def in_folder(folder: Path, seconds: float) -> list[str]:
    """Write a slow function and its problem file, and return the command that runs it."""
    (folder / "slow.py").write_text(surrogate_cases.SLOW.replace("SECONDS", str(seconds)))
    (folder / "slow.toml").write_text(surrogate_cases.PROBLEM)
    return [sys.executable, "-m", "fmu", "run", str(folder / "slow.toml"), "--workers", "2", "--progress", "none",
            "--out", str(folder / "run")]  # fmt: skip


def calls(folder: Path) -> tuple[Counter[str], Counter[str]]:
    """Return how often the solve of each theta began, and how often it ended."""
    lines = [line.split() for line in (folder / "log").read_text().splitlines()]
    return tuple(Counter(line[1] for line in lines if line[0] == what) for what in ("begun", "done"))  # type: ignore[return-value]


def one_second() -> dict[str, Any]:
    """Run a function that takes one second, with two workers."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        command = in_folder(folder, 1.0)
        before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        wall_s, after = time.monotonic() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
        attrs = fmu.load_trace(folder / "run" / "mixture.nc").attrs
        return {
            "code": done.returncode,
            "wall_s": wall_s,
            "cpu_s": after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime,
            "solves": int(attrs["surrogate_solves"]),
            "shift": float(attrs["certificate_shift"]),
            "converged": "converged" in done.stdout and "not converged" not in done.stdout,
        }


def killed() -> dict[str, Any]:
    """Kill a run ten times at random, resume it each time, and count the repeated solves."""
    rng = random.Random(SEED)
    with TemporaryDirectory() as name:
        folder = Path(name)
        command = in_folder(folder, 0.5)
        resumed = [*command[:4], "--resume", str(folder / "run"), "--workers", "2", "--progress", "none"]
        kills, code = 0, None
        while kills < KILLS:
            started = (folder / "run" / "checkpoints" / "run.json").exists()
            process = subprocess.Popen(resumed if started else command, stdout=subprocess.DEVNULL,
                                       stderr=subprocess.DEVNULL, start_new_session=True)  # fmt: skip
            solved, patience = len((folder / "log").read_text()) if (folder / "log").exists() else 0, 120.0
            until = time.monotonic() + patience
            while process.poll() is None and time.monotonic() < until:  # until it solves something new
                if (folder / "log").exists() and len((folder / "log").read_text()) > solved:
                    break
                time.sleep(0.05)
            time.sleep(rng.uniform(0.0, 2.0))
            if process.poll() is not None:
                code = process.returncode
                break
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            kills += 1
        if code is None:
            code = subprocess.run(resumed, capture_output=True, check=False).returncode
        begun, done = calls(folder)
        attrs = fmu.load_trace(folder / "run" / "mixture.nc").attrs
        start_calls = max(done.values())  # the start is solved once more, to measure its time
        twice = sum(n > 1 for n in done.values()) - (1 if start_calls > 1 else 0)
        return {
            "kills": kills,
            "code": code,
            "solves": int(attrs["surrogate_solves"]),
            "distinct": len(done),
            "twice": twice,
            "broken_off": sum(begun.values()) - sum(done.values()),
        }


def awkward() -> dict[str, Any]:
    """Return the errors of the moments, the solves and the messages for difficult functions."""
    measured = storeys(np.array([5.2e7, 3.1e7]))
    plain = two_storeys(storeys, measured, SD)
    best = fmu.find_map(plain, 16)[0]
    mean, sd = grid_moments(plain, best.mean, best.sd)

    def compared(surrogate: Any, reference: Any = None) -> dict[str, Any]:
        true_mean, true_sd = (mean, sd) if reference is None else reference
        found_mean, found_sd = grid_moments(surrogate, true_mean, true_sd)
        record = surrogate.model.certificate
        return {
            "mean": float(np.max(np.abs(found_mean - true_mean) / true_sd)),
            "sd": float(np.max(np.abs(found_sd / true_sd - 1.0))),
            "solves": record.solves,
            "shift": record.shift,
            "told": record.failed_where,
            "scatter": record.scatter,
        }

    found = {"no difficulty": compared(fmu.surrogate(plain))}
    names = ("k1", "k2", "a", "b", "c")
    found["three parameters without effect"] = compared(fmu.surrogate(two_storeys(storeys, measured, SD, names)))

    def crossing(theta: Any) -> dict[str, Any]:
        f = np.sqrt(theta[:2] * np.array([1.0, 5.0 / 3.0])) / 1500.0
        order = np.argsort(f)
        return {"frequencies": f[order], "shapes": np.array([[1.0, 0.1], [0.1, 1.0]])[:, order]}

    shapes = {"sensors": [(0, "x"), (1, "x")], "shapes": [[1.0, 0.1], [0.1, 1.0]]}
    of_pair = np.sqrt(np.array([5e7, 5e7])) / 1500.0 + np.array([0.01, -0.01])
    crossed = two_storeys(crossing, of_pair, np.array([0.1, 0.1]), **shapes)
    top = fmu.find_map(crossed, 16)[0]
    found["two modes that cross, paired by MAC"] = compared(
        fmu.surrogate(crossed), grid_moments(crossed, top.mean, top.sd)
    )
    by_number = two_storeys(lambda theta: crossing(theta)["frequencies"], of_pair, np.array([0.1, 0.1]))
    moments = grid_moments(by_number, top.mean, top.sd)
    found["two modes that cross, paired by number"] = compared(fmu.surrogate(by_number), moments)
    edge = mean[0] + 0.5 * sd[0]

    def corner(theta: Any) -> Any:
        if theta[0] > edge:
            raise RuntimeError("no convergence")
        return storeys(theta)

    failing = two_storeys(corner, measured, SD)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        half = grid_moments(failing, mean, sd)
        found[f"solves fail for k1 above {edge:.4g}, half a sd above the mean"] = compared(
            fmu.surrogate(failing), half
        )
        rng = np.random.default_rng(SEED)
        noisy = two_storeys(lambda theta: storeys(theta) * (1.0 + 1e-4 * rng.standard_normal(2)), measured, SD)
        found["relative noise of 1e-4 in the frequencies"] = compared(fmu.surrogate(noisy))
    return found


def exact_draws() -> list[dict[str, Any]]:
    """Return the errors of draws from poor surrogates, before and after delayed acceptance."""
    return [corrected(case) for case in POOR]


def corrected(case: PoorCase) -> dict[str, Any]:
    """Compare both stages of delayed acceptance with quadrature, over `SEEDS` seeds."""
    mean, sd = case.moments()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        surrogate = fmu.surrogate(case.problem(), seed=case.seed, max_solves=22, tolerance=1e-6)
    maxima = find_map(surrogate, 32)
    settings = make_sampler("mixture").starting_from(*components(surrogate, maxima))
    off: dict[str, list[Any]] = {"first": [], "second": []}
    records = []
    for seed in range(SEEDS):
        start = choose_starts(surrogate, "maxima", maxima, 4, 1, seed).position
        drawn = run(surrogate, settings, draws=4000, warmup=200, chains=4, seed=seed, init=start)
        first = to_trace(drawn, surrogate, predictions=False)
        second = fmu.delayed_acceptance(surrogate, first)
        for stage, trace in (("first", first), ("second", second)):
            table = fmu.summary(trace)
            moments = [*((table["mean"] - mean) / sd), *(table["sd"] / sd - 1.0)]
            off[stage].append(moments)
        attrs = second.attrs
        accepted = attrs["second_stage_accepted"] / attrs["second_stage_proposals"]
        records.append(
            (attrs["second_stage_solves"], accepted, min(table["ess_bulk"].min(), table["ess_tail"].min()))
        )
    first_off, second_off = (np.array(off[stage]) for stage in ("first", "second"))
    error = second_off.std(axis=0, ddof=1) / np.sqrt(SEEDS)
    solves, accepted, ess = np.mean(records, axis=0)
    return {
        "name": case.name,
        "seeds": SEEDS,
        "learnt": surrogate.model.certificate.solves,
        "surrogate": first_off.mean(axis=0).tolist(),
        "exact": second_off.mean(axis=0).tolist(),
        "error": error.tolist(),
        "solves": float(solves),
        "accepted": float(accepted),
        "ess": float(ess),
    }


PARTS: dict[str, Callable[[], Any]] = {
    **{f"case {i}": lambda i=i: known_posterior(i) for i in range(N_CASES)},  # type: ignore[misc]
    **{f"others {i}": lambda i=i: others(i) for i in range(N_CASES)},  # type: ignore[misc]
    "awkward": awkward,
    "one second": one_second,
    "kills": killed,
    "budgets": small_budgets,
    "held": held,
    "exact": exact_draws,
}


def main() -> int:
    """Run the missing parts, write the page, and return the exit code."""
    asked = study_parser(__doc__).parse_args()
    units = Units(asked.kept, asked.minutes)
    with threadpool_limits(1):
        parts = units.completed("parts", PARTS.items(), lambda part: part())
    known = dict(zip(PARTS, parts, strict=False))
    missing = [part for part in PARTS if part not in known]
    (asked.out / "surrogate.md").write_text(page(known, missing), encoding="utf-8")
    return 0 if passed(known) and not missing else 1


if __name__ == "__main__":
    sys.exit(main())
