"""The page and the figures of the study `tests.validation.scale`."""

from __future__ import annotations

import re
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

METHOD = """The structure is a regular concrete frame of beam elements, clamped at the foundation. The parameters
are the moduli of its columns and of its floor beams, in groups of storeys. Their priors are Gaussian with a
standard deviation of 7 % of the nominal value, truncated at three standard deviations (±21 %). The data are ten
frequencies of a simulated true frame, with errors of 0.5 %; modes are paired by shape.

Times are processor seconds of one core, with one BLAS thread. The columns *log_prob* and *with gradient* are for
a log-probability alone and with its gradient, per parameter vector θ. *Offline* is the time to make the problem:
frame, true frequencies, reference modes and training of the reduced basis. A *full solve* is a call of
`PairedStructure.modes`: factorisation, Lanczos iteration and pairing. Other work on the machine can lengthen
processor times by a third and more. Memory is the largest resident set of a process that measures one row; Python
and its libraries take 0.1 GiB of it."""


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
    first = f"# Scale: time and memory of large models\n\n{_question(found)}\n\n{METHOD}"
    return "\n\n".join([first, *(section(rows).rstrip("\n") for section, rows in sections if rows)]) + "\n"


def _question(found: Found) -> str:
    """Return the question of the page and, if there are rows, the answer."""
    question = "How do time and memory grow with degrees of freedom, parameters and chains?"
    if not found["dof"]:
        return question
    small, large = found["dof"][0], found["dof"][-1]
    full, value = (_rounded(large[name] / small[name]) for name in ("full_s", "value_s"))
    return (
        f"{question} **From {whole(n_dof(small))} to {whole(n_dof(large))} degrees of freedom (DOF), the time of "
        f"a full solve grows by a factor of {full}, and the time of a log-probability from the reduced basis by a "
        f"factor of {value}. At {whole(n_dof(large))} DOF, a log-probability is "
        f"{_rounded(large['full_s'] / large['value_s'])} times as fast as a full solve.**"
    )


def _rounded(value: float) -> str:
    """Return a number with two significant digits."""
    return significant(value, 2) if value < 100 else whole(float(f"{value:.2g}"))


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
        "DOF", "parameters", "`reduction`", "solver", "vectors", "offline, s", "factorisations",
        "share of time", "right-hand sides", "share of time", "eigenproblems", "before, s",
        "eigenproblems before", "ratio of times", "peak, GiB",
    )  # fmt: skip
    by = (
        f" The columns *before* are for training by full solves, commit {', '.join(sorted(commits))}."
        if commits
        else ""
    )
    return (
        "## Training\n\nTraining solves a few full eigenproblems. Elsewhere it computes residuals, which need "
        "only solutions with the factors of one matrix. *Vectors* is the size of the reduced basis, and "
        "`reduction` its tolerance, the largest relative error of a frequency. The two shares are of the time "
        f"offline.{by}\n\n" + markdown_table(header, lines, words=(2, 3))
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
        "`reduction`", "vectors", "offline, s", "log_prob, ms", "with gradient, ms",
        "full solve / log_prob", f"gradient at {_power(first)} / this one", "largest error", "its bound",
        "offline, GiB", "after a batch, GiB",
    )  # fmt: skip
    said = [f"- `{_power(row)}`: {_readable(text)}" for row in rows for text in row["said"]]
    return (
        f"## {whole(n_dof(first))} degrees of freedom, {first['parameters']} parameters, {first['chains']} "
        f"chains\n\nA full solve takes {first['full_s']:.2g} s. Times of `log_prob` are per θ in a batch of "
        f"{first['chains']}. The tolerance `reduction` applies to the frequencies over the whole box: at new "
        "random points, corners and faces. It determines the tolerance of the log-probability "
        "(`fmu.posterior.reduction.tolerance.Tolerance`). The largest relative error of a frequency, and the "
        f"bound computed there, are from {first['checked']} draws from the prior.\n\n"
        + markdown_table(header, lines)
        + ("\nMessages of the training:\n\n" + "\n".join(said) if said else "\nTraining reached every tolerance.")
        + ("\n\n![Basis and time against the tolerance](scale/tolerance.png)" if len(rows) > 1 else "")
    )


def _readable(message: str) -> str:
    """Return a message of fmu with numbers of many digits rounded to two."""
    return re.sub(r"\d\.\d{6,}(e-?\d+)?", lambda found: significant(float(found[0]), 2), message)


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
        "DOF", "full solve, ms", "ratio to the first row", "vectors", "offline, s", "log_prob, ms",
        "with gradient, ms", "bound, ms", "full solve / log_prob", "peak, GiB",
    )  # fmt: skip
    fast = [whole(n_dof(row)) for row in rows if row["solver"] == PARDISO]
    by = f" PARDISO factorises the frame of {', '.join(fast)} DOF, and SuperLU the others." if fast else ""
    return (
        f"## Degrees of freedom\n\n{base['parameters']} parameters, `reduction={_power(base)}`, batches of "
        f"{base['chains']}.{by} *Bound* is the time to bound the errors of all frequencies at one θ.\n\n"
        + markdown_table(header, lines, words=())
        + "\n![Growth with degrees of freedom, parameters and chains](scale/growth.png)"
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
                "full model" if not row["basis"] else "not reached" if row["said"] else "reached",
            )
        )
    header = (
        "`reduction`", "parameters", "vectors", "offline, s", "log_prob, ms", "with gradient, ms",
        "ratio to the first", "full solve / log_prob", "peak, GiB", "tolerance",
    )  # fmt: skip
    size = n_dof(rows[0])
    said = [
        f"- {row['parameters']} parameters, `{_power(row)}`: {_readable(text)}"
        for row in rows
        for text in row["said"]
    ]
    return (
        f"## Parameters\n\n{whole(size)} DOF, batches of {rows[0]['chains']}. For a frame of this size, a "
        f"reduced basis saves time up to {affordable(size)} vectors. If the tolerance needs more vectors, "
        "training ends with a message (tolerance *not reached*), or the full model is used (tolerance *full "
        "model*). Remedies are a looser `reduction`, narrower bounds or priors, and fewer groups if the data "
        "cannot separate them. The column *ratio to the first* compares the times with gradient.\n\n"
        + markdown_table(header, lines, words=(0, -1))
        + ("\n" + "\n".join(said) if said else "")
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
    header = ("chains", "log_prob, ms", "with gradient, ms", "speed-up over one chain", "peak, GiB")
    return (
        f"## Chains\n\n{whole(n_dof(first))} DOF, {first['parameters']} parameters, `reduction={_power(first)}`; "
        f"the basis of {first['basis']} vectors is read from the cache. All chains are solved in one batch, and "
        "times are per θ. The speed-up compares times with gradient.\n\n" + markdown_table(header, lines, words=())
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
    right.set_ylabel("ms per θ")
    right.legend(frameon=False, fontsize=FONT - 1)
    for axes in (left, right):
        axes.set_xscale("log")
        _ticks(axes, x, [significant(value, 1) for value in x])
        axes.set_xlabel("tolerance of the frequencies (reduction)")
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
    dof.set_ylabel("ms per θ")
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
