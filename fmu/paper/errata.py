"""Find errata in the paper, and recompute the published frequencies from the published parameters."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from fmu.numbers import fixed, given, share, significant
from fmu.paper import spectrum
from fmu.paper.experiment import rows_of
from fmu.paper.findings import BETTER, CLAIMS, SHORT
from fmu.paper.plan import PAPER_SAMPLERS
from fmu.paper.published import EXPERIMENTS, Experiment
from fmu.tables import markdown_table

if TYPE_CHECKING:
    import pandas as pd

    from fmu.posterior.problem import UpdatingProblem


TOLERANCE = 1e-3
"""Relative tolerance in addition to the rounding of the printed frequency, because the parameters were rounded
too."""


def recompute(problems: Mapping[str, UpdatingProblem]) -> pd.DataFrame:
    """Return a table that compares the frequencies in Tables 2 and 4 with the model at the published parameters.

    The parameters are those in Tables 1 and 3, with misprints corrected.

    Parameters
    ----------
    problems : mapping of str to UpdatingProblem
        Each experiment's problem, keyed by case, with modes paired by number.

    Returns
    -------
    DataFrame
        One row per frequency. The columns are ``table``, ``column`` and ``mode``; the printed text ``printed_hz``;
        ``meant_hz``, which differs from the printed frequency if another cell exposes a misprint; ``model_hz``;
        ``difference_hz``, model minus meant frequency; ``tolerance_hz``, its tolerance; ``within``, whether the
        difference is within the tolerance; ``as_printed``, whether the model at the printed parameters agrees with
        the printed frequency; and ``remark``.
    """
    import pandas as pd

    rows = []
    for case, experiment in EXPERIMENTS.items():
        for column in experiment.columns.values():
            model_hz, printed_hz = problems[case].frequencies(np.array([column.theta, column.printed_theta]))
            for i, label in enumerate(problems[case].data.labels):
                difference = float(model_hz[i] - column.meant_hz[i])
                tolerance = float(column.half_unit_hz[i] + TOLERANCE * column.meant_hz[i])
                remarks = []
                if i in column.corrected_frequencies:
                    remarks.append(
                        f"misprint: its error column, {column.errors[i]} %, means {given(column.meant_hz[i])}"
                    )
                if column.corrected_parameters:
                    remarks.append("from the corrected parameters")
                rows.append(
                    {
                        "table": experiment.frequency_table,
                        "column": column.title,
                        "mode": label,
                        "printed_hz": str(column.frequencies[i]),
                        "meant_hz": column.meant_hz[i],
                        "model_hz": float(model_hz[i]),
                        "difference_hz": difference,
                        "tolerance_hz": tolerance,
                        "within": abs(difference) <= tolerance,
                        "as_printed": abs(printed_hz[i] - column.printed_hz[i]) <= tolerance,
                        "remark": "; ".join(remarks),
                    }
                )
    return pd.DataFrame(rows)


def recomputed_page(table: pd.DataFrame) -> str:
    """Return the Markdown text of recomputed.md. `table` is the result of `recompute`."""
    rows = [
        (
            f"Table {row['table']}", row["column"], row["mode"], row["printed_hz"], fixed(row["model_hz"], 3),
            fixed(row["difference_hz"], 3), fixed(row["tolerance_hz"], 3),
            "yes" if row["within"] else "**no**", row["remark"],
        )
        for _, row in rows_of(table)
    ]  # fmt: skip
    return (
        "# The published frequencies, recomputed\n\n"
        "Tables 2 and 4 beside the model at the parameters of Tables 1 and 3, modes paired by number: "
        f"{count_reproduced(table)}. All within {share(TOLERANCE)} beyond the rounding of the printed digit, or "
        "as the table says; differences are from what was meant.\n\n"
        + markdown_table(
            (
                "table",
                "column",
                "mode",
                "printed, Hz",
                "model, Hz",
                "difference, Hz",
                "tolerance, Hz",
                "within",
                "remark",
            ),
            rows,
            words=(0, 1, -1),
        )
    )


def count_reproduced(table: pd.DataFrame) -> str:
    """Return a phrase that says how many published frequencies the model reproduces, and which need a correction.

    Parameters
    ----------
    table : DataFrame
        The result of `recompute`.
    """
    good = table[table["within"]]
    said = [
        f"{int(good['as_printed'].sum())} of {len(table)} published frequencies come out of one model as printed"
    ]
    corrected = good[~good["as_printed"]]
    for experiment in EXPERIMENTS.values():
        for column in experiment.columns.values():
            where = (corrected["table"] == experiment.frequency_table) & (corrected["column"] == column.title)
            modes, place = list(corrected["mode"][where]), f"Table {experiment.frequency_table}, {column.title}"
            if modes and column.corrected_parameters:
                meant = ", ".join(
                    f"{experiment.parameter_names[j]} = {significant(value, 3)}, printed {column.parameters[j]}"
                    for j, value in column.corrected_parameters.items()
                )
                said.append(f"{len(modes)} more from corrected inputs ({place}: {meant})")
            said += [
                f"1 more against the frequency that its error column means ({place}, mode {i + 1}: "
                f"{given(meant_hz)} Hz, printed {column.frequencies[i]} Hz)"
                for i, meant_hz in column.corrected_frequencies.items()
                if modes
            ]
    failed = len(table) - len(good)
    return "; ".join([*said, f"**{failed} not**"] if failed else said)


YOUNG, SECTION = EXPERIMENTS
RARE = 5e-4


class Erratum(NamedTuple):
    """An erratum in the paper.

    Its fields are the place in the paper, the printed content, the correct content as found from the model or the
    table, and the evidence.
    """

    place: str
    printed: str
    found: str
    evidence: str


def computed_errata(
    by_number: Mapping[str, UpdatingProblem], by_shape: Mapping[str, UpdatingProblem], box_points: int
) -> list[Erratum]:
    """Return the errata that follow from the tables and the model.

    Parameters
    ----------
    by_number, by_shape : mapping of str to UpdatingProblem
        Each experiment's problem, keyed by case, with modes paired by number and by shape.
    box_points : int
        Number of points within the parameter bounds at which the spectrum is examined; a power of two.
    """
    return [
        *_mode_pairing(by_number[YOUNG], by_shape[YOUNG]),
        *(erratum for case in EXPERIMENTS for erratum in _over_the_box(case, by_number[case], box_points)),
        *(erratum for case in EXPERIMENTS for erratum in _parameters(case, by_number[case])),
        *(erratum for case in EXPERIMENTS for erratum in _frequencies(case, by_number[case])),
        *(erratum for case in EXPERIMENTS for erratum in _errors(case)),
        *(erratum for case in EXPERIMENTS for erratum in conclusions(EXPERIMENTS[case])),
    ]


def _mode_pairing(by_number: UpdatingProblem, by_shape: UpdatingProblem) -> Iterator[Erratum]:
    """Yield an erratum for each mode in section 5.1 whose number belongs to another mode at the starting point."""
    experiment = EXPERIMENTS[YOUNG]
    start = experiment.columns["initial"]
    numbers = by_number.data.numbers
    lowest = spectrum.lowest_modes(by_number, start.theta, max(numbers))
    wanted = spectrum.paired_names(by_shape, start.theta[np.newaxis])[0]
    frequency = by_shape.frequencies(start.theta)
    order = " ".join(name for name, _ in lowest)
    for i, number in enumerate(numbers):
        name, hz = lowest[number - 1]
        if name == wanted[i]:
            continue
        error = experiment.error_percent(frequency)[i]
        yield Erratum(
            f"Table {experiment.frequency_table}, mode {i + 1}",
            f"measured {experiment.measured[i]} Hz is mode number {number}: initially {start.frequencies[i]} "
            f"Hz, error {start.errors[i]} %",
            f"number {number} is {name} ({fixed(hz, 2)} Hz), {_words(name)}; the measured mode is {wanted[i]} "
            f"({fixed(frequency[i], 2)} Hz, error {fixed(error, 2)} %)",
            f"the spectrum at the start runs {order}; the accelerometers measure motion in the weak plane",
        )


def _over_the_box(case: str, problem: UpdatingProblem, points: int) -> Iterator[Erratum]:
    """Yield an erratum for each mode number that belongs to different physical modes within the parameter bounds.

    A physical mode counts if it has the number at 0.05 % of the points or more.
    """
    experiment = EXPERIMENTS[case]
    everywhere = spectrum.shares_over_the_box(problem, points)
    for i, (number, parts) in enumerate(zip(problem.data.numbers, everywhere, strict=True)):
        seen = {name: part for name, part in parts.items() if part >= RARE}
        if len(seen) < 2:
            continue
        at = [
            f"{column.title}: {spectrum.paired_names(problem, column.theta[np.newaxis])[0, i]}"
            for column in experiment.columns.values()
        ]
        yield Erratum(
            f"Section {experiment.section}, mode {i + 1}",
            f"one mode, number {number} of the spectrum",
            "over the parameter box it is " + ", ".join(f"{name} in {share(part)}" for name, part in seen.items()),
            f"{points} quasi-random points of the box; at the vectors of Table {experiment.parameter_table} "
            f"it is " + ", ".join(at),
        )


def _parameters(case: str, problem: UpdatingProblem) -> Iterator[Erratum]:
    """Yield errata for parameters that do not reproduce their frequencies, or are outside the paper's bounds."""
    experiment = EXPERIMENTS[case]
    names = experiment.parameter_names
    for column in experiment.columns.values():
        place = f"Table {experiment.parameter_table}, {column.title}"
        if column.corrected_parameters:
            wrong = problem.frequencies(column.printed_theta)
            right = problem.frequencies(column.theta)
            cells = ", ".join(f"{names[j]} = {column.parameters[j]}" for j in column.corrected_parameters)
            meant = ", ".join(
                f"{names[j]} = {significant(value, 3)}" for j, value in column.corrected_parameters.items()
            )
            yield Erratum(
                place, cells, meant,
                f"as printed the model gives {_list(wrong)} Hz; with the values found {_list(right)} Hz; Table "
                f"{experiment.frequency_table} says {', '.join(map(str, column.frequencies))} Hz",
            )  # fmt: skip
        for j, value in enumerate(column.printed_theta):
            low, high = problem.lower[j], problem.upper[j]
            if not low <= value <= high:
                yield Erratum(
                    f"{place}, {names[j]}", str(column.parameters[j]),
                    f"outside its bounds [{significant(low, 3)}, {significant(high, 3)}]",
                    f"section {experiment.section} gives the bounds; the column's frequencies do belong to this "
                    "value",
                )  # fmt: skip


def _frequencies(case: str, problem: UpdatingProblem) -> Iterator[Erratum]:
    """Yield an erratum for each frequency whose printed error shows that the frequency is a misprint."""
    experiment = EXPERIMENTS[case]
    for column in experiment.columns.values():
        for i, meant in column.corrected_frequencies.items():
            model = problem.frequencies(column.theta)[i]
            error = experiment.error_percent(column.printed_hz)[i]
            yield Erratum(
                f"Table {experiment.frequency_table}, {column.title}, mode {i + 1}",
                f"{column.frequencies[i]} Hz, error {column.errors[i]} %",
                f"{given(meant)} Hz",
                f"the error of the printed frequency is {fixed(error, 2)} %; the model at the column's parameters "
                f"gives {fixed(model, 2)} Hz, error "
                f"{fixed(experiment.error_percent(problem.frequencies(column.theta))[i], 2)} %",
            )


def _errors(case: str) -> Iterator[Erratum]:
    """Yield an erratum for each printed error that rounding cannot reconcile with its frequency.

    Errors beside misprinted frequencies are left out, because `_frequencies` yields them.
    """
    experiment = EXPERIMENTS[case]
    for name, column in experiment.columns.items():
        for i in experiment.inconsistent_errors(name):
            if i in column.corrected_frequencies:
                continue
            cell = column.frequencies[i]
            rounded = (cell.value - cell.half_unit, cell.value + cell.half_unit)
            ends = [float(100 * abs(hz - experiment.measured_hz[i]) / experiment.measured_hz[i]) for hz in rounded]
            yield Erratum(
                f"Table {experiment.frequency_table}, {column.title}, error of mode {i + 1}",
                f"{column.errors[i]} %",
                f"{fixed(experiment.error_percent(column.printed_hz)[i], 3)} %",
                f"|{cell} − {experiment.measured[i]}|/{experiment.measured[i]}; rounding of the frequency "
                f"allows {fixed(min(ends), 3)} to {fixed(max(ends), 3)} %",
            )


def conclusions(experiment: Experiment) -> Iterator[Erratum]:
    """Yield an erratum if a measure of the printed errors contradicts what the paper says on its samplers.

    The measures are the mean of the printed errors, and Σ(f − f_m)², the sum in the likelihood (eq. (4) of the
    paper).
    """
    claims = [(a, b) for a, verb, b in CLAIMS[experiment.case] if verb == BETTER]
    measures = {"by the mean error": experiment.mean_error, "by Σ(f − f_m)²": experiment.misfit}
    against = [
        f"{SHORT[a]} is not better than {SHORT[b]} {words}"
        for words, measure in measures.items()
        for a, b in claims
        if measure(a) >= measure(b)
    ]
    if not against:
        return
    columns = [(experiment.columns[s].title, s) for s in PAPER_SAMPLERS]
    table = experiment.frequency_table
    errors = ", ".join(f"{title} {fixed(experiment.mean_error(s), 2)} %" for title, s in columns)
    misfits = ", ".join(f"{title} {fixed(experiment.misfit(s), 0)} Hz²" for title, s in columns)
    yield Erratum(
        f"Section {experiment.section}, abstract and section 6, results of the samplers",
        "; ".join(f"{SHORT[a]} {BETTER} {SHORT[b]}" for a, b in claims),
        "it depends on the measure, which the paper does not state: " + "; ".join(against),
        f"mean of the errors printed in Table {table}: {errors}; Σ(f − f_m)² of its frequencies, the misfit in "
        f"the likelihood (4): {misfits}",
    )


ALGORITHMS = """\
These concern formulas and the listing of algorithms; no number computed here bears on them. The samplers follow
the corrected version.

- **Section 4.2, step 3** tests "Y ≤ P(E_0|E)", the old point, which is always true. It must test the candidate:
  Y ≤ P(E_1|D).
- **Section 4.2, step 4** repeats step 3 alone. Every sample needs a new level Y and a new interval around the new
  point: steps 1 to 3.
- **Section 4.2 against section 5.** What is listed moves all coordinates at once (Neal 2003, figure 8); the text
  of section 5 speaks of a sampler that moves one coordinate at a time. They are two samplers, and both are here:
  `Slice(scheme="hyperrectangle")` and `Slice(scheme="coordinate")`.
- **Section 4.3** does not say that the momentum p is drawn afresh, from N(0, M), for every sample. Without that,
  (12) to (14) keep close to one level of H, and the samples are not of the posterior.
- **Equation (3)** is labelled (2).
- **Equations (6) to (8)** print Σ_i (α_i/2)‖E‖², with the whole vector in each term. Then (7) is false, since the
  integral over n parameters is (2π/Σα_i)^(n/2), and in section 5.2 squares of m⁴ and of m² are added before they
  are weighted. Each term must have its own group, ‖E_i‖²; (7) then holds if a group is one parameter, as in
  section 5.
- **Equation (9)** leaves out the evidence P(D): with Z_s = Z_D·Z_E, (8) is not normalised.
- **Equation (15)** perturbs all coordinates at once as printed; a partial derivative perturbs one at a time.
"""


def errata_page(errata: list[Erratum], recomputed: str) -> str:
    """Return the Markdown text of errata.md.

    `recomputed` says how many frequencies the model reproduces (`count_reproduced`).
    """
    planes = ", ".join(f"{letter}: {words}" for letter, words in spectrum.PLANES.items())
    rows = [(str(k), *erratum) for k, erratum in enumerate(errata, start=1)]
    return (
        "# Errata\n\n"
        "Of Boulkaibet, Marwala, Mthembu, Friswell & Adhikari, *Sampling Techniques in Bayesian Finite Element "
        "Model Updating*. Every number below is computed from the paper's tables and the model that reproduces "
        f"them: {recomputed} ([recomputed.md](recomputed.md)).\n\n"
        f"## In the tables\n\nModes are named by their plane of motion and their number in it; {planes}.\n\n"
        + markdown_table(("#", "where", "printed", "found", "evidence"), rows, words=range(5))
        + f"\n## In the algorithms\n\n{ALGORITHMS}"
    )


def _words(name: str) -> str:
    return spectrum.PLANES[name[0]]


def _list(frequencies: object) -> str:
    return ", ".join(fixed(f, 2) for f in np.asarray(frequencies, dtype=float))
