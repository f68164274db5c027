"""Write README.md, the page that summarises the results."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from fmu.numbers import fixed, share, significant, whole, with_interval
from fmu.paper.experiment import PAIRED_BY
from fmu.paper.findings import Findings, both_rates, judge, statement, to_converge
from fmu.paper.page import ENDS, JUDGED_BY, SOLVE, STARTS, TO_CONVERGE, WOULD_NEED, would_need
from fmu.paper.studies.vector_beta import RELATIVE, VectorBeta, outcome
from fmu.paper.studies.wrong_model import HOW_TO_READ, WrongModel, summary_table
from fmu.report.plots import TITLES
from fmu.tables import markdown_table

FILES = {
    "errata.md": "errors in the paper, found from its tables and the model",
    "recomputed.md, recomputed.csv": "the forty published frequencies, recomputed",
    "vector-beta.md, .csv, .png": "β as a vector, which the paper proposes but does not test",
    "model-error.md, .csv, .png": "a model that may be wrong: each mode predicted by the others, with and without",
    "*/tables.md": "one experiment with one pairing: the paper's tables beside ours, convergence, cost, maxima",
    "*/parameters.csv, */frequencies.csv, */comparison.csv, */maxima.csv": "the same numbers, SI units, in full",
    "*/trace-*.png, */corner-*.png, */frequencies-*.png": "paths, posterior and frequency errors of each sampler",
    "*/convergence.png": "error of the mean against model solves, all samplers",
    "*/report/index.html": "a report on the long runs, to open in a browser",
    "traces/*.nc": "the traces (ArviZ, netCDF); made by the command, not kept in git",
    "manifest.json": "what the command wrote: the next run replaces these files and nothing else",
}


def summary_page(everything: Sequence[Findings], recomputed: str, seed: int, versions: Mapping[str, str]) -> str:
    """Return the Markdown text of results/README.md.

    Parameters
    ----------
    everything : sequence of Findings
        The findings from all experiments.
    recomputed : str
        A phrase on the number of published frequencies reproduced (`fmu.paper.errata.count_reproduced`).
    seed : int
    versions : mapping of str to str
        Version of each software package, keyed by its name.
    """
    parts = [
        "# Results\n",
        "Both experiments of Boulkaibet, Marwala, Mthembu, Friswell & Adhikari, *Sampling Techniques in "
        "Bayesian Finite Element Model Updating*, repeated. Written by `fmu paper`; every number is computed.\n",
        f"- {recomputed} ([recomputed.md](recomputed.md)). [errata.md](errata.md) lists the errors of the paper.\n"
        + "".join(f"- [{f.name}]({f.name}/tables.md): {_in_a_line(f)}\n" for f in everything),
        "## Posterior means\n",
    ]
    for findings in everything:
        parts += [_means(findings)]
    parts += ["## What a converged run costs\n", _costs(everything)]
    parts += ["## Which sampler draws most per solve\n"]
    parts += [
        "Effective draws: smallest bulk ESS over the parameters. Solves: of the long run, a gradient at what it "
        "costs. Samplers are ranked without the warm-up, whose length was chosen beforehand for each.\n"
    ]
    parts += [statement(findings).strip() + "\n" for findings in everything]
    parts += ["### Against the paper's conclusions\n", _claims(everything)]
    studies = [findings.weighted for findings in everything if findings.weighted is not None]
    if studies:
        parts += ["## A β for every mode\n", _remark(studies)]
    wrong = [findings.wrong for findings in everything if findings.wrong is not None]
    if wrong:
        parts += ["## With a model that may be wrong\n", _wrong(wrong)]
    parts += ["## Files\n", markdown_table(("file", "what it is"), FILES.items(), words=(0, 1))]
    parts += ["## How it was made\n", _how(seed, versions)]
    return "\n".join(parts)


def _in_a_line(findings: Findings) -> str:
    done = [TITLES[s] for s in findings.comparison.index if findings.is_converged(s)]
    open_ = [TITLES[s] for s in findings.comparison.index if not findings.is_converged(s)]
    words = f"section {findings.published.section}, paired {PAIRED_BY[findings.pairing]}. "
    words += f"Converged: {', '.join(done) or 'none'}"
    return words + (f"; not converged: {', '.join(open_)}." if open_ else ".")


def _means(findings: Findings) -> str:
    """Return a heading and a table of parameter values in the paper's units.

    The table has one row for each point, published mean or run, and one column for each parameter.
    """
    names = list(findings.parameters.index)
    units = [findings.unit_of_paper(name) for name in names]

    def row(words: str, column: str) -> list[str]:
        return [words, *(fixed(findings.in_paper_units(n, column)[0], 3) for n in names)]

    rows = [row("start", "published_initial")]
    if findings.published.columns["initial"].corrected_parameters:
        rows[0][0] = "start, as printed (see the errata)"
    rows += [row("maximum of the posterior", "maximum")]
    for name in findings.comparison.index:
        if f"published_{name}" in findings.parameters:
            rows.append(row(f"{TITLES[name]}, published", f"published_{name}"))
            rows.append(row(f"{TITLES[name]}, the paper's protocol, ours", f"paper_{name}"))
        verdict = "converged" if findings.is_converged(name) else "not converged"
        cells = []
        for n in names:
            mean, low, high = findings.in_paper_units(n, *(f"long_{name}_{end}" for end in ("mean", *ENDS)))
            cells.append(with_interval(mean, low, high, 3))
        rows.append([f"**{TITLES[name]}, long run ({verdict})**", *cells])
    if not any(map(findings.is_converged, findings.comparison.index)):
        rows.append(row(f"*{findings.origin}*", "reference_mean"))
    header = ["", *(f"{n}, {u[1]}" for n, u in zip(names, units, strict=True))]
    return f"### Section {findings.published.section}, paired {PAIRED_BY[findings.pairing]}\n\n" + markdown_table(
        header, rows
    )


def _costs(everything: Sequence[Findings]) -> str:
    rows = []
    for findings in everything:
        for name in findings.comparison.index:
            rows.append((
                findings.name, TITLES[name], "yes" if findings.is_converged(name) else "**no**",
                significant(findings.value(name, "gradient_cost"), 2),
                *_to_converge(findings, name), both_rates(findings, name),
                whole(findings.value(name, "paper_solves")), fixed(findings.value(name, "paper_error"), 1),
                would_need(findings, name),
            ))  # fmt: skip
    header = (
        "experiment", "sampler", "converged", "a gradient costs, solves", "samples to converge",
        "solves to converge", "seconds to converge", "ESS per solve", "the paper's protocol: solves",
        "its worst mean, sd off", "would need",
    )  # fmt: skip
    return (
        "The paper's protocol is one chain of 1000 samples, which no test can call converged. *sd off*: "
        "distance of its worst mean from the reference, in posterior standard deviations. Its step sizes and "
        "widths, which the paper does not state, are chosen by hand. HMC takes central "
        "differences there, as the paper does, and exact gradients in the long runs. "
        f"{STARTS}{SOLVE}{TO_CONVERGE}"
        f"{WOULD_NEED}\n\n" + markdown_table(header, rows, words=(0, 1, 2))
    )


def _to_converge(findings: Findings, sampler: str) -> list[str]:
    """Return the texts of `to_converge`, with a bound of the solves of a run that has not converged."""
    samples, solves, seconds = to_converge(findings, sampler)
    is_open = not findings.is_converged(sampler)
    return [samples, f"more than {whole(findings.value(sampler, 'n_solves'))}" if is_open else solves, seconds]


def _claims(everything: Sequence[Findings]) -> str:
    rows = [
        (f"{findings.published.section}, {PAIRED_BY[findings.pairing]}", *j)
        for findings in everything
        for j in judge(findings)
    ]
    return (
        f"{JUDGED_BY}\n"
        + markdown_table(("experiment", "the paper", "by", "verdict", "figures"), rows, words=range(5))
        + "\nThe paper also compares its samplers by how well their means fit the data. Samplers of one "
        "posterior have one mean: where their tables differ by more than Monte-Carlo error, a run was too "
        "short, or sat in another mode.\n"
    )


def _remark(studies: Sequence[VectorBeta]) -> str:
    return (
        "The paper blames the one β for the error of mode 1, and expects a vector to lower it (section 5.1). With "
        f"σ = {share(RELATIVE)} of each measured frequency, sampled by HMC ([vector-beta.md](vector-beta.md)):\n\n"
        + "".join(f"- {outcome(study)}\n" for study in studies)
    )


def _wrong(studies: Sequence[WrongModel]) -> str:
    return (
        "The data contradict the model. Here its parameters may scatter from mode to mode, by an inferred share τ "
        f"([model-error.md](model-error.md)). {HOW_TO_READ}\n\n" + summary_table(studies)
    )


def _how(seed: int, versions: Mapping[str, str]) -> str:
    listed = ", ".join(f"{name} {version}" for name, version in versions.items())
    return (
        "```\nmake paper        # sets up .venv and runs the next line\nfmu paper --out results\n```\n\n"
        f"Seed {seed}; {listed}. The same versions on the same kind of machine give the same draws, bit for "
        "bit; times differ.\n"
    )
