"""Export an updated model: system matrices, filled input decks and a problem file with the updated values."""

from __future__ import annotations

import json
import os
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fmu.analysis.convergence.comparison import compare_runs
from fmu.analysis.convergence.diagnosis import Diagnosis, choose_run, maxima_of
from fmu.analysis.information import Information, information
from fmu.analysis.trace.conversion import load_trace
from fmu.analysis.trace.provenance import canonical_json
from fmu.analysis.trace.reading import (
    VALUE_KINDS,
    array_of,
    constant,
    has,
    parameter_draws,
    parameter_names,
    parameter_units,
    problem_of,
)
from fmu.arguments import check_arguments
from fmu.config.kept import read_saved
from fmu.fem.modes.separable import SeparableModel
from fmu.formats.decks import (
    DOFS,
    MASS,
    PROBLEM,
    STIFFNESS,
    VALUES,
    fill_deck,
    filled_name,
    placeholders,
    read_deck,
    write_deck,
)
from fmu.numbers import names_in_words, significant
from fmu.report.files import OutputDirectory
from fmu.report.mode_files import write_modes
from fmu.report.updated_file import copy_companions, rename, updated_text
from fmu.runs.words import why_no_traces
from fmu.tables import data_frame
from fmu.types import AnyArray, FloatArray

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

    from fmu.config.problem import ProblemFile
    from fmu.posterior.problem import UpdatingProblem


FOLDER = "export"
_WORDS = {"mean": "posterior mean", "map": "highest maximum of the posterior"}
AT = tuple(_WORDS)
_MATCHING = 1e-5
"""Largest relative difference allowed between frequencies in the trace and those of the rebuilt problem."""
_DRAWS = 4
_TAIL = 0.01


@dataclass(frozen=True)
class Exported:
    """The result of `export`.

    Attributes
    ----------
    directory : Path
        The output directory.
    files : tuple of str
        The exported files, as paths relative to the directory.
    sampler : str
        Name of the sampler whose draws were used.
    remarks : tuple of str
        Warnings about the exported values and files, one sentence each.
    """

    directory: Path
    files: tuple[str, ...]
    sampler: str
    remarks: tuple[str, ...]


@check_arguments
def export(
    run_directory: str | os.PathLike[str],
    sampler: str | None = None,
    at: str = "mean",
    out: str | os.PathLike[str] | None = None,
    model: str | os.PathLike[str] | None = None,
) -> Exported:
    """Write a run's updated parameter values, and the model evaluated at these values.

    Parameters
    ----------
    run_directory : path-like
        A directory that `fmu run` wrote.
    sampler : str, optional
        The sampler whose draws are used. By default `fmu.analysis.convergence.diagnosis.choose_run` selects it:
        among the converged samplers, if there are any, the one with the largest effective sample size.
    at : {"mean", "map"}
        The exported values: the posterior mean, or the highest posterior maximum that the run found.
    out : path-like, optional
        Output directory. The default is ``export`` in the run's directory.
    model : path-like, optional
        The problem file. It is needed if the run has no copy of it, or if the files that it names have moved.

    Returns
    -------
    Exported
        The output directory, the exported files, the sampler used and warnings. The exported files are:

        ``theta.csv``: each parameter's unit, start value, posterior mean, posterior standard deviation and
        exported value, in SI units, and what determined it, if known: ``data``, ``prior`` or ``combination``.

        ``updated.toml``: the problem file with the exported values as start values and its original comments. The
        files that it names are copied beside it.

        ``K.mtx``, ``M.mtx`` and ``dofs.csv``, for a structure: the stiffness and mass matrices at the exported
        values, in Matrix Market format, and the degree of freedom in each row. With one test and a
        known geometry, also the updated and measured mode shapes (`fmu.report.mode_files.write_modes`).

        Input decks: each template that the problem file names, for its model or under ``[export]``, filled with
        the exported values (`fmu.formats.decks`).

        For a problem with several tests, ``theta.csv`` lists every inferred quantity. Start values, decks and
        matrices then use the shared parameters, the reference state, and the mean or median of each population,
        all at mean covariates. If a parameter varies freely, they use its value in the first test or group. The
        matrices do not include masses and springs that were added for a test.

    Raises
    ------
    ValueError
        If the directory contains no traces, no trace from `sampler` or an invalid trace; if `at` is unknown, or is
        ``"map"`` and the run found no maxima; if the problem file is missing, invalid or not the one that was
        sampled; if a template cannot be filled; or if `out` is a file or has an invalid manifest, or the export
        would overwrite files that fmu did not write.
    """
    directory = Path(run_directory)
    if at not in AT:
        raise ValueError(f"at: must be one of {AT} (got {at!r})")
    name, trace, diagnosis = read_choice(directory, sampler)
    theta = _theta(trace, at)
    source = read_saved(directory, None if model is None else Path(model))
    described, problem = _problem_again(source.file, source.folder, source.pairing)
    _check_same(problem, trace)
    what = f"{_WORDS[at]} of {problem.name!r}, sampled by {name}."
    names = parameter_names(trace)
    output = OutputDirectory(Path(out) if out is not None else directory / FOLDER)
    with output.stage_files() as stage:
        found = information(trace)
        left = () if found is None else found.not_informed
        _values(trace, theta, found).to_csv(stage / VALUES)
        built = described.model.build(source.folder, described.structural)
        source_of = in_the_file(problem)
        values = dict(zip(names, theta.tolist(), strict=True)) | problem.layout.held
        if built.separable is not None:
            of_file = [table.name for table in described.structural]
            structural = np.array([values[source_of.get(name, name)] for name in of_file])
            write_matrices(built.separable, built.places, structural, f"At the {what}", stage)
        starts = values | {key: values[name] for key, name in source_of.items()}
        from_prior = {*left, *(key for key, name in source_of.items() if name in left)}
        original, about = source.file.read_text(encoding="utf-8-sig"), f"The start values are the {what}"
        text, words = updated_text(original, starts, source.pairing, about, from_prior)
        text = rename(text, copy_companions(words, source.folder, stage))
        (stage / PROBLEM).write_text(text, encoding="utf-8")
        sd = dict(zip(names, parameter_draws(trace).std(axis=(0, 1), ddof=1).tolist(), strict=True))
        sd |= {key: sd[name] for key, name in source_of.items()} | dict.fromkeys(problem.layout.held, 0.0)
        unused = write_decks(
            described.decks, source.folder, starts | {f"{key} sd": x for key, x in sd.items()}, stage
        )
        remarks = [*_remarks(problem, trace, theta, at, diagnosis), *_from_prior(left)]
        remarks += write_modes(problem, theta, stage)
        remarks += _not_in_a_deck([name for name in source_of if name in unused] if described.decks else [])
        remarks += _incomplete(stage / PROBLEM)
        files = tuple(sorted(path.relative_to(stage).as_posix() for path in stage.rglob("*") if path.is_file()))
    return Exported(output.root, files, name, tuple(remarks))


def in_the_file(problem: UpdatingProblem) -> dict[str, str]:
    """Return the name of the quantity that is exported as each updated structural parameter, keyed by parameter.

    The quantity is the parameter itself, its population's mean or median, or its value in the first test or group.
    """
    structural, found = problem.layout.structural, dict[str, str]()
    for name, role in zip(problem.names, problem.roles, strict=True):
        if role.of is not None and role.kind in VALUE_KINDS:
            found.setdefault(structural[role.of].name, name)
    return found


def read_choice(directory: Path, sampler: str | None) -> tuple[str, xr.DataTree, Diagnosis]:
    """Return the name, trace and diagnosis of `sampler`; if it is None, `choose_run` selects the sampler.

    Raise ValueError if the directory has no traces, no trace from `sampler`, or an invalid trace.
    """
    traces = {path.stem: load_trace(path) for path in sorted(directory.glob("*.nc"))}
    if not traces:
        raise ValueError(f"run_directory: {why_no_traces(Path(directory))}")
    if sampler is not None and sampler not in traces:
        raise ValueError(f"sampler: must be one of {', '.join(traces)} (got {sampler!r})")
    summaries, verdicts, _ = compare_runs(traces)
    name = sampler or choose_run(verdicts, summaries)
    return name, traces[name], verdicts[name]


def read_problem(directory: Path, trace: xr.DataTree, model: Path | None = None) -> UpdatingProblem:
    """Rebuild a run's problem with its reduced model.

    Raises
    ------
    ValueError
        If the problem is not the one that was sampled, for example because a file has changed; if the run has no
        saved problem file and `model` is None; or if the problem cannot be built.
    """
    source = read_saved(directory, model)
    problem = source.load()
    try:
        _check_same(problem, trace)
    except ValueError as error:
        raise ValueError(
            f"{error}. A file that {source.file.name} names, such as a table of tests, has changed since the run: "
            "restore it, and put new tests into a table of their own"
        ) from None
    return problem


def _theta(trace: xr.DataTree, at: str) -> FloatArray:
    if at == "mean":
        return np.asarray(parameter_draws(trace).mean(axis=(0, 1)))
    maxima = maxima_of(trace)
    if maxima is None:
        raise ValueError("at: the run has no maxima, so 'map' is not available (got 'map')")
    return maxima[0].theta


def _problem_again(file: Path, folder: Path, pairing: str | None) -> tuple[ProblemFile, UpdatingProblem]:
    from fmu.config import read

    described = read(file).model_copy(update={"reduction": False})
    return described, described.build(file.name, folder, pairing)


def _check_same(problem: UpdatingProblem, trace: xr.DataTree) -> None:
    """Raise ValueError unless `problem` is the problem that was sampled.

    Everything but the model must be equal. If the model differs, for example by rounding on another machine, its
    frequencies at a few draws must agree within `_MATCHING` with the frequencies stored in the trace.
    """
    sampled = problem_of(trace)
    now = json.loads(canonical_json(problem.configuration()))
    differs = [key for key in now if key != "model" and sampled.get(key) != now[key]]
    if differs:
        raise ValueError(f"model: must be the problem that was sampled (it differs in: {', '.join(differs)})")
    if sampled.get("model") == now["model"]:
        return
    if not has(trace, "posterior_predictive"):
        raise ValueError("model: must be the problem that was sampled (it differs in: model)")
    draws = parameter_draws(trace)[0]
    picked = np.linspace(0, len(draws) - 1, min(_DRAWS, len(draws))).astype(int)
    told = array_of(trace, "posterior_predictive", "model_frequency")[0, picked]
    difference = float(np.max(np.abs(problem.frequencies(draws[picked]) / told - 1.0)))
    if not difference <= _MATCHING:
        raise ValueError(
            "model: must be the problem that was sampled (it differs in: model; frequencies of the draws by "
            f"{significant(difference, 2)})"
        )


def _values(trace: xr.DataTree, theta: FloatArray, found: Information | None) -> pd.DataFrame:
    names, draws = parameter_names(trace), parameter_draws(trace)
    columns = {
        "unit": parameter_units(trace),
        "start": [constant(trace, "start", name) for name in names],
        "mean": draws.mean(axis=(0, 1)),
        "sd": draws.std(axis=(0, 1), ddof=1),
        "value": theta,
    } | ({} if found is None else {"determined_by": found.basis})
    return data_frame(columns, "name", names)


def _remarks(
    problem: UpdatingProblem, trace: xr.DataTree, theta: FloatArray, at: str, diagnosis: Diagnosis
) -> list[str]:
    """Return warnings if the run has not converged, or if the mean is less probable than 99 % of the draws."""
    remarks = [] if diagnosis.converged else [f"The run is {diagnosis.verdict}."]
    if at == "mean":
        lp = array_of(trace, "sample_stats", "lp")
        if float(problem.log_prob(theta)) < float(np.quantile(lp, _TAIL)):
            remarks.append(
                "The posterior mean is less probable than 99 % of the draws: the posterior has several peaks "
                "or is curved, and the mean lies outside it. Use --at map for the highest maximum."
            )
    return remarks


def _from_prior(names: Sequence[str]) -> list[str]:
    """Return a list with a warning that the data did not inform `names`, or an empty list if `names` is empty."""
    if not names:
        return []
    come = "their values come from their priors" if len(names) > 1 else "its value comes from its prior"
    return [f"The data did not inform {names_in_words(names)}: {come} alone."]


def _not_in_a_deck(names: Sequence[str]) -> list[str]:
    if not names:
        return []
    return [f"{names_in_words(names)} {'is' if len(names) == 1 else 'are'} a placeholder of no template."]


def _incomplete(file: Path) -> list[str]:
    """Return a list with a warning if the updated file is invalid or needs files that were not copied.

    Otherwise the list is empty.
    """
    from fmu.config import ConfigurationError, read

    wrong = "cannot be read"
    try:
        read(file)
        wrong = "needs files that are in the directory of the original problem file"
        _problem_again(file, file.parent, None)
    except ConfigurationError as error:
        return [f"{file.name} {wrong} ({'; '.join(map(str, error.mistakes))})."]
    return []


def write_matrices(
    model: SeparableModel, places: Mapping[str, Hashable], theta: FloatArray, about: str, folder: Path
) -> None:
    """Write the stiffness and mass matrices at `theta` in Matrix Market format, and a CSV table of their rows.

    Only the lower triangles are written.
    """
    from scipy.io import mmwrite

    for name, matrix, words in (
        (STIFFNESS, model.K(theta), "Stiffness in N/m; of rotations in N m/rad."),
        (MASS, model.M(theta), "Mass in kg; of rotations in kg m^2."),
    ):
        symmetric = 0.5 * (matrix + matrix.T)
        comment = f" {words} {about} {DOFS} names the rows; entries above the diagonal are omitted."
        with (folder / name).open("wb") as file:  # mmwrite would write ASCII to a file given by name
            mmwrite(file, symmetric.tocoo(), comment=_ascii(comment), precision=17, symmetry="symmetric")
    dof_table(model, places).to_csv(folder / DOFS, index=False)


def write_decks(templates: Sequence[str], source: Path, values: Mapping[str, float], target: Path) -> set[str]:
    """Write input decks from templates, and return the names in `values` that no template uses.

    `fmu.formats.decks` describes the templates. A deck is named ``updated-…`` if its name is taken. Raise
    ValueError if a template cannot be filled.
    """
    unused = set(values)
    for template in templates:
        text = read_deck(source / template)
        path = target / filled_name(template)
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.exists():  # a file of the model was copied under this name
            path = path.with_name(f"updated-{path.name}")
        write_deck(path, fill_deck(text, values))
        unused -= placeholders(text)
    return unused


def dof_table(model: SeparableModel, places: Mapping[str, Hashable]) -> pd.DataFrame:
    """Return a data frame that names the degree of freedom in each matrix row.

    Its columns are ``row`` (counted from 1), ``node``, ``place`` (the node's name, empty if it has none) and
    ``direction``; if the geometry is known, also the node's coordinates ``x``, ``y``, ``z`` in m, which are NaN
    for a node outside the geometry.
    """
    import pandas as pd

    named: dict[Hashable, str] = {}
    for place, node in places.items():
        named.setdefault(node, str(place))
    nodes = [node for node, _ in model.dofs]
    columns: dict[str, Sequence[object] | AnyArray] = {
        "row": np.arange(1, len(nodes) + 1),
        "node": nodes,
        "place": [named.get(node, "") for node in nodes],
        "direction": [direction for _, direction in model.dofs],
    }
    if model.geometry is not None:
        coordinates, row_of = np.asarray(model.geometry.nodes), model.geometry.row_of
        at = np.array([coordinates[row_of[node]] if node in row_of else [np.nan] * 3 for node in nodes])
        columns |= dict(zip("xyz", at.T, strict=True))
    return pd.DataFrame(columns)


def _ascii(text: str) -> str:
    return text.encode("ascii", "replace").decode()
