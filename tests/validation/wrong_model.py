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
from fmu.config import read
from fmu.config.discrepancy import DiscrepancyTable
from fmu.numbers import given, significant
from fmu.posterior.problem import UpdatingProblem
from fmu.tables import markdown_table

CASES = ("cantilever-young",)
HEADER = ["mode", "measured, Hz", "without: 90 %, Hz", "off by, sd", "with scatter: 90 %, Hz", "off by, sd"]


def problems(case: str) -> tuple[UpdatingProblem, UpdatingProblem]:
    """Return a built-in problem by shape, without and with embedded scatter."""
    with as_file(files("fmu.cases") / f"{case}.toml") as path:
        file = read(path)
        wrong = file.model_copy(update={"discrepancy": [DiscrepancyTable(kind="embedded")]})
        return file.build(path.name, path.parent, "shape"), wrong.build(path.name, path.parent, "shape")


def section(case: str) -> tuple[str, bool]:
    """Return the part of the page on one case, and whether both runs have converged."""
    tables, said, converged = [], [], True
    for name, problem in zip(("Without", "With scatter"), problems(case), strict=True):
        began = time.process_time()
        trace = fmu.sample(problem, until_ess=400, seed=1)
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
            off = (row["measured"] - row["mean"]) / row["sd"]
            cells += [f"{row['eti90_lb']:.1f} to {row['eti90_ub']:.1f}", f"{off:.1f}"]
        rows.append(cells)
    z = [(t["measured"] - t["mean"]) / t["sd"] for t in tables]
    size = " and ".join(f"{np.sqrt(np.mean(one**2)):.1f}" for one in z)
    text = "\n\n".join([*said, f"Root mean square of the errors in standard deviations: {size}."])
    return f"## {case}, by shape\n\n{markdown_table(HEADER, rows)}\n{text}\n", converged


def main(out: str, *cases: str) -> int:
    """Write the page; return the exit code."""
    with threadpool_limits(1):
        found = [section(case) for case in cases or CASES]
    Path(out, "wrong-model.md").write_text(PAGE + "\n".join(text for text, _ in found))
    return 0 if all(converged for _, converged in found) else 1


PAGE = """# Models that may be wrong

Written by `python -m tests.validation.wrong_model results`.

Each measured mode is predicted by the others (`fmu.leave_one_out`): by the model as it is, and by the same model
with `[[discrepancy]]` of `kind = "embedded"`, whose parameters scatter from mode to mode by an inferred τ.
The intervals are of the measurement and contain 90 % of the prediction; "off by" is the distance of the measured
frequency from its prediction, in standard deviations of the prediction.

"""

if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
