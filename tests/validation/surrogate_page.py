"""The page of surrogates, and whether its gates are passed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from fmu.numbers import significant, whole
from fmu.tables import markdown_table

MEAN, SD = 0.05, 0.05
FEWER = 50.0
HELD = 0.95
WALL_S = 60.0
_N_CASES = 4


def gates(known: Mapping[str, Any]) -> list[tuple[str, str, str, bool]]:
    """Return what was wanted, what was found, and whether that is enough."""
    found = []
    for case in (known[f"case {i}"] for i in range(_N_CASES)):
        found.append(
            (f"{case['name']}: solves", f"≤ {case['most']}", whole(case["solves"]), case["solves"] <= case["most"])
        )
        for words, key, most in (("means off, posterior sd", "mean", MEAN), ("sds off, relative", "sd", SD)):
            found.append((f"{case['name']}: {words}", f"≤ {most}", significant(case[key], 2), case[key] <= most))
        found.append(
            (f"{case['name']}: certificate", f"≤ {MEAN}", significant(case["shift"], 2), case["shift"] <= MEAN)
        )
        for sampler in ("mixture", "hmc"):
            times = case[sampler] / case["solves"]
            found.append(
                (
                    f"{case['name']}: times fewer solves than {sampler}",
                    f"≥ {FEWER:.0f}",
                    significant(times, 3),
                    times >= FEWER,
                )
            )
    held = share_held(known["budgets"])
    found.append(
        ("small budgets: reported error at least the real one", f"≥ {HELD}", significant(held, 3), held >= HELD)
    )
    kills = known["kills"]
    found.append(
        (f"killed {kills['kills']} times: solves done twice", "0", str(kills["twice"]), kills["twice"] == 0)
    )
    found.append(
        (f"killed {kills['kills']} times: exit code at the end", "0", str(kills["code"]), kills["code"] == 0)
    )
    slow = known["one second"]
    found.append(
        (
            "one second a solve, two workers: seconds",
            f"≤ {WALL_S:.0f}",
            significant(slow["wall_s"], 3),
            slow["wall_s"] <= WALL_S,
        )
    )
    found.append(
        (
            "one second a solve: exit code, converged and certified",
            "0",
            str(slow["code"]),
            slow["code"] == 0 and slow["shift"] <= MEAN,
        )
    )
    for name, one in known["awkward"].items():
        is_told = one["shift"] > MEAN or bool(one["told"])
        right = one["mean"] <= max(MEAN, one["shift"])
        found.append(
            (f"{name}: means off, posterior sd", "right or told", significant(one["mean"], 2), right or is_told)
        )
    return found


def share_held(budgets: Mapping[str, Sequence[float]]) -> float:
    """Return the share of the runs whose reported error is at least the real one."""
    return float(np.mean(np.array(budgets["reported"]) >= np.array(budgets["real"])))


def passed(known: Mapping[str, Any]) -> bool:
    """Say whether all gates are passed."""
    return all(gate[-1] for gate in gates(known))


def page(known: Mapping[str, Any]) -> str:
    """Return the page as Markdown."""
    rows = [(name, wanted, found, "yes" if met else "**no**") for name, wanted, found, met in gates(known)]
    missed = [row[0] for row in rows if row[3] != "yes"]
    verdict = "**All gates are passed.**" if not missed else f"**Missed: {'; '.join(missed)}.**"
    listed = [known[f"case {i}"] for i in range(_N_CASES)]
    table = [
        (
            case["name"], whole(case["parameters"]), whole(case["solves"]), significant(case["mean"], 2),
            significant(100 * case["sd"], 2), significant(case["noise"], 2), significant(case["shift"], 2),
            whole(round(case["mixture"])), whole(round(case["hmc"])), significant(case["learning_s"], 2),
        )
        for case in listed
    ]  # fmt: skip
    awkward = [
        (
            name, whole(one["solves"]), significant(one["mean"], 2), significant(100 * one["sd"], 2),
            significant(one["shift"], 2), significant(one["scatter"], 2), one["told"] or "–",
        )
        for name, one in known["awkward"].items()
    ]  # fmt: skip
    budgets, kills, slow = known["budgets"], known["kills"], known["one second"]
    reported, real = np.array(budgets["reported"]), np.array(budgets["real"])
    ratio = real / reported
    return "\n".join(
        [
            "# Surrogates of slow models",
            "",
            "Written by `python -m tests.validation.surrogate results`; every number is computed. `fmu.surrogate` lets",
            "Gaussian processes stand for a function, learnt from few solves, and certifies them by further ones.",
            "",
            verdict,
            "",
            markdown_table(("gate", "wanted", "found", "met"), rows),
            "",
            "## Known posteriors",
            "",
            "Each structure as a function that gives frequencies and nothing else. Its posterior by the surrogate is",
            "compared with the exact one by the structure's matrices, both from long runs; their Monte-Carlo error is",
            "given. Solves of the mixture and of HMC are those from the start of warm-up to an ESS of 400, whose error of",
            "a mean is 0.05 sd; the search for maxima comes on top. A gradient of HMC is by differences, as a function",
            "has no other. [whole-runs.md](whole-runs.md) has emcee and nautilus on cantilever-young by shape: 91 962",
            "evaluations of warm-up of emcee, and 60 900 and 212 500 of nautilus, before either has its first draw to use.",
            "",
            markdown_table(
                (
                    "posterior",
                    "parameters",
                    "solves",
                    "means off, sd",
                    "sds off, %",
                    "Monte-Carlo error, sd",
                    "certificate, sd",
                    "solves of the mixture",
                    "of HMC",
                    "learning, s of processor",
                ),
                table,
            ),
            "",
            "## Awkward functions",
            "",
            "A building of two storeys, whose posterior is known by quadrature.",
            "",
            markdown_table(
                (
                    "function",
                    "solves",
                    "means off, sd",
                    "sds off, %",
                    "certificate, sd",
                    "scatter estimated",
                    "told",
                ),
                awkward,
            ),
            "",
            "## Small budgets",
            "",
            f"{len(real)} buildings with random stiffnesses and errors of measurement, each with 10 solves to learn from",
            f"and 12 to check. The error reported is at least the real one in {100 * share_held(budgets):.1f} %. Real errors",
            f"are {significant(float(np.median(real)), 2)} sd in the median and {significant(float(np.max(real)), 2)} at most; real over",
            f"reported is {significant(float(np.median(ratio)), 2)} in the median and {significant(float(np.max(ratio)), 2)} at most.",
            "",
            "## Interrupted",
            "",
            f"A run of a function of half a second was killed {kills['kills']} times at random, with two workers, and resumed",
            f"each time. It took {kills['solves']} solves; {kills['twice']} of them were finished twice, and {kills['broken_off']} calls were broken",
            "off by a kill.",
            "",
            "## One second a solve",
            "",
            f"Three parameters, two workers: {slow['solves']} solves, {significant(slow['wall_s'], 3)} s from the start of `fmu run` to the",
            f"report, of which {significant(slow['cpu_s'], 3)} s of processor; certificate {significant(slow['shift'], 2)} sd.",
            "",
        ]
    )
