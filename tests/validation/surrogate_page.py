"""The page of surrogates, and whether its gates are passed."""

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
"""Largest of twelve errors, in standard errors from sixty seeds: larger in 1 % of such pages."""
N_CASES = 4


class Gate(NamedTuple):
    """What was wanted, what was found, and whether that is enough."""

    name: str
    wanted: str
    found: str
    is_met: bool


def at_most(name: str, value: float, most: float) -> Gate:
    """Return the gate of a number that must not be larger."""
    return Gate(name, f"≤ {most:g}", significant(value, 3), value <= most)


def at_least(name: str, value: float, least: float) -> Gate:
    """Return the gate of a number that must not be smaller."""
    return Gate(name, f"≥ {least:g}", significant(value, 3), value >= least)


def gates(known: Mapping[str, Any]) -> list[Gate]:
    """Return the gates of the parts that were run."""
    found = []
    for case in _cases(known):
        name = case["name"]
        found += [
            at_most(f"{name}: solves", case["solves"], case["most"]),
            at_most(f"{name}: means off, posterior sd", case["mean"], MEAN),
            at_most(f"{name}: sds off, relative", case["sd"], SD),
            at_most(f"{name}: certificate, posterior sd", case["shift"], MEAN),
            at_most(f"{name}: from a run of its own, standard errors", case["apart"], APART),
        ]
        for sampler, solves in _others(known, name).items():
            if sampler != "mixture":  # beside which nothing was asked for
                found.append(at_least(f"{name}: solves of {sampler} over ours", solves / case["solves"], FEWER))
    if "budgets" in known:
        held = share_held(known["budgets"])
        found.append(at_least("small budgets: reported error at least the real one", held, HELD))
    for one in known.get("held", ()):
        found.append(at_least(f"{one['name']}, {one['solves']} solves: limits that hold", one["held"], HELD))
    for one in known.get("exact", ()):
        name = f"exact draws, {one['name']}: largest error of a mean or sd, in its standard error"
        found.append(at_most(name, largest_z(one), Z))
    if "kills" in known:
        kills = known["kills"]
        found.append(at_most(f"killed {kills['kills']} times: solves done twice", kills["twice"], 0))
        found.append(at_most(f"killed {kills['kills']} times: exit code at the end", kills["code"], 0))
    if "one second" in known:
        slow = known["one second"]
        found.append(at_most("one second a solve, two workers: seconds in all", slow["wall_s"], WALL_S))
        found.append(at_most("one second a solve: exit code (converged and certified)", slow["code"], 0))
    for name, one in known.get("awkward", {}).items():
        is_right = one["mean"] <= max(MEAN, one["shift"]) or bool(one["told"])
        found.append(Gate(f"{name}: means off, sd", "right, or told", significant(one["mean"], 2), is_right))
    return found


def _cases(known: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    return [known[f"case {i}"] for i in range(N_CASES) if f"case {i}" in known]


def _others(known: Mapping[str, Any], name: str) -> dict[str, float]:
    """Return the solves of other samplers on a posterior, as far as they were run."""
    found = [known[f"others {i}"] for i in range(N_CASES) if f"others {i}" in known]
    return {s: one[s] for one in found if one["name"] == name for s in SAMPLERS if s in one}


def share_held(budgets: Mapping[str, Sequence[float]]) -> float:
    """Return the share of the runs whose reported error is at least the real one."""
    return float(np.mean(np.array(budgets["reported"]) >= np.array(budgets["real"])))


def largest_z(one: Mapping[str, Any]) -> float:
    """Return the largest mean error of a moment over its standard error."""
    return float(np.max(np.abs(np.array(one["exact"])) / np.array(one["error"])))


def passed(known: Mapping[str, Any]) -> bool:
    """Say whether all gates are passed."""
    return all(gate.is_met for gate in gates(known))


def page(known: Mapping[str, Any], missing: Sequence[str] = ()) -> str:
    """Return the page as Markdown; `missing` are parts that were not run."""
    rows = [(*gate[:3], "yes" if gate.is_met else "**no**") for gate in gates(known)]
    missed = [row[0] for row in rows if row[3] != "yes"]
    verdict = f"**Missed: {'; '.join(missed)}.**" if missed else "**All gates that were tried are passed.**"
    if missing:
        verdict += f" Not run for this page: {', '.join(missing)}."
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
        *("posterior", "parameters", "solves", "means off, sd", "sds off, %", "error of ln p, sd", "ESS kept, %"),
        *("apart, standard errors", "certificate, sd", "learning, s of processor"),
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
    header = ("function", "solves", "means off, sd", "sds off, %", "certificate, sd", "scatter estimated", "told")
    rows = [
        (
            name, whole(one["solves"]), significant(one["mean"], 2), significant(100 * one["sd"], 2),
            significant(one["shift"], 2), significant(one["scatter"], 2), one["told"] or "–",
        )
        for name, one in found.items()
    ]  # fmt: skip
    return markdown_table(header, rows)


def _limits(found: Sequence[Mapping[str, Any]]) -> str:
    header = ("posterior", "solves", "error of ln p, sd", "real error", "limit, median", "limits that hold, %")
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
        *("posterior", "surrogate: means off, sd", "sds off, %", "exact draws: means off, sd", "sds off, %"),
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

Written by `python -m tests.validation.surrogate results`; every number is computed. `fmu.surrogate` lets
Gaussian processes stand for a function, learnt from few solves, and certifies them by further ones.

{verdict}

{gates}
"""
_POSTERIORS = """## Known posteriors

Each structure as a function that gives frequencies and nothing else. Its posterior by the surrogate is compared
with the exact one by the structure's matrices. *Means and sds off*: moments of some thousand draws of the
surrogate's posterior, with and without the weights that make them draws of the exact one; hardly any of it is
Monte-Carlo error. *Error of ln p*: the standard deviation of the surrogate's error over these draws; *ESS kept*:
the part of the effective sample size that the weights leave. *Apart*: means of the surrogate's posterior from
those of a run of the exact one by itself, in standard errors, the largest over the parameters.

{table}

Solves for an error of a mean of 0.05 sd, an ESS of 400: those of the surrogate in all; of fmu's samplers and of
emcee, with fmu's settings, from the start of warm-up (the search for maxima comes on top); of nautilus with its
own defaults (`n_eff=400`). A gradient of HMC is by differences, as such a function has no other. A dash is a
run that was not made, or not to its end.

{solves}
"""
_AWKWARD = """## Awkward functions

A building of two storeys, whose posterior is known by quadrature. Where solves fail within the posterior, the
certificate does not contain the edge of that region, and a run says so.

{table}
"""
_BUDGETS = """## Small budgets

{runs} buildings with random stiffnesses and errors of measurement, each with 10 solves to learn from and 12 to
check. The error reported is at least the real one in {held} %. Real errors are {middle} sd in the median and
{largest} at most; real over reported is {middle_ratio} in the median and {largest_ratio} at most.
"""
_EXACT = """## Exact draws

Delayed acceptance (`fmu run --exact`) from poor surrogates, of {learnt} solves each, of a building of two
storeys. Means and standard deviations are compared with quadrature; the larger error of both parameters is given.
Those of the draws are averages over {seeds} seeds, and the standard error is that of the average. The gate is
{z} standard errors.

{table}
"""
_LIMITS = """## Limits of certificates

Surrogates of the known posteriors that had to end too early. Of many draws of each the errors are known, and with
them the *real error* of the posterior: that of means, in standard deviations, or of these, relative; the largest
over the parameters. A certificate sees 12 of the draws; 400 times 12 others were taken, as `fmu.surrogate` takes
them.

{table}
"""
_KILLS = """## Interrupted

A run of a function of half a second was killed {kills[kills]} times at random, with two workers, and resumed each
time. It took {kills[solves]} solves; {kills[twice]} of them were finished twice, and {kills[broken_off]} calls
were broken off by a kill.
"""
_SECOND = """## One second a solve

Three parameters, two workers: {solves} solves, {wall_s} s from the start of `fmu run` to the report, of which
{cpu_s} s of processor; certificate {shift} sd.
"""
