"""The command `fmu paper`, which runs the experiments in parallel processes and writes the results."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from fmu.analysis.trace.conversion import save_trace
from fmu.analysis.trace.provenance import versions
from fmu.engines import default_workers, engine
from fmu.engines.blas import single_thread
from fmu.numbers import fixed, share
from fmu.paper.errata import Erratum, computed_errata, count_reproduced, errata_page, recompute, recomputed_page
from fmu.paper.experiment import Result, compute, directory_of
from fmu.paper.figures import write_figures
from fmu.paper.findings import Findings
from fmu.paper.page import experiment_page
from fmu.paper.plan import PAPER_SAMPLERS, SAMPLERS, Plan
from fmu.paper.published import EXPERIMENTS
from fmu.paper.studies import wrong_model
from fmu.paper.studies.vector_beta import (
    SAMPLER,
    VectorBeta,
    plot_vector_beta,
    sample_weighted,
    side_by_side,
    vector_beta_page,
)
from fmu.paper.studies.wrong_model import WrongModel, plot_wrong_model, study_wrong_model, wrong_model_page
from fmu.paper.summary import summary_page
from fmu.progress import Report
from fmu.report.files import OutputDirectory
from fmu.report.pages import FOLDER, write_pages
from fmu.report.plots import DPI

if TYPE_CHECKING:
    import xarray as xr


TABLES = ("parameters", "frequencies", "comparison", "maxima")
FIGURES = ("trace", "corner", "frequencies")


def run_paper(
    out: str | os.PathLike[str],
    progress: Report | None = None,
    plan: Plan | None = None,
    workers: int | None = None,
) -> None:
    """Repeat both experiments of the paper with both pairings and write the results.

    Parameters
    ----------
    out : path-like
        Output directory. Only files that an earlier run wrote there are replaced or removed.
    progress : callable, optional
        Called as ``progress(phase, done, total, info)``, with one phase for each experiment, and for each run with
        a vector β or with scatter.
    plan : Plan, optional
        The experiments and the lengths of the runs. Defaults to ``Plan()``, the full replication.
    workers : int, optional
        Number of processes for the experiments. Defaults to the number of CPUs; with 1, only the current process
        is used. The results do not depend on this number.

    Raises
    ------
    ValueError
        If `out` is not a directory or has an invalid manifest, or the results would overwrite files that fmu did
        not write. This is checked before the computation.
    """
    plan = plan or Plan()
    directory = OutputDirectory(out)
    directory.check(file_names(plan))
    with directory.stage_files() as stage:
        # the experiments paired by number take longest, so they start first
        tasks = sorted(plan.experiments, key=_by_shape)
        with engine(min(default_workers() if workers is None else workers, len(tasks))) as pool:
            found = {f.name: f for f in pool.run_tasks(_one_of, (plan, stage), tasks, report=progress)}
        write_closing_pages([found[directory_of(*experiment)] for experiment in plan.experiments], plan, stage)


def _one_of(common: tuple[Plan, Path], experiment: tuple[str, str], progress: Report | None) -> Findings:
    return run_experiment(*experiment, *common, progress)


def run_experiment(case: str, pairing: str, plan: Plan, stage: Path, progress: Report | None) -> Findings:
    """Compute one experiment, write its results and traces below `stage`, and return its findings."""
    with single_thread():
        result = compute(case, pairing, plan, progress)
        weighted = _run_weighted(result, plan, stage, progress) if (case, pairing) in plan.weighted else None
        trace, wrong = study_wrong_model(result, plan, progress)
        _save(trace, f"{result.name}-{wrong_model.SAMPLER}-model-error.nc", stage)
        findings = Findings.of(result, weighted, wrong)
        write_experiment(result, findings, stage)
    return findings


def _run_weighted(result: Result, plan: Plan, stage: Path, progress: Report | None) -> VectorBeta:
    """Perform the run with a separate β for every mode, write its trace, and compare it with the scalar β."""
    trace = sample_weighted(result, plan, progress)
    _save(trace, f"{result.name}-{SAMPLER}-vector-beta.nc", stage)
    return side_by_side(result, trace)


def _save(trace: xr.DataTree, name: str, stage: Path) -> None:
    (stage / "traces").mkdir(parents=True, exist_ok=True)
    save_trace(trace, stage / "traces" / name)


def write_experiment(result: Result, findings: Findings, stage: Path) -> None:
    """Write one experiment's tables, figures and traces, and a report on its long runs, below `stage`."""
    directory = stage / findings.name
    directory.mkdir(parents=True, exist_ok=True)
    tables = findings.parameters, findings.frequencies, findings.comparison, findings.maxima
    for name, table in zip(TABLES, tables, strict=True):
        table.to_csv(directory / f"{name}.csv")
    (directory / "tables.md").write_text(experiment_page(findings), encoding="utf-8")
    write_figures(result, findings.frequencies, directory)
    write_pages(result.long, directory / FOLDER)
    for name, trace in _traces(result):
        _save(trace, name, stage)


def file_names(plan: Plan) -> list[str]:
    """Return the names of the files that the command may write, as paths relative to the output directory."""
    names = ["README.md", "errata.md", "recomputed.csv", "recomputed.md"]
    names += [f"model-error.{kind}" for kind in ("md", "csv", "png")]
    for name in (directory_of(*experiment) for experiment in plan.experiments):
        names += [f"{name}/tables.md", f"{name}/convergence.png"]
        names += [f"{name}/{table}.csv" for table in TABLES]
        names += [f"{name}/{figure}-{sampler}.png" for figure in FIGURES for sampler in SAMPLERS]
        names += [f"{name}/report/{page}.html" for page in ("index", *SAMPLERS)]
        names += [f"traces/{name}-{sampler}-paper.nc" for sampler in PAPER_SAMPLERS]
        names += [f"traces/{name}-{sampler}-long.nc" for sampler in SAMPLERS]
        names += [f"traces/{name}-hmc-one-start.nc", f"traces/{name}-{wrong_model.SAMPLER}-model-error.nc"]
    weighted = [directory_of(*experiment) for experiment in plan.experiments if experiment in plan.weighted]
    names += [f"traces/{name}-{SAMPLER}-vector-beta.nc" for name in weighted]
    return names + ([f"vector-beta.{kind}" for kind in ("md", "csv", "png")] if weighted else [])


def _by_shape(experiment: tuple[str, str]) -> bool:
    return experiment[1] == "shape"


def _traces(result: Result) -> Iterator[tuple[str, xr.DataTree]]:
    """Yield the file name and the trace for each saved run of an experiment; `Result.pace` is not saved."""
    for kind, traces in (("paper", result.paper), ("long", result.long), ("one-start", {"hmc": result.one_start})):
        for sampler, trace in traces.items():
            yield f"{result.name}-{sampler}-{kind}.nc", trace


def write_closing_pages(everything: Sequence[Findings], plan: Plan, stage: Path) -> None:
    """Write README.md, errata.md, the recomputed frequencies and the pages on both studies, below `stage`."""
    from fmu import cases

    by_number, by_shape = (
        {case: cases.load(case, pairing) for case in EXPERIMENTS} for pairing in ("index", "shape")
    )
    recomputed = recompute(by_number)
    recomputed.to_csv(stage / "recomputed.csv", index=False)
    errata = computed_errata(by_number, by_shape, plan.box_points)
    errata += [erratum for findings in everything for erratum in separated_modes(findings)]
    pages = {
        "recomputed.md": recomputed_page(recomputed),
        "errata.md": errata_page(errata, count_reproduced(recomputed)),
        "README.md": summary_page(everything, count_reproduced(recomputed), plan.seed, versions()),
    }
    for name, text in pages.items():
        (stage / name).write_text(text, encoding="utf-8")
    _write_vector_beta([f.weighted for f in everything if f.weighted is not None], stage)
    write_model_error([f.wrong for f in everything if f.wrong is not None], stage)


def write_model_error(studies: Sequence[WrongModel], stage: Path) -> None:
    """Write the page, table and figure on the experiments with a model that may be wrong, below `stage`."""
    import pandas as pd

    (stage / "model-error.md").write_text(wrong_model_page(studies), encoding="utf-8")
    table = pd.concat({study.name: study.modes for study in studies}, names=["experiment"])
    table.to_csv(stage / "model-error.csv")
    plot_wrong_model(studies).savefig(stage / "model-error.png", dpi=DPI)


def _write_vector_beta(studies: Sequence[VectorBeta], stage: Path) -> None:
    """Write the page, table and figure on the study with a β for every mode, unless `studies` is empty."""
    if not studies:
        return
    import pandas as pd

    (stage / "vector-beta.md").write_text(vector_beta_page(studies), encoding="utf-8")
    table = pd.concat({study.name: study.modes for study in studies}, names=["experiment"])
    table.to_csv(stage / "vector-beta.csv")
    plot_vector_beta(studies).savefig(stage / "vector-beta.png", dpi=DPI)


def separated_modes(findings: Findings) -> Iterator[Erratum]:
    """Yield an erratum if the posterior has separated maxima when modes are paired by number.

    The paper's samplers cannot cross between these maxima.
    """
    maxima = findings.separate_maxima
    if findings.pairing != "index" or len(maxima) < 2:
        return
    top = maxima["log_prob"].iloc[0]
    heights = "; ".join(
        f"number {row.Index} with modes {row.modes}" + (f", {fixed(top - row.log_prob, 1)} lower" if k else "")
        for k, row in enumerate(maxima.itertuples())
    )
    run = findings.one_start
    yield Erratum(
        f"Section {findings.published.section}, comparison of the samplers",
        "one posterior, sampled by all",
        f"paired by number the posterior has {len(maxima)} separated maxima: {heights}; number 1 holds "
        f"{share(maxima['share'].iloc[0])} of the probability",
        f"ascents from {int(findings.maxima['starts'].sum())} points; HMC without jumps, {run.chains} chains from "
        f"the paper's start vector: R-hat {fixed(run.rhat, 4)}, worst mean {fixed(run.off, 1)} posterior standard "
        "deviations off",
    )
