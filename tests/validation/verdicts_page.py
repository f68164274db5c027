"""The page of the study of verdicts."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from fmu.analysis.evidence import OF_MIXTURE
from fmu.tables import markdown_table
from fmu.types import FloatArray
from tests.validation.known import FURTHER, KNOWN, Known
from tests.validation.verdicts import (
    ALL,
    CHAINS,
    FEWEST_RUNS,
    FEWEST_WITH_CANDIDATES,
    LENGTHS,
    NAMES,
    ONE_PLACE,
    USUAL,
    WITH_CANDIDATES,
    WRONG,
    Outcome,
    Study,
    jobs,
)


def write(study: Study, directory: Path) -> None:
    """Write ``verdicts.md`` into the directory."""
    directory.mkdir(parents=True, exist_ok=True)
    converged, alone = study.converged, study.alone
    rejected = [one for one in study.judged if not one.converged]
    means, variances = (_all(converged, which) for which in ("of_means", "of_variances"))
    (directory / "verdicts.md").write_text(
        PAGE.format(
            minutes=sum(one.processor_s for one in study.outcomes) / 60.0,
            command=_command(len(study.outcomes), len(list(jobs()))),
            verdict=verdict(study),
            runs=len(study.outcomes),
            fewest=FEWEST_RUNS,
            judged=len(study.judged),
            chains=CHAINS,
            wrong=WRONG,
            lengths="\n".join(f"- {_length(name)}" for name in LENGTHS),
            most=100 * study.most_wrong,
            converged=len(converged),
            means=len(means),
            freedom=study.freedom,
            expected=study.expected_beyond(WRONG),
            rms=np.sqrt(np.mean(means**2)),
            expected_rms=np.sqrt(study.freedom / (study.freedom - 2.0)) if np.isfinite(study.freedom) else 1.0,
            rms_variances=np.sqrt(np.mean(variances**2)),
            beyond=", ".join(
                f"{np.sum(np.abs(means) > limit)} above {limit:g} (expected {study.expected_beyond(limit):.2g})"
                for limit in (2.0, 3.0, WRONG)
            ),
            worst=np.max(np.abs(means)),
            worst_variance=np.max(np.abs(variances)),
            beyond_variances=int(np.sum(np.abs(variances) > WRONG)),
            rejected=len(rejected),
            rejected_wrong=sum(not one.worst <= WRONG for one in rejected),
            rejected_worst=max((one.worst for one in rejected if np.isfinite(one.worst)), default=np.nan),
            targets=_targets(study, KNOWN, NAMES),
            further=_targets(study, FURTHER, WITH_CANDIDATES),
            evidences=_evidences(study),
            fewest_with_candidates=FEWEST_WITH_CANDIDATES,
            with_candidates=sum(one.sampler in WITH_CANDIDATES for one in study.judged),
            with_candidates_converged=sum(one.sampler in WITH_CANDIDATES for one in converged),
            samplers=_samplers(study),
            alone=len(alone),
            alone_converged=sum(one.converged for one in alone),
            alone_wrong=sum(one.is_wrong for one in alone),
            alone_candidates_wrong=sum(one.is_wrong and one.sampler in WITH_CANDIDATES for one in alone),
            alone_candidates_seen=sum(
                one.is_wrong and one.been_everywhere and one.sampler in WITH_CANDIDATES for one in alone
            ),
            alone_told=sum(one.is_wrong and one.told for one in alone),
            tempered=sum(one.converged for one in alone if one.sampler == "tempering"),
            tempered_wrong=sum(one.is_wrong for one in alone if one.sampler == "tempering"),
            separated=_separated(study),
        ),
        encoding="utf-8",
    )


def _command(runs: int, planned: int) -> str:
    """Return what writes the page, and where there are fewer runs than there should be, that there are."""
    return "`make validate`" if runs >= planned else f"`make validate`, with {runs} of its {planned} runs so far,"


def verdict(study: Study) -> str:
    """Return the verdict of the page."""
    if study.failures:
        return "**Gates that fail:**\n\n" + "\n".join(f"- {failure}" for failure in study.failures)
    return (
        f"**0 of {len(study.converged)} runs that were called converged have a mean that is off by more than "
        f"{WRONG:g} Monte-Carlo standard errors** ({len(study.judged)} runs; {len(study.alone)} others below)."
    )


def _all(outcomes: Iterable[Outcome], which: str) -> FloatArray:
    return np.array([error for one in outcomes for error in getattr(one, which)])


def _length(name: str) -> str:
    warmup, draws, until, *_ = LENGTHS[name]
    goal = (
        f"then until the verdict is good with an ESS of {until:g}, for at most 32 times as many" if until else ""
    )
    return f"*{name}*: {warmup} steps of warm-up, {draws} draws{f', {goal}' if goal else ''}"


def _cell(outcomes: list[Outcome]) -> str:
    """Say how many runs were called converged, and the worst error of a mean and of a variance of these."""
    good = [one for one in outcomes if one.converged]
    if not outcomes:
        return "-"
    worst = (
        "; ".join(f"{np.max(np.abs(_all(good, of))):.1f}" for of in ("of_means", "of_variances")) if good else ""
    )
    return f"{len(good)} of {len(outcomes)}{f': {worst}' if good else ''}"


def _targets(study: Study, of: Iterable[Known], samplers: Iterable[str]) -> str:
    rows = [
        [known.name, known.kind, str(known.density.ndim)]
        + [
            _cell([one for one in study.judged if (one.name, one.sampler) == (known.name, sampler)])
            for sampler in samplers
        ]
        for known in of
        if any(one.name == known.name for one in study.judged)
    ]
    return markdown_table(["posterior", "what is hard", "parameters", *samplers], rows, words=(0, 1)).rstrip()


def _evidences(study: Study) -> str:
    """Return errors of the log-evidences of runs that were called converged, in their standard errors."""
    rows = []
    for sampler in WITH_CANDIDATES:
        good = [one for one in study.converged if one.sampler == sampler]
        z = np.array([one.of_evidence for one in good if len(one.of_evidence) == 2]).reshape(-1, 2)
        for k, method in enumerate(OF_MIXTURE):
            size = np.abs(z[:, k])
            rows.append([
                sampler,
                method,
                str(len(good)),
                str(len(good) - len(z)),
                f"{np.sqrt(np.mean(size**2)):.2f}" if len(z) else "-",
                f"{np.max(size):.1f}" if len(z) else "-",
                str(int(np.sum(size > WRONG))),
            ])  # fmt: skip
    head = [
        "sampler", "evidence by", "converged runs", "of these with a warning", "root mean square of errors",
        "worst error", f"above {WRONG:g}",
    ]  # fmt: skip
    return markdown_table(head, rows, words=(0, 1)).rstrip()


def _samplers(study: Study) -> str:
    rows = []
    for sampler in NAMES:
        for length in LENGTHS:
            runs = [one for one in study.judged if (one.sampler, one.length) == (sampler, length)]
            if not runs:
                continue
            good = [one for one in runs if one.converged]
            bad = [one for one in runs if not one.converged]
            errors = _all(good, "of_means")
            rows.append([
                sampler,
                length,
                str(len(runs)),
                str(len(good)),
                str(sum(one.is_wrong for one in good)),
                f"{np.sqrt(np.mean(errors**2)):.2f}" if good else "-",
                f"{np.max(np.abs(errors)):.1f}" if good else "-",
                f"{sum(not one.worst <= WRONG for one in bad)} of {len(bad)}",
            ])  # fmt: skip
    head = [
        "sampler", "length", "runs", "converged", "of these wrong", "root mean square of errors", "worst error",
        f"not converged, and off by more than {WRONG:g}",
    ]  # fmt: skip
    return markdown_table(head, rows, words=(0, 1)).rstrip()


def _separated(study: Study) -> str:
    rows = []
    names = {one.name for one in study.outcomes}
    for known in (*KNOWN, *FURTHER):
        if known.name not in names or known.one_place is None:
            continue
        usual = "around all maxima" if known.is_searched else "anywhere in the box"
        for start, where in ((USUAL, usual), (ALL, "around all maxima"), (ONE_PLACE, "at one maximum")):
            runs = [one for one in study.outcomes if (one.name, one.start) == (known.name, start)]
            if runs:
                cells = [_judged([one for one in runs if one.sampler == sampler]) for sampler in NAMES]
                told = known.is_searched or start == ALL
                rows.append([known.name, "yes" if told else "no", where, *cells])
    return markdown_table(["posterior", "maxima known", "start", *NAMES], rows, words=(0, 1, 2)).rstrip()


def _judged(runs: list[Outcome]) -> str:
    """Say how many runs were called converged, and how many of these are wrong."""
    if not runs:
        return "-"
    wrong = sum(one.is_wrong for one in runs)
    return f"{sum(one.converged for one in runs)} of {len(runs)}{f', {wrong} wrong' if wrong else ''}"


PAGE = """# Is a run that is called converged right?

Written by {command} in {minutes:.0f} minutes of processor time.

{verdict}

All samplers, with default settings, {chains} chains (of emcee, ensembles), on posteriors of two and three
parameters whose means and variances are known by quadrature: Gauss–Legendre in every cell of a grid that holds
anything (`tests/validation/known.py`); the mixture sampler, and mh, slice and hmc with jumps, also on posteriors
of up to ten parameters with a formula. A run is judged by `fmu.diagnose`, as every page and command judges it.
It is *wrong* if it is called converged and the mean of a parameter is off by more than {wrong:g} times the
Monte-Carlo standard error that `fmu.summary` gives. The page turns red if one run is wrong, or if there are
fewer than {fewest} runs, or fewer than {fewest_with_candidates} of samplers with candidates of a mixture: here
{with_candidates}, of which {with_candidates_converged} were called converged.

{lengths}

The second looks at the verdict again and again, and stops when it likes it: the hardest test of a verdict.

## What was found

- {converged} of {judged} runs were called converged. Wrong are at most {most:.2g} % of such runs, with 95 %
  confidence.
- The {means} means of these runs are off by {rms:.2f} MCSE in the root mean square (expected
  {expected_rms:.2f}), {worst:.1f} at the most: {beyond}. "Expected" is of a right verdict with MCSE that are
  themselves estimated: their logarithm scatters from seed to seed like that of a standard deviation of
  {freedom:.0f} degrees of freedom, so that errors over MCSE follow Student's t, whose tail beyond {wrong:g}
  holds {expected:.1g} of as many means.
- Their variances, as means of (x − μ)², are off by {rms_variances:.2f} MCSE in the root mean square and
  {worst_variance:.1f} at the most; {beyond_variances} by more than {wrong:g}. The MCSE of a squared deviation is
  known less well than that of a mean, least in heavy tails.
- Of the {rejected} runs that were not called converged, {rejected_wrong} have a mean that is off by more than
  {wrong:g} MCSE, up to {rejected_worst:.3g}: what the verdict holds back.

In the table "7 of 8: 2.1; 2.9" stands for 7 of 8 runs called converged, whose means are off by 2.1 MCSE at the
most, and their variances by 2.9.

{targets}

{further}

Errors are of means, in MCSE:

{samplers}

## Evidence

Errors of the log-evidence of runs that were called converged, in the standard errors that `fmu.evidence` gives
with it, against the quadrature or the formula; only where it gives no warning.

{evidences}

## Maxima that no draw can tell of

Where a posterior has maxima that chains do not cross between, draws that never were at one of them look as good
as draws from all of them. fmu searches for the maxima of every density, and compares the draws with them. Where
the search of a plain log-density does not exclude others, a run on it is called "converged locally". {alone} runs
below are such runs on plain densities with separated maxima: {alone_converged} are called converged, {alone_wrong}
of them are wrong, and {alone_told} of these {alone_wrong} say "locally". They are not counted above. The page
turns red if one of them does not say so.
{alone_candidates_wrong} of the wrong ones are of samplers with candidates of a mixture. In
{alone_candidates_seen} of these a chain had been at every maximum, in warm-up or after it: a mixture must not lose
what a chain has found, and one such run turns the page red.

{separated}

- **Start where the posterior may be, not at one maximum of it**, and use more than four chains, where there is
  nothing but a log-density. Chains in different maxima disagree, and are found out; chains in the same one are
  not.
- **Tempering** starts its replicas anywhere in the prior: {tempered_wrong} of its {tempered} converged runs went
  wrong. A maximum of a few percent is seldom visited, and until it was visited often no MCSE knows what it is
  worth.
- **Give fmu the updating problem** and not its log-density: then the search decides.
"""
