"""The comparison that README.md shows: ``fmu compare cantilever-young`` with its defaults, and its picture.

    python -m tests.results.compare OUT [--kept DIRECTORY] [--minutes M]

Writes compare/README.md, comparison.csv, report/, and where there is a chromium also compare.png.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import pandas as pd

from fmu.numbers import significant, whole
from fmu.tables import markdown_table
from tests.validation.kept import study_parser

CASE, WINDOW = "cantilever-young", "1280,1290"
HEADER = [
    "sampler",
    "verdict",
    "solves to the criterion",
    "over emcee's",
    "solves per effective draw",
    "over emcee's",
]
PAGE = """# Samplers side by side

Written by `fmu compare {case}` with its defaults. The criterion is an R-hat below 1.01, and bulk and tail ESS of
at least 400, for every parameter. All columns are in [comparison.csv](comparison.csv).

{table}
[![The first screen of the page that the command writes](compare.png)](report/index.html)
"""


def page(table: pd.DataFrame) -> str:
    """Return the page of a comparison, the cheapest sampler first."""
    rows = [
        [
            f"`{row.sampler}`",
            row.verdict,
            whole(row.criterion_solves),
            significant(row.criterion_over_baseline, 3),
            significant(row.solves_per_ess, 3),
            significant(row.per_ess_over_baseline, 3),
        ]
        for row in table.sort_values("criterion_solves").itertuples()
    ]
    return PAGE.format(case=CASE, table=markdown_table(HEADER, rows, words=(0, 1)))


def take_picture(html: Path, png: Path) -> None:
    """Write what a window of chromium shows of a page; nothing where there is no chromium."""
    chromium = shutil.which("chromium")
    if chromium is not None:
        options = ("--headless", "--no-sandbox", "--hide-scrollbars", f"--window-size={WINDOW}")
        command = [chromium, *options, f"--screenshot={png}", html.resolve().as_uri()]
        subprocess.run(command, check=True, capture_output=True)


def main() -> int:
    """Compare, write, and return the exit code."""
    asked = study_parser(__doc__).parse_args()
    target = asked.out / "compare"
    shutil.rmtree(target, ignore_errors=True)
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        subprocess.run([sys.executable, "-m", "fmu", "compare", CASE, "--out", str(run)], check=True)
        shutil.copytree(run / "report", target / "report")
        shutil.copy(run / "comparison.csv", target)
    (target / "README.md").write_text(page(pd.read_csv(target / "comparison.csv")), encoding="utf-8")
    take_picture(target / "report" / "index.html", target / "compare.png")
    return 0


if __name__ == "__main__":
    sys.exit(main())
