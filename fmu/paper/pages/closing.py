"""The pages that look at all experiments together."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from fmu.numbers import fixed, share
from fmu.paper.findings import Findings
from fmu.paper.pages.summary_page import summary_page
from fmu.paper.pages.vector_beta_page import plot_vector_beta, vector_beta_page
from fmu.paper.plan import Plan
from fmu.paper.published.errata import Erratum, computed_errata, errata_page
from fmu.paper.published.recomputed import recompute, recomputed_page
from fmu.paper.published.tables import EXPERIMENTS
from fmu.paper.vector_beta import VectorBeta
from fmu.report.plots import DPI


def write_closing_pages(everything: Sequence[Findings], plan: Plan, stage: Path) -> None:
    """Write README.md, errata.md, the recomputed frequencies and the study with a vector β."""
    from fmu import cases
    from fmu.analysis.trace.provenance import versions

    by_number, by_shape = (
        {case: cases.load(case, pairing) for case in EXPERIMENTS} for pairing in ("index", "shape")
    )
    recomputed = recompute(by_number)
    recomputed.to_csv(stage / "recomputed.csv", index=False)
    errata = computed_errata(by_number, by_shape, plan.box_points)
    errata += [erratum for findings in everything for erratum in separated_modes(findings)]
    passed = int(recomputed["within"].sum()), len(recomputed)
    pages = {
        "recomputed.md": recomputed_page(recomputed),
        "errata.md": errata_page(errata),
        "README.md": summary_page(everything, passed, plan.seed, versions()),
    }
    for name, text in pages.items():
        (stage / name).write_text(text, encoding="utf-8")
    _write_vector_beta([f.weighted for f in everything if f.weighted is not None], stage)


def _write_vector_beta(studies: Sequence[VectorBeta], stage: Path) -> None:
    """Write page, table and figure of the study with a β for every mode, if there was one."""
    if not studies:
        return
    import pandas as pd

    (stage / "vector-beta.md").write_text(vector_beta_page(studies), encoding="utf-8")
    table = pd.concat({study.name: study.modes for study in studies}, names=["experiment"])
    table.to_csv(stage / "vector-beta.csv")
    plot_vector_beta(studies).savefig(stage / "vector-beta.png", dpi=DPI)


def separated_modes(findings: Findings) -> Iterator[Erratum]:
    """Say that samplers cannot be compared on a posterior whose modes they do not all find."""
    maxima = findings.separate_maxima
    if findings.pairing != "index" or len(maxima) < 2:
        return
    top = maxima["log_prob"].iloc[0]
    heights = "; ".join(
        f"number {row.Index} with modes {row.modes}" + (f", {fixed(top - row.log_prob, 1)} lower" if k else "")
        for k, row in enumerate(maxima.itertuples())
    )
    missed = findings.never_visited
    yield Erratum(
        f"Section {findings.published.section}, comparison of the samplers",
        "one posterior, sampled by all",
        f"paired by number the posterior has {len(maxima)} separated maxima: {heights}; number 1 holds "
        f"{share(maxima['share'].iloc[0])} of the probability",
        f"ascents from {int(findings.maxima['starts'].sum())} points; of our {len(findings.comparison)} long "
        f"runs, started from the prior, {len(missed)} never came near number 1",
    )
