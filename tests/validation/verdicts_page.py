"""The page of the study of verdicts."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from fmu.analysis.evidence import OF_MIXTURE
from fmu.numbers import significant
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
    converged, alone = study.converged, study.alone
    rejected = [one for one in study.judged if not one.converged]
    means, variances = (_all(converged, which) for which in ("of_means", "of_variances"))
    (directory / "verdicts.md").write_text(
        PAGE.format(
            minutes=sum(one.processor_s for one in study.outcomes) / 60.0,
            progress=_progress(len(study.outcomes), len(list(jobs()))),
            verdict=verdict(study),
            fewest=FEWEST_RUNS,
            judged=len(study.judged),
            chains=CHAINS,
            wrong=WRONG,
            lengths="\n".join(f"- {_length(name)}" for name in LENGTHS),
            most=100 * study.most_wrong,
            converged=len(converged),
            means=len(means),
            freedom=study.freedom,
            rms=np.sqrt(np.mean(means**2)),
            expected_rms=np.sqrt(study.freedom / (study.freedom - 2.0)) if np.isfinite(study.freedom) else 1.0,
            rms_variances=np.sqrt(np.mean(variances**2)),
            beyond=", ".join(
                f"{np.sum(np.abs(means) > limit)} exceed {limit:g} (expected {study.expected_beyond(limit):.2g})"
                for limit in (2.0, 3.0, WRONG)
            ),
            worst=np.max(np.abs(means)),
            worst_variance=np.max(np.abs(variances)),
            beyond_variances=int(np.sum(np.abs(variances) > WRONG)),
            rejected=len(rejected),
            rejected_wrong=sum(not one.worst <= WRONG for one in rejected),
            rejected_worst=significant(
                max((one.worst for one in rejected if np.isfinite(one.worst)), default=np.nan), 2
            ),
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


def _progress(runs: int, planned: int) -> str:
    """Return a clause with the number of runs if some of the planned runs are missing, otherwise nothing."""
    return "" if runs >= planned else f"; {runs} of its {planned} runs are done"


def verdict(study: Study) -> str:
    """Return the verdict of the page."""
    if study.failures:
        return "**Gates that fail:**\n\n" + "\n".join(f"- {failure}" for failure in study.failures)
    return (
        f"**0 of {len(study.converged)} runs that were reported as converged have a mean that is off by more than "
        f"{WRONG:g} Monte-Carlo standard errors (MCSE)**. They come from {len(study.judged)} runs. The last "
        f"section reports {len(study.alone)} further runs, on densities with separated maxima."
    )


def _all(outcomes: Iterable[Outcome], which: str) -> FloatArray:
    return np.array([error for one in outcomes for error in getattr(one, which)])


def _length(name: str) -> str:
    warmup, draws, until, *_ = LENGTHS[name]
    goal = f", extended until converged with an ESS of {until:g}, at most to 32 times as many" if until else ""
    return f"*{name}*: {warmup} steps of warm-up, {draws} draws{goal}"


def _cell(outcomes: list[Outcome]) -> str:
    """Return how many runs were reported as converged, with their largest errors of a mean and of a variance."""
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
    return markdown_table(["posterior", "difficulty", "parameters", *samplers], rows, words=(0, 1)).rstrip()


def _evidences(study: Study) -> str:
    """Return the table of errors of log-evidences of converged runs, in standard errors."""
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
        "sampler", "method", "converged runs", "with a warning", "rms error", "largest error",
        f"errors above {WRONG:g}",
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
        "sampler", "length", "runs", "converged", "wrong", "rms error", "largest error",
        f"not converged, error above {WRONG:g}",
    ]  # fmt: skip
    return markdown_table(head, rows, words=(0, 1)).rstrip()


def _separated(study: Study) -> str:
    rows = []
    names = {one.name for one in study.outcomes}
    for known in (*KNOWN, *FURTHER):
        if known.name not in names or known.one_place is None:
            continue
        usual = "around all maxima" if known.is_searched else "default"
        for start, where in ((USUAL, usual), (ALL, "around all maxima"), (ONE_PLACE, "at one maximum")):
            runs = [one for one in study.outcomes if (one.name, one.start) == (known.name, start)]
            if runs:
                cells = [_judged([one for one in runs if one.sampler == sampler]) for sampler in NAMES]
                told = known.is_searched or start == ALL
                rows.append([known.name, "yes" if told else "no", where, *cells])
    return markdown_table(["posterior", "maxima known", "start", *NAMES], rows, words=(0, 1, 2)).rstrip()


def _judged(runs: list[Outcome]) -> str:
    """Return how many runs were reported as converged, and how many of these are wrong."""
    if not runs:
        return "-"
    wrong = sum(one.is_wrong for one in runs)
    return f"{sum(one.converged for one in runs)} of {len(runs)}{f', {wrong} wrong' if wrong else ''}"


PAGE = """# Are runs that are reported as converged correct?

If fmu reports a run as converged, are its posterior means correct within their Monte-Carlo standard errors?

{verdict}

A run is *wrong* if it is reported as converged and the mean of a parameter is off by more than {wrong:g} times the
MCSE that `fmu.summary` gives. All samplers run with default settings and {chains} chains (emcee: {chains}
ensembles) on posteriors of two and three parameters (`tests/validation/known.py`). Their means and variances are
known by Gauss–Legendre quadrature. The samplers with mixture proposals (the mixture sampler, and mh, slice and hmc
with jumps) also run on posteriors of up to ten parameters, known by formula. The verdict on a run is that of
`fmu.diagnose`, as in every report. The study fails if one run is wrong, or with fewer than {fewest} runs or fewer
than {fewest_with_candidates} runs with mixture proposals (here {with_candidates}, of which
{with_candidates_converged} converged). The study took {minutes:.0f} minutes of processor time{progress}.

The runs have three lengths:

{lengths}

*until good* is the severest test: the verdict is checked repeatedly, and the run ends at the first good verdict.

## Results

- {converged} of {judged} runs were reported as converged. At most {most:.2g} % of such runs are wrong (95 % upper
  confidence limit).
- The {means} means of these runs have a root-mean-square (rms) error of {rms:.2f} MCSE (expected
  {expected_rms:.2f}) and a largest error of {worst:.1f} MCSE. Of the errors, {beyond}.
  The expected values assume correct runs and allow for the error of the MCSE itself: it varies between seeds like
  a standard deviation with {freedom:.0f} degrees of freedom, so errors in MCSE follow Student's t.
- Their variances, computed as means of (x − μ)² about the exact mean μ, have an rms error of {rms_variances:.2f}
  MCSE and a largest error of {worst_variance:.1f} MCSE; {beyond_variances} errors exceed {wrong:g}. The MCSE of a
  squared deviation is less accurate than that of a mean, especially for heavy tails.
- {rejected} runs were not reported as converged. In {rejected_wrong} of them a mean is off by more than {wrong:g}
  MCSE, at most by {rejected_worst}.

In the tables, "7 of 8: 2.1; 2.9" means that 7 of 8 runs were reported as converged, with errors of at most 2.1
MCSE in the means and 2.9 MCSE in the variances.

{targets}

{further}

By sampler and length, with errors of means in MCSE:

{samplers}

## Evidence

The table gives errors of the log-evidence of converged runs, divided by the standard errors from `fmu.evidence`.
The reference is the quadrature or the formula. Estimates with a warning are left out.

{evidences}

## Separated maxima that the search does not exclude

If chains do not cross between the maxima of a posterior, draws that miss a maximum look as good as draws from all
of them. fmu therefore searches for the maxima of every density and compares the draws with them. If the search
cannot exclude further maxima of a plain log-density, a run is reported as "converged locally". The {alone} runs
below are such runs on densities with separated maxima; they are not counted above. {alone_converged} of them were
reported as converged, of which {alone_wrong} are wrong. Of these {alone_wrong}, {alone_told} were reported as
"converged locally"; the study fails if one was not.

Mixture proposals were used in {alone_candidates_wrong} of the wrong runs. In {alone_candidates_seen} of these,
every maximum had been visited by a chain, during warm-up or later. A mixture must not lose a maximum that a chain
has visited: one such run makes the study fail.

In the table, "maxima known" states whether the verdict knew all maxima. With the start "default", `fmu.sample`
chose the starting points. "4 of 9, 2 wrong" means that 4 of 9 runs were reported as converged and 2 of these are
wrong.

{separated}

- **Give fmu the updating problem** rather than its log-density: the search can then exclude further maxima.
- **With a log-density only, start the chains wherever the posterior may be, not at one maximum**, and use more
  than four chains. Chains at different maxima disagree and are detected; chains at the same maximum are not.
- **Parallel tempering** can move between maxima; {tempered_wrong} of its {tempered} converged runs above were
  wrong. A maximum with a few percent of the probability is visited rarely, and the MCSE does not account for it
  until it has been visited often.
"""
