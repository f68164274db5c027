"""Each measured mode of a built-in case predicted by the others, with and without a discrepancy of the model.

    python -m tests.validation.wrong_model OUT [--kept DIRECTORY] [--minutes M] [--cases CASE …]

Exit code 1 where a run has not converged.
"""

from __future__ import annotations

import sys
import time
from importlib.resources import as_file, files
from typing import Any

from threadpoolctl import threadpool_limits

import fmu
from fmu.config import read
from fmu.config.discrepancy import DiscrepancyTable
from fmu.numbers import whole
from fmu.paper.experiment import PAIRED_BY
from fmu.paper.studies.moments import moments_table
from fmu.paper.studies.wrong_model import (
    HOW_TO_READ,
    NAMES,
    WITH,
    WITHOUT,
    WrongModel,
    modes_table,
    runs_sentence,
    summary_table,
)
from fmu.posterior.problem import UpdatingProblem
from tests.validation.kept import Units, each, study_parser

MOST_ROWS = 40
"""Of a table of one case."""
CASES = (
    ("cantilever-young", "shape"),
    ("cantilever-young", "index"),
    ("cantilever-section", "shape"),
    ("cantilever-section", "index"),
    ("garteur", "shape"),
    ("shear-2dof", "index"),
    ("shear-10dof", "shape"),
    ("shear-4dof-repeated", "index"),
    ("shear-12dof-damage", "index"),
)


def problems(case: str, pairing: str = "shape") -> dict[str, UpdatingProblem]:
    """Return a built-in problem, without and with embedded scatter."""
    with as_file(files("fmu.cases") / f"{case}.toml") as path:
        file = read(path)
        wrong = file.model_copy(update={"discrepancy": [DiscrepancyTable(kind="embedded")]})
        built = (one.build(path.name, path.parent, pairing) for one in (file, wrong))
        return dict(zip((WITHOUT, WITH), built, strict=True))


def study(case: str, pairing: str) -> tuple[WrongModel, str]:
    """Return the comparison of the models of one case, and what it cost."""
    posed, traces, cost = problems(case, pairing), {}, []
    for name, problem in posed.items():
        began = time.process_time()
        traces[name] = fmu.sample(problem, until_ess=400, seed=1)
        cost.append(whole(time.process_time() - began))
    title = f"{case}, {PAIRED_BY[pairing]}"
    found = WrongModel.of(title, case, posed, traces)
    return found, f"Processor time without and with scatter, in s: {' and '.join(cost)}.\n"


def parts(case: str, pairing: str) -> dict[str, Any]:
    """Return what the page has of one case: its table of one row, its section, and whether all runs converged."""
    one, cost = study(case, pairing)
    section = [
        f"## {one.title}\n",
        modes_table(one) if len(one.modes) <= MOST_ROWS else f"{len(one.modes)} modes, without a table.\n",
        runs_sentence(one),
        cost,
        moments_table(one.parameters, NAMES) if len(one.parameters) <= MOST_ROWS else "",
    ]
    converged = bool(one.runs["converged"].all())
    return {"table": summary_table([one]), "section": "\n".join(section), "converged": converged}


def main() -> int:
    """Write the page; return the exit code."""
    parser = study_parser(__doc__)
    parser.add_argument("--cases", nargs="*", default=[], metavar="CASE")
    asked = parser.parse_args()
    wanted = [one for one in CASES if not asked.cases or one[0] in asked.cases]
    with threadpool_limits(1):
        found = Units(asked.kept, asked.minutes).completed("cases", each(wanted), lambda one: parts(*one))
    *head, _ = found[0]["table"].splitlines()
    summary = "\n".join([*head, *(one["table"].splitlines()[-1] for one in found)]) + "\n"
    text = "\n".join([PAGE, summary, *(one["section"] for one in found)])
    (asked.out / "wrong-model.md").write_text(text, encoding="utf-8")
    return 0 if all(one["converged"] for one in found) else 1


PAGE = f"""# Built-in models that may be wrong

Written by `python -m tests.validation.wrong_model results`.

The models are as they are, and with `[[discrepancy]]` of `kind = "embedded"`: parameters scatter from mode to mode
by an inferred τ. `cantilever-frf` has FRFs in place of modes, and no discrepancy. {HOW_TO_READ} The cases of
several tests have too many modes for that: draws of the posterior with all modes are weighted. A mode whose
weights or refit are unreliable has no prediction (–), and is not counted.
"""

if __name__ == "__main__":
    sys.exit(main())
