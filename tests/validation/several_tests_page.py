"""The page of `tests.validation.several_tests`: what was found, and whether it may be so."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.stats import binom

from fmu.numbers import fixed, share, significant, with_sd
from fmu.tables import markdown_table
from tests.validation.bands import UniformRanks

INTERVAL = 0.9
LEVEL = 1e-3
BEYOND, ALARM = 0.05, 0.5
RANKED = 63
MANY = 10
EDGES = (0.0, 0.1, 0.3, 0.7, 0.9, 1.0)


@dataclass(frozen=True)
class Gate:
    """A statement, what was found, what a right result may be, and whether it is."""

    what: str
    found: str
    allowed: str
    passed: bool


def coverage(runs: Sequence[Mapping[str, Any]]) -> list[Gate]:
    """Return the gates of intervals and ranks."""
    if not runs:
        return []
    gates, n = [], len(runs)
    names = list(runs[0]["inside"])
    level = LEVEL / (2 * len(names))
    for name in names:
        inside = sum(run["inside"][name] for run in runs)
        low, high = binom.interval(1.0 - level, n, INTERVAL)
        what = f"90 % interval of {name} holds the truth"
        passed = bool(low <= inside <= high)
        gates.append(Gate(what, f"{inside} of {n}", f"{low:.0f} to {high:.0f}", passed))
    for name in names:
        p = UniformRanks(n, RANKED).p_value(np.array([run["ranks"][name] for run in runs]))
        gates.append(
            Gate(f"ranks of {name} are uniform", f"p = {significant(p, 2)}", f"p ≥ {level:.1g}", p >= level)
        )
    return gates


def reliability(runs: Sequence[Mapping[str, Any]]) -> list[Gate]:
    """Return the gates of P(loss > 5 %): in each class of p, as many losses are larger as p says."""
    if not runs:
        return []
    p = np.concatenate([run["p"] for run in runs])
    larger = np.concatenate([np.array(run["losses"]) > BEYOND for run in runs])
    gates = []
    for low, high in pairwise(EDGES):
        here = (p >= low) & ((p < high) | (high == 1.0))
        if not here.any():
            continue
        n, mean = int(here.sum()), float(p[here].mean())
        # of independent losses with these probabilities; the band is that of their mean
        few, many = binom.interval(1.0 - LEVEL / (len(EDGES) - 1), n, min(max(mean, 1e-9), 1.0 - 1e-9))
        said = f"P(loss > 5 %) from {share(low)} to {share(high)}, {share(mean)} on average"
        count = int(larger[here].sum())
        gates.append(Gate(said, f"{count} of {n} are", f"{few:.0f} to {many:.0f}", bool(few <= count <= many)))
    return gates


def alarms(runs: Sequence[Mapping[str, Any]]) -> list[Gate]:
    """Return the gates of false alarms under a change of temperature."""
    if not runs:
        return []
    n = len(runs)
    told, untold = (sum(run[name] > ALARM for run in runs) for name in ("with", "without"))
    most = int(binom.ppf(1.0 - LEVEL, n, 0.1))
    return [
        Gate(
            "buildings with a false alarm, temperature as a covariate",
            f"{told} of {n}",
            f"at most {most}",
            told <= most,
        ),
        Gate("the same without the covariate", f"{untold} of {n}", f"more than {told}", untold > told),
    ]


def scatter(runs: Sequence[Mapping[str, Any]]) -> list[Gate]:
    """Return the gates of more and more tests: what falls as 1/√n, and what does not."""
    if not runs:
        return []
    sizes = list(runs[0]["tests"])
    error = np.array([[run["sd_of_mean"][i] for i in range(len(sizes))] for run in runs])
    spread = np.array([[run["population_sd"][i] for i in range(len(sizes))] for run in runs])
    truth, n = runs[0]["truth"], len(runs)
    many = np.array(sizes) >= MANY
    power = np.polyfit(np.log(sizes)[many], np.log(error.mean(axis=0))[many], 1)[0]
    mean, mcse = float(spread[:, -1].mean()), float(spread[:, -1].std() / np.sqrt(n))
    off = abs(mean - truth) / mcse
    return [
        Gate(
            f"the sd of the population's mean falls as this power of the number of tests, from {MANY} on",
            fixed(power, 2),
            "-0.58 to -0.42",
            bool(-0.58 <= power <= -0.42),
        ),
        Gate(
            f"the population's sd with {sizes[-1]} tests is the true one, {truth}",
            f"{with_sd(mean, mcse)}: {fixed(off, 1)} standard errors away",
            "at most 4",
            bool(off <= 4.0),
        ),
    ]


def scatter_table(runs: Sequence[Mapping[str, Any]]) -> str:
    """Return what a growing number of tests tells, averages over the replicates."""
    header = [
        "tests",
        "sd of the population's mean",
        "times √n",
        "population's sd: mean ± sd over the replicates",
        "90 % of it, mean ends",
        "next tests within 90 %",
        "sd of the stiffness by mean ± s/√n",
        "next tests within 90 %, by mean ± s/√n",
    ]
    rows = []
    for i, n in enumerate(runs[0]["tests"] if runs else ()):
        of = {key: np.array([run[key][i] for run in runs]) for key in runs[0] if isinstance(runs[0][key], list)}
        error, spread = float(of["sd_of_mean"].mean()), of["population_sd"]
        rows.append(
            [
                str(n),
                significant(error, 3),
                significant(error * np.sqrt(n), 3),
                f"{fixed(float(spread.mean()), 4)} ± {fixed(float(spread.std()), 4)}",
                f"{fixed(float(of['low'].mean()), 4)} to {fixed(float(of['high'].mean()), 4)}",
                share(float(of["within"].mean())),
                significant(float(of["sd_by_average"].mean()), 3),
                share(float(of["within_by_average"].mean())),
            ]
        )
    return markdown_table(header, rows)


def page(runs: Sequence[Mapping[str, Any]]) -> tuple[str, bool]:
    """Return the page, and whether every gate passes."""
    of = {name: [run for run in runs if run["study"] == name] for name in GATES}
    rhat = [run["rhat"] for run in of["covered"]] or [np.nan]
    words = {
        "scattered": (
            "More and more tests",
            f"{len(of['scattered'])} buildings of two storeys whose stiffnesses scatter between tests; the "
            "figures are those of the first storey, relative to its nominal stiffness. More tests make the error "
            "of the population's mean smaller; its standard deviation is a property of the structure, and stays. "
            "Beside it is a single update with the mean of all tests ± s/√n. Its posterior is that of the "
            "mean alone: it says nothing of the variability. Both predict the frequencies of a next test, the "
            "latter with the scatter s of the measured ones.\n\n" + scatter_table(of["scattered"]),
        ),
        "covered": (
            "Coverage",
            f"{len(of['covered'])} buildings of two storeys with ten tests each; the largest R-hat of a run has a "
            f"median of {fixed(float(np.median(rhat)), 3)}.",
        ),
        "damaged": (
            "Damage",
            f"{len(of['damaged'])} buildings of four storeys, two tests before and two after.",
        ),
        "warmed": (
            "Temperature",
            f"{len(of['warmed'])} undamaged buildings, three tests between 0 and 10 °C and three between 20 and "
            "30 °C, stiffness −0.3 % per °C. An alarm is P(loss > 5 %) above one half in any storey.",
        ),
    }
    lines = [
        "# Several tests of one structure",
        "",
        "Made by `python -m tests.validation.several_tests results`, whose first lines say what is simulated.",
        "",
    ]
    passed = True
    for name, (title, text) in words.items():
        gates = GATES[name](of[name])
        rows = [[gate.what, gate.found, gate.allowed, "yes" if gate.passed else "**no**"] for gate in gates]
        lines += [f"## {title}", "", text, "", markdown_table(["", "found", "allowed", "passed"], rows), ""]
        passed &= bool(gates) and all(gate.passed for gate in gates)
    return "\n".join(lines), passed


GATES = {"scattered": scatter, "covered": coverage, "damaged": reliability, "warmed": alarms}
