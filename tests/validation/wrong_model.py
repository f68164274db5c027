"""Each measured mode of a built-in case predicted by the others, with and without a discrepancy of the model.

    python -m tests.validation.wrong_model OUT_DIRECTORY [CASE ...]

Exit code 1 where a run has not converged.
"""

from __future__ import annotations

import sys
import time
from importlib.resources import as_file, files
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

import fmu
from fmu.analysis.models.comparison import compare_traces
from fmu.config import read
from fmu.config.discrepancy import DiscrepancyTable
from fmu.numbers import MISSING, decimals, fixed, given, interval, significant, with_sd
from fmu.posterior.problem import UpdatingProblem
from fmu.tables import markdown_table

CASES = (
    ("cantilever-young", "shape"),
    ("cantilever-young", "index"),
    ("cantilever-section", "shape"),
    ("cantilever-section", "index"),
    ("garteur", "shape"),
    ("shear-2dof", "shape"),
    ("shear-10dof", "shape"),
    ("shear-4dof-repeated", "shape"),
)
PAIRED = {"shape": "by shape", "index": "by number"}
HEADER = ["mode", "measured, Hz", "without: 90 %, Hz", "off by, sd", "with scatter: 90 %, Hz", "off by, sd"]
SUMMARY = ["case", "inside, without", "with", "rms error, sd, without", "with", "log-evidence, with less without"]


def problems(case: str, pairing: str = "shape") -> tuple[UpdatingProblem, UpdatingProblem]:
    """Return a built-in problem, without and with embedded scatter."""
    with as_file(files("fmu.cases") / f"{case}.toml") as path:
        file = read(path)
        wrong = file.model_copy(update={"discrepancy": [DiscrepancyTable(kind="embedded")]})
        return file.build(path.name, path.parent, pairing), wrong.build(path.name, path.parent, pairing)


def section(case: str, pairing: str) -> tuple[list[str], str, bool]:
    """Return a row of the summary, the part of the page on one case, and whether both runs have converged."""
    tables, traces, said, converged = [], {}, [], True
    title = f"{case}, {PAIRED[pairing]}"
    for name, problem in zip(("Without", "With scatter"), problems(case, pairing), strict=True):
        began = time.process_time()
        trace = traces[name] = fmu.sample(problem, until_ess=400, seed=1)
        seconds = time.process_time() - began
        verdict = fmu.diagnose(trace, problem)
        converged &= verdict.converged
        tables.append(fmu.leave_one_out(trace, problem))
        summary = fmu.summary(trace)
        values = ", ".join(
            f"{parameter} {significant(row['mean'])} ± {significant(row['sd'], 2)}"
            for parameter, row in summary.iterrows()
        )
        cost = f"{verdict.state}, {seconds:.0f} s of processor time"
        said.append(f"{name}: {cost}. The model is {verdict.fit.answer}. {values}.")
    rows = []
    for (mode, one), (_, other) in zip(*(table.iterrows() for table in tables), strict=True):
        cells = [str(mode), given(one["measured"])]
        for row in (one, other):
            off = fixed((row["measured"] - row["mean"]) / row["sd"], 1)
            n = decimals(row["sd"])
            cells += [interval(row["eti90_lb"], row["eti90_ub"], n) if np.isfinite(row["sd"]) else MISSING, off]
        rows.append(cells)
    compared = compare_traces(traces).table
    inside = [
        int(((t["measured"] >= t["eti90_lb"]) & (t["measured"] <= t["eti90_ub"])).sum()) for t in tables
    ]  # fmt: skip
    known = [int(t["sd"].notna().sum()) for t in tables]
    z = [((t["measured"] - t["mean"]) / t["sd"]).dropna() for t in tables]
    errors = with_sd(compared["log_evidence"]["With scatter"] - compared["log_evidence"]["Without"],
                     float(np.hypot(*compared["error"])))  # fmt: skip
    row = [
        title,
        *(f"{k} of {n}" for k, n in zip(inside, known, strict=True)),
        *(f"{np.sqrt(np.mean(one**2)):.1f}" for one in z),
        errors,
    ]
    return row, f"## {title}\n\n{markdown_table(HEADER, rows)}\n{'\n\n'.join(said)}\n", converged


def main(out: str, *cases: str) -> int:
    """Write the page; return the exit code."""
    wanted = [one for one in CASES if not cases or one[0] in cases]
    found = []
    with threadpool_limits(1):
        for case, pairing in wanted:
            found.append(section(case, pairing))
            print(*found[-1][0], sep="  ", flush=True)
    summary = markdown_table(SUMMARY, [row for row, _, _ in found])
    page = PAGE.replace("{arguments}", " ".join(("results", *cases)))
    Path(out, "wrong-model.md").write_text(f"{page}{summary}\n" + "\n".join(text for _, text, _ in found))
    return 0 if all(converged for _, _, converged in found) else 1


PAGE = """# Models that may be wrong

Written by `python -m tests.validation.wrong_model {arguments}`.

Each measured mode is predicted by the others (`fmu.leave_one_out`): by the model as it is, and by the same model
with `[[discrepancy]]` of `kind = "embedded"`, whose parameters scatter from mode to mode by an inferred τ.
The intervals are of the measurement and contain 90 % of the prediction; "off by" is the distance of the measured
frequency from its prediction, in standard deviations of the prediction. The difference of the log-evidences is in
favour of the scatter if it is positive.

"""

if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
