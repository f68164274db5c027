"""The page and the figures of the study of scale."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from fmu.fem.modes.solver import PARDISO
from fmu.fem.reduced.points import affordable
from fmu.numbers import MISSING, fixed, significant, whole
from fmu.report.plots.style import BLACK, FONT, VERMILLION, colour, new_figure
from fmu.tables import markdown_table

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Rows = Sequence[Mapping[str, Any]]
Found = Mapping[str, Rows]
BLUE, GREEN = colour("hmc"), colour("slice")

INTRODUCTION = (
    "Written by `make validate` (`python -m tests.validation.scale results`). A regular concrete frame of beam "
    "elements, clamped at the foundation; the moduli of its columns and of its floor beams are uncertain in "
    "groups of storeys, with Gaussian priors of 7 % about their nominal value, truncated at three standard "
    "deviations (±21 %). Ten frequencies of a true frame are what is measured, with errors of 0.5 %; modes are "
    "paired by shape. Seconds are those of one processor core, BLAS on one thread, unless they are by the "
    "clock; memory is the largest resident set, each row in a process of its own (Python and its libraries take "
    "0.1 GiB of it). Offline is all that makes the problem: the frame and its true frequencies, the reference "
    "modes, the training. A full solve is one by `PairedStructure.modes`: a factorisation, Lanczos and the "
    "pairing. Other work on the machine makes processor seconds longer too, by a third and more."
)


def n_dof(row: Mapping[str, Any]) -> int:
    """Return the degrees of freedom of a row's frame."""
    return int(6 * row["storeys"] * row["x_axes"] * row["y_axes"])


def page(found: Found) -> str:
    """Return the page in Markdown; a table without rows is left out."""
    trained = [*found["dof"], *found["superlu"], *found["demand"]]
    sections = (
        (_training, trained),
        (_demand, found["demand"]),
        (_by_dof, found["dof"]),
        (_by_parameters, found["parameters"]),
        (_by_chains, found["chains"]),
    )
    parts = [f"# Scale\n\n{INTRODUCTION}", *(section(rows) for section, rows in sections if rows)]
    return "\n\n".join(parts) + "\n"


def _training(rows: Rows) -> str:
    lines, commits = [], set()
    for row in rows:
        before = row["before"]
        old: tuple[str, ...] = (MISSING,) * 3
        if before is not None:
            commits.add(f"{before['commit']}, measured on {before['finished'].split()[0]}")
            old = (
                fixed(before["offline_s"], 0),
                whole(before["offline_solves"]),
                _ratio(before["offline_s"] / row["offline_s"]),
            )
        lines.append(
            (
                whole(n_dof(row)),
                whole(row["parameters"]),
                f"`{_power(row)}`",
                row["solver"] if row["factorisations"] else "LAPACK",
                _vectors(row),
                fixed(row["offline_s"], 1),
                whole(row["factorisations"]),
                f"{row['factorising_s'] / row['offline_s']:.0%}",
                whole(row["right_hand_sides"]),
                f"{row['solving_s'] / row['offline_s']:.0%}",
                whole(row["full_solves"]),
                *old,
                fixed(row["offline_gib"], 2),
            )
        )
    header = (
        "DOF", "parameters", "`reduction`", "solver", "basis", "offline, s", "factorisations", "share of them",
        "right-hand sides", "share of them", "eigenproblems", "before, s", "eigenproblems before", "faster",
        "peak, GiB",
    )  # fmt: skip
    by = f"; before: training by full solves, commit {', '.join(sorted(commits))}" if commits else ""
    return (
        "## Training\n\nA few full eigenproblems, and residuals everywhere else: right-hand sides for the factors "
        f"of one matrix{by}.\n\n" + markdown_table(header, lines, words=(2, 3))
    )


def _vectors(row: Mapping[str, Any]) -> str:
    return whole(row["basis"]) if row["basis"] else MISSING


def _power(row: Mapping[str, Any]) -> str:
    return significant(row["reduction"], 1)


def _ms(seconds: float | None) -> str:
    return MISSING if seconds is None else significant(1e3 * seconds, 3)


def _ratio(value: float) -> str:
    return significant(value, 3) if value < 100 else whole(round(value))


def _demand(rows: Rows) -> str:
    first = rows[0]
    lines = [
        (
            f"`{_power(row)}`",
            _vectors(row),
            fixed(row["offline_s"], 0),
            _ms(row["value_s"]),
            _ms(row["gradient_s"]),
            _ratio(row["full_s"] / row["value_s"]),
            _ratio(first["gradient_s"] / row["gradient_s"]),
            significant(row["frequency_error"], 2),
            significant(row["frequency_bound"], 2),
            fixed(row["offline_gib"], 2),
            fixed(row["online_gib"], 2),
        )
        for row in rows
    ]
    header = (
        "`reduction`", "basis", "offline, s", "log_prob, ms", "with gradient, ms",
        "full solve / log_prob", f"gradient against {_power(first)}", "error at 16 draws of the prior",
        "bound there", "offline, GiB", "with a batch, GiB",
    )  # fmt: skip
    said = [f"- `{_power(row)}`: {text}" for row in rows for text in row["said"]]
    return (
        f"## {whole(n_dof(first))} degrees of freedom, {first['parameters']} parameters, {first['chains']} "
        "chains\n"
        "\n"
        f"A full solve takes {first['full_s']:.2g} s. Times online are a theta's, in a batch of "
        f"{first['chains']}. The tolerance is that of the frequencies over the whole box, at fresh points, "
        "corners and faces; what the log-probability may be off follows from it "
        "(`fmu.posterior.reduction.tolerance.Tolerance`).\n\n"
        + markdown_table(header, lines)
        + ("\n\nWhat training says:\n\n" + "\n".join(said) if said else "\n\nTraining reached every tolerance.")
        + ("\n\n![Basis and time against the tolerance](scale/tolerance.png)" if len(rows) > 1 else "")
    )


def _by_dof(rows: Rows) -> str:
    base = rows[0]
    lines = [
        (
            whole(n_dof(row)),
            _ms(row["full_s"]),
            _ratio(row["full_s"] / base["full_s"]),
            _vectors(row),
            fixed(row["offline_s"], 1),
            _ms(row["value_s"]),
            _ms(row["gradient_s"]),
            _ms(row["bound_s"]),
            _ratio(row["full_s"] / row["value_s"]),
            fixed(row["peak_gib"], 2),
        )
        for row in rows
    ]
    header = (
        "DOF", "full solve, ms", "against the first", "basis", "offline, s", "log_prob, ms", "with gradient, ms",
        "bound, ms", "full solve / log_prob", "peak, GiB",
    )  # fmt: skip
    fast = [whole(n_dof(row)) for row in rows if row["solver"] == PARDISO]
    said = f" With PARDISO: {', '.join(fast)} DOF; with SuperLU the others." if fast else ""
    return (
        f"## Degrees of freedom\n\n{base['parameters']} parameters, `reduction={_power(base)}`, batches of "
        f"{base['chains']}.{said} The bound is that of all frequencies at one theta.\n\n"
        + markdown_table(header, lines, words=())
        + "\n\n![Growth with degrees of freedom, parameters and chains](scale/growth.png)"
    )


def _by_parameters(rows: Rows) -> str:
    lines = []
    base: dict[float, Mapping[str, Any]] = {}
    for row in rows:
        first = base.setdefault(row["reduction"], row)
        lines.append(
            (
                f"`{_power(row)}`",
                whole(row["parameters"]),
                _vectors(row),
                fixed(row["offline_s"], 1),
                _ms(row["value_s"]),
                _ms(row["gradient_s"]),
                _ratio(row["gradient_s"] / first["gradient_s"]),
                _ratio(row["full_s"] / row["value_s"]),
                fixed(row["peak_gib"], 2),
                "full model" if not row["basis"] else "warned" if row["said"] else "reached",
            )
        )
    header = (
        "`reduction`", "parameters", "basis", "offline, s", "log_prob, ms", "with gradient, ms",
        "gradient against the first", "full solve / log_prob", "peak, GiB", "tolerance",
    )  # fmt: skip
    size = n_dof(rows[0])
    said = [f"- {row['parameters']} parameters, `{_power(row)}`: {text}" for row in rows for text in row["said"]]
    return (
        f"## Parameters\n\n{whole(size)} DOF, batches of {rows[0]['chains']}. Of a frame of that size a basis "
        f"pays up to {affordable(size)} vectors. Training ends there and says what "
        "was reached, and what to do: a looser `reduction`, narrower bounds or priors, or the full model "
        "(`reduction=False`); fewer groups, where the data cannot tell them apart, do too. Where a basis "
        "within the tolerance would save little, the full model answers.\n\n"
        + markdown_table(header, lines, words=(0, -1))
        + ("\n\n" + "\n".join(said) if said else "")
    )


def _by_chains(rows: Rows) -> str:
    first = rows[0]
    lines = [
        (
            whole(row["chains"]),
            _ms(row["value_s"]),
            _ms(row["gradient_s"]),
            _ratio(first["gradient_s"] / row["gradient_s"]),
            fixed(row["peak_gib"], 2),
        )
        for row in rows
    ]
    header = ("chains", "log_prob, ms a theta", "with gradient, ms a theta", "faster than one alone", "peak, GiB")
    return (
        f"## Chains\n\n{whole(n_dof(first))} DOF, {first['parameters']} parameters, "
        f"`reduction={_power(first)}`: a basis of {first['basis']} vectors, from the cache. All chains are "
        "solved as one batch.\n\n" + markdown_table(header, lines, words=())
    )


def figures(found: Found) -> dict[str, Figure]:
    """Return the figures by the names of their files."""
    drawn = {"tolerance.png": _tolerances(found["demand"])} if len(found["demand"]) > 1 else {}
    if all(found[name] for name in ("dof", "parameters", "chains")):
        drawn["growth.png"] = _growth(found)
    return drawn


def _tolerances(rows: Rows) -> Figure:
    figure = new_figure(8.0, 3.3)
    left, right = figure.subplots(1, 2)
    x = [row["reduction"] for row in rows]
    left.plot(x, [row["basis"] for row in rows], "o-", color=BLUE)
    left.set_ylim(bottom=0)
    left.set_ylabel("vectors in the basis")
    for name, label, shade, marker in (
        ("full_s", "full solve", BLACK, "--"),
        ("gradient_s", "log_prob and gradient", VERMILLION, "s-"),
        ("value_s", "log_prob", BLUE, "o-"),
    ):
        right.plot(x, [1e3 * row[name] for row in rows], marker, color=shade, label=label)
    right.set_yscale("log")
    right.set_ylabel("ms a theta")
    right.legend(frameon=False, fontsize=FONT - 1)
    for axes in (left, right):
        axes.set_xscale("log")
        _ticks(axes, x, [significant(value, 1) for value in x])
        axes.set_xlabel("tolerance of the frequencies, reduction")
    figure.suptitle(f"{whole(n_dof(rows[0]))} DOF, {rows[0]['parameters']} parameters", fontsize=FONT + 1)
    return figure


def _growth(found: Found) -> Figure:
    figure = new_figure(10.5, 3.4)
    dof, parameters, chains = figure.subplots(1, 3, sharey=True)
    rows = found["dof"]
    x = [n_dof(row) for row in rows]
    _line(dof, x, rows, "full_s", "full solve", BLACK, "^--")
    _line(dof, x, rows, "gradient_s", "log_prob and gradient", VERMILLION, "s-")
    _line(dof, x, rows, "value_s", "log_prob", BLUE, "o-")
    dof.set_xlabel(f"degrees of freedom ({rows[0]['parameters']} parameters)")
    dof.set_ylabel("ms a theta")
    tolerances = list(dict.fromkeys(row["reduction"] for row in found["parameters"]))
    for tolerance, shade in zip(tolerances, (VERMILLION, GREEN), strict=False):
        rows = [row for row in found["parameters"] if row["reduction"] == tolerance]
        label = f"log_prob and gradient, {significant(tolerance, 1)}"
        _line(parameters, [row["parameters"] for row in rows], rows, "gradient_s", label, shade, "s-")
    parameters.set_xlabel(f"parameters ({whole(n_dof(found['parameters'][0]))} DOF)")
    x = [row["chains"] for row in found["chains"]]
    _line(chains, x, found["chains"], "gradient_s", "log_prob and gradient", VERMILLION, "s-")
    _line(chains, x, found["chains"], "value_s", "log_prob", BLUE, "o-")
    first = found["chains"][0]
    chains.set_xlabel(f"chains ({whole(n_dof(first))} DOF, {first['parameters']} parameters)")
    counts = sorted({row["parameters"] for row in found["parameters"]})
    _ticks(parameters, counts, [str(count) for count in counts])
    for axes in (dof, parameters, chains):
        axes.legend(frameon=False, fontsize=FONT - 2)
    return figure


def _ticks(axes: Axes, at: Sequence[float], labels: Sequence[str]) -> None:
    axes.tick_params(axis="x", which="minor", bottom=False, labelbottom=False)
    axes.set_xticks(at, labels)


def _line(axes: Axes, x: Sequence[float], rows: Rows, name: str, label: str, shade: str, style: str) -> None:
    axes.loglog(x, [1e3 * row[name] for row in rows], style, color=shade, label=label)
