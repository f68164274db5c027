"""The page and the gates of the study `tests.validation.surrogate`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from fmu.numbers import significant, whole
from fmu.tables import markdown_table

MEAN, SD = 0.05, 0.05
FEWER = 50.0
APART = 4.0
SAMPLERS = ("mixture", "hmc", "emcee", "nautilus")
HELD = 0.95
WALL_S = 60.0
Z = 3.5
"""Gate of the largest of twelve errors, in standard errors from sixty seeds; chance exceeds it in 1 % of pages."""
CASES = ("cantilever-young", "cantilever-section", "garteur", "plate of eight moduli")
N_CASES = len(CASES)
PARTS = {
    **{f"case {i}": f"the posterior of {name}" for i, name in enumerate(CASES)},
    **{f"others {i}": f"other samplers for {name}" for i, name in enumerate(CASES)},
    "awkward": "difficult functions", "one second": "one second per solve", "kills": "interruptions",
    "budgets": "small budgets", "held": "limits of certificates", "exact": "delayed acceptance",
}  # fmt: skip
"""Name of a part of the study -> its name on the page."""


class Gate(NamedTuple):
    """A gate: its name, the limit, the value found, and whether the value meets the limit."""

    name: str
    wanted: str
    found: str
    is_met: bool


def at_most(name: str, value: float, most: float) -> Gate:
    """Return the gate of a number with an upper limit."""
    return Gate(name, f"≤ {most:g}", significant(value, 3), value <= most)


def at_least(name: str, value: float, least: float) -> Gate:
    """Return the gate of a number with a lower limit."""
    return Gate(name, f"≥ {least:g}", significant(value, 3), value >= least)


def gates(known: Mapping[str, Any]) -> list[Gate]:
    """Return the gates of the parts that were run."""
    found = []
    for case in _cases(known):
        name = case["name"]
        found += [
            at_most(f"{name}: solves", case["solves"], case["most"]),
            at_most(f"{name}: error of a mean, posterior sd", case["mean"], MEAN),
            at_most(f"{name}: relative error of an sd", case["sd"], SD),
            at_most(f"{name}: certified error, posterior sd", case["shift"], MEAN),
            at_most(f"{name}: difference from an exact run, standard errors", case["apart"], APART),
        ]
        for sampler, solves in _others(known, name).items():
            if sampler != "mixture":  # no gate compares with it
                ratio = solves / case["solves"]
                found.append(at_least(f"{name}: solves of {sampler} / of the surrogate", ratio, FEWER))
    if "budgets" in known:
        held = share_held(known["budgets"])
        found.append(at_least("small budgets: share of reported errors above the real one", held, HELD))
    for one in known.get("held", ()):
        name = f"{one['name']}, {one['solves']} solves: share of limits that hold"
        found.append(at_least(name, one["held"], HELD))
    for one in known.get("exact", ()):
        name = f"delayed acceptance, {one['name']}: error of a mean or sd, standard errors"
        found.append(at_most(name, largest_z(one), Z))
    if "kills" in known:
        kills = known["kills"]
        found.append(at_most(f"killed {kills['kills']} times: repeated solves", kills["twice"], 0))
        found.append(at_most(f"killed {kills['kills']} times: exit code at the end", kills["code"], 0))
    if "one second" in known:
        slow = known["one second"]
        found.append(at_most("one second per solve, two workers: wall time, s", slow["wall_s"], WALL_S))
        found.append(at_most("one second per solve: exit code (0 if converged and certified)", slow["code"], 0))
    for name, one in known.get("awkward", {}).items():
        is_right = one["mean"] <= max(MEAN, one["shift"]) or bool(one["told"])
        wanted = f"≤ {MEAN:g} or the certificate, or a message"
        found.append(Gate(f"{name}: error of a mean, sd", wanted, significant(one["mean"], 2), is_right))
    return found


def _cases(known: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    return [known[f"case {i}"] for i in range(N_CASES) if f"case {i}" in known]


def _others(known: Mapping[str, Any], name: str) -> dict[str, float]:
    """Return the solves of other samplers on a posterior, as far as they were run."""
    found = [known[f"others {i}"] for i in range(N_CASES) if f"others {i}" in known]
    return {s: one[s] for one in found if one["name"] == name for s in SAMPLERS if s in one}


def share_held(budgets: Mapping[str, Sequence[float]]) -> float:
    """Return the share of the runs whose reported error is at least as large as the real one."""
    return float(np.mean(np.array(budgets["reported"]) >= np.array(budgets["real"])))


def largest_z(one: Mapping[str, Any]) -> float:
    """Return the largest mean error of a moment, in its standard error."""
    return float(np.max(np.abs(np.array(one["exact"])) / np.array(one["error"])))


def passed(known: Mapping[str, Any]) -> bool:
    """Say whether all gates are passed."""
    return all(gate.is_met for gate in gates(known))


def page(known: Mapping[str, Any], missing: Sequence[str] = ()) -> str:
    """Return the page in Markdown; `missing` are the parts that were not run."""
    found = gates(known)
    rows = [(*gate[:3], "yes" if gate.is_met else "**no**") for gate in found]
    missed = [f"{gate.name} is {gate.found} (wanted: {gate.wanted})" for gate in found if not gate.is_met]
    verdict = f"**Gates missed: {'; '.join(missed)}.**" if missed else f"**All {len(rows)} gates are met.**"
    if missing:
        verdict += f" Not run for this page: {', '.join(PARTS[part] for part in missing)}."
    parts = [_HEAD.format(verdict=verdict, gates=markdown_table(("gate", "wanted", "found", "met"), rows))]
    parts.append(_POSTERIORS.format(table=_posteriors(known), solves=_solves(known)))
    if "awkward" in known:
        parts.append(_AWKWARD.format(table=_awkward(known["awkward"])))
    if "budgets" in known:
        parts.append(_of_budgets(known["budgets"]))
    if "held" in known:
        parts.append(_LIMITS.format(table=_limits(known["held"])))
    if "exact" in known:
        parts.append(_of_exact(known["exact"]))
    if "kills" in known:
        parts.append(_KILLS.format(kills=known["kills"]))
    if "one second" in known:
        slow = known["one second"]
        numbers = {name: significant(slow[name], 3) for name in ("wall_s", "cpu_s", "shift")}
        parts.append(_SECOND.format(solves=slow["solves"], **numbers))
    return "\n".join(parts)


def _posteriors(known: Mapping[str, Any]) -> str:
    header = (
        *("posterior", "parameters", "solves", "error of means, sd", "error of sds, %", "error of ln p"),
        *("ESS kept, %", "difference, standard errors", "certificate, sd", "learning, CPU s"),
    )
    rows = [
        (
            case["name"], whole(case["parameters"]), whole(case["solves"]), significant(case["mean"], 2),
            significant(100 * case["sd"], 2), significant(case["log_prob_sd"], 2),
            significant(100 * case["kept"], 3), significant(case["apart"], 2), significant(case["shift"], 2),
            significant(case["learning_s"], 2),
        )
        for case in _cases(known)
    ]  # fmt: skip
    return markdown_table(header, rows)


def _solves(known: Mapping[str, Any]) -> str:
    rows = []
    for case in _cases(known):
        of_others = _others(known, case["name"])
        rows.append(
            (
                case["name"],
                whole(case["solves"]),
                *(whole(round(of_others[s])) if s in of_others else "–" for s in SAMPLERS),
            )
        )
    return markdown_table(("posterior", "surrogate", *SAMPLERS), rows)


def _awkward(found: Mapping[str, Any]) -> str:
    header = (
        *("function", "solves", "error of means, sd", "error of sds, %", "certificate, sd", "estimated noise"),
        "message",
    )
    rows = [
        (
            name, whole(one["solves"]), significant(one["mean"], 2), significant(100 * one["sd"], 2),
            significant(one["shift"], 2), significant(one["scatter"], 2), one["told"] or "–",
        )
        for name, one in found.items()
    ]  # fmt: skip
    return markdown_table(header, rows)


def _limits(found: Sequence[Mapping[str, Any]]) -> str:
    header = ("posterior", "solves", "error of ln p", "real error", "median limit", "limits that hold, %")
    rows = [
        (one["name"], whole(one["solves"]), *(significant(one[name], 2) for name in ("sd", "real", "limit")),
         significant(100 * one["held"], 3))
        for one in found
    ]  # fmt: skip
    return markdown_table(header, rows)


def _of_budgets(budgets: Mapping[str, Sequence[float]]) -> str:
    real = np.array(budgets["real"])
    ratio = real / np.array(budgets["reported"])
    middle, largest = (significant(float(of(real)), 2) for of in (np.median, np.max))
    middle_ratio, largest_ratio = (significant(float(of(ratio)), 2) for of in (np.median, np.max))
    return _BUDGETS.format(
        runs=len(real),
        held=significant(100 * share_held(budgets), 3),
        middle=middle,
        largest=largest,
        middle_ratio=middle_ratio,
        largest_ratio=largest_ratio,
    )


def _of_exact(found: Sequence[Mapping[str, Any]]) -> str:
    header = (
        *("posterior", "surrogate: error of means, sd", "surrogate: error of sds, %"),
        *("delayed acceptance: error of means, sd", "delayed acceptance: error of sds, %"),
        *("standard error, sd", "solves", "accepted, %", "ESS"),
    )
    rows = []
    for one in found:
        off = [np.abs(np.array(one[name])).reshape(2, -1).max(axis=1) for name in ("surrogate", "exact")]
        rows.append((
            one["name"], *(significant(float(x), 2) for mean, sd in off for x in (mean, 100 * sd)),
            significant(max(one["error"]), 2), whole(round(one["solves"])), significant(100 * one["accepted"], 2),
            whole(round(one["ess"])),
        ))  # fmt: skip
    return _EXACT.format(
        seeds=found[0]["seeds"], learnt=found[0]["learnt"], z=Z, table=markdown_table(header, rows)
    )


_HEAD = """# Surrogates of slow models

Does a Gaussian-process surrogate (`fmu.surrogate`) give the posterior of a slow model with far fewer solves than
a sampler, and does its certificate hold? {verdict} The surrogate learns from a few solves of the model; further
solves certify its error. Errors in the gates are the largest over the parameters; sd stands for posterior
standard deviation.

{gates}"""
_POSTERIORS = """## Known posteriors

Each structure is given as a function that returns only frequencies. The posterior from the surrogate is compared
with the exact posterior from the matrices of the structure.

- *Error of means* and *of sds*: the largest difference between the moments of surrogate draws with and without the
  importance weights that make them draws from the exact posterior. It has almost no Monte-Carlo error.
- *Error of ln p*: standard deviation of the error of the log-density over these draws. *ESS kept*: the part of the
  effective sample size that remains after weighting.
- *Difference*: the largest difference between a mean and that of an independent run with the exact posterior.

{table}
The next table has the numbers of solves that give an ESS of 400, a Monte-Carlo error of a mean of 0.05 sd. The
number for the surrogate includes all of its solves. The mixture sampler, HMC and emcee have the settings of fmu,
and count from the start of warm-up, without the search for maxima. HMC computes gradients by differences, because
the function has no derivatives. nautilus has its own defaults (`n_eff=400`). A dash marks a run that was not made
or not finished.

{solves}"""
_AWKWARD = """## Difficult functions

The structure is a building of two storeys, whose posterior is known by quadrature. Where solves fail inside the
posterior, the certificate excludes the edge of the failure region, and a message says so. *Estimated noise* is the
relative scatter of the function that the surrogate estimates.

{table}"""
_BUDGETS = """## Small budgets

{runs} buildings have random stiffnesses and measurement errors. Each surrogate learns from 10 solves and is
checked with 12 more. The reported error is at least as large as the real one in {held} % of the runs. The median
real error is {middle} sd and the largest {largest} sd. The ratio of real to reported error is {middle_ratio} in
the median and at most {largest_ratio}.
"""
_EXACT = """## Delayed acceptance

Delayed acceptance (`fmu run --exact`) corrects the draws from poor surrogates, which learn from {learnt} solves
of a building of two storeys. Means and standard deviations are compared with quadrature. The table shows the
larger error of both parameters, averaged over {seeds} seeds; the standard error is that of the average. The gate
is {z} standard errors.

{table}"""
_LIMITS = """## Limits of certificates

These surrogates of the known posteriors have too few solves. *Real error* is the largest error of a mean, in
standard deviations, or of a standard deviation, relative; it is known from importance weights. A certificate
computes its limit from 12 draws. The choice of 12 draws is repeated 400 times as `fmu.surrogate` makes it; a
limit holds if it is at least as large as the real error.

{table}"""
_KILLS = """## Interruptions

A run with two workers and a function of half a second was killed {kills[kills]} times at random and resumed each
time. It took {kills[solves]} solves. {kills[twice]} of them were repeated, and kills interrupted
{kills[broken_off]} calls.
"""
_SECOND = """## One second per solve

A problem with three parameters and two workers takes {solves} solves and {wall_s} s from the start of `fmu run`
to the report, {cpu_s} s of which are processor time. The certified error is {shift} sd.
"""
