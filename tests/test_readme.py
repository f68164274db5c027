"""The numbers in README.md, CHANGELOG.md and the guide are those of results/, to the digits that they give."""

import json
import re
import tomllib
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from fmu.numbers import whole
from tests.results.stamps import Stamp

ROOT = Path(__file__).parent.parent
RESULTS = ROOT / "results"


def plain(text):
    return " ".join(text.split())


def number(cell):
    return float(re.sub(r"(?<=\d) (?=\d)", "", cell).split()[0])


@pytest.fixture(scope="module")
def readme():
    return (ROOT / "README.md").read_text(encoding="utf-8")


def read_guide(name):
    return (ROOT / "notebooks" / "guide" / f"{name}.md").read_text(encoding="utf-8")


def rows_under(page, *header):
    """The cells of the table with this header."""
    table = page.split("| " + " | ".join(header) + " |")[1].split("\n\n")[0]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()[2:]]


def test_ratios_to_the_best_peers_are_those_of_their_pages():
    """Effective draws of the better of fmu's mixture and HMC over those of the best peer, all counted."""
    rows = rows_under(read_guide("choosing-a-sampler"), "problem", "per evaluation", "per second")
    assert len(rows) == 4
    for problem, *said in rows:
        page = (RESULTS / "peers" / re.search(r"peers/(.*?)\)", problem)[1]).read_text(encoding="utf-8")
        for per, cell in zip(("evaluation", "second"), said, strict=True):
            found = re.search(rf"\| ESS per {per}, in all \| fmu mixture: [^|]*\|[^|]*\| (\S+) × \|", page)
            assert cell.startswith(f"{found[1]} × "), (problem, cell)


def test_speed_and_size_are_those_of_the_study_of_scale():
    header = ("DOF", "parameters", "`reduction`", "basis", "training", "log_prob with gradient", "full solve")
    rows = rows_under(read_guide("slow-models"), *header)
    assert len(rows) == 4
    for dof, parameters, tolerance, *cells in rows:
        name = f"{number(dof):g}-{parameters}-{float(tolerance.split('`')[1]):g}-64*.json"
        (path,) = (path for path in (RESULTS / "scale" / "rows").glob(name) if "cached" not in path.name)
        row = json.loads(path.read_text(encoding="utf-8"))
        found = (row["basis"], row["offline_s"], 1e3 * row["gradient_s"], 1e3 * row["full_s"])
        for cell, value in zip(cells, found, strict=True):
            assert cell == "–" or number(cell) == pytest.approx(value, rel=0.01)


def test_modes_left_out_are_those_of_the_paper_with_a_model_that_may_be_wrong(readme):
    page = (RESULTS / "model-error.md").read_text(encoding="utf-8")
    of, few = re.search(
        r"\[(\d of \d) modes\]\(results/model-error.md\), instead of (\d), are then as the others predict", readme
    ).groups()
    assert f"| section 5.1, paired by shape | {few} of 5 | {of} |" in page
    shifted = (RESULTS / "forgotten-mass.md").read_text(encoding="utf-8")
    said_of = re.search(
        r"held (\d+) % of the moduli with independent scatter, (\d+) % with scatter in common, (\d+) % with an "
        r"inferred correlation, (\d+) % with two scatters, and (\d+) % with an updated mass",
        plain(read_guide("contradicted")),
    ).groups()
    scatter = ("", ", in common", ", correlations inferred")
    twice = "two scatters of all three, independent and in common"
    rows = [*(f"scatter of all three{kind}" for kind in scatter), twice, "an updated mass"]
    for words, said in zip(rows, said_of, strict=True):
        held = re.search(rf"\| mass \| {words} \| (\S+) % \|", shifted)[1]
        assert float(said) == round(float(held))


def test_posterior_means_are_those_of_the_paper_repeated():
    header = ("Young's modulus, 10¹¹ N/m²", "E1", "E2", "E3", "E4", "E5")
    page = (RESULTS / "README.md").read_text(encoding="utf-8")
    published, *ours = rows_under(read_guide("gallery"), *header)
    assert f"| Hamiltonian Monte Carlo, published | {' | '.join(published[1:])} |" in page
    found = re.findall(r"\| \*\*Hamiltonian Monte Carlo, long run \(converged\)\*\* \|(.*)\|", page)
    for (
        row
    ) in ours:  # another processor rounds otherwise, and its chains end elsewhere: by their Monte Carlo errors
        said = intervals(row[1:])
        assert any(_agree(said, intervals(line.split("|"))) for line in found), row
    assert len(ours) == 2


def intervals(cells):
    """Numbers of cells such as ``1.715 [1.701, 1.741]``, shape (n, 3)."""
    return np.array([[float(x) for x in re.findall(r"\d+\.\d+", cell)] for cell in cells])


def _agree(one, other):
    width = one[:, 2:] - one[:, 1:2]
    return one.shape == other.shape and bool(np.all(np.abs(one - other) < 0.1 * width + 0.0005))


def test_costs_of_samplers_are_those_of_the_page_beside_them(readme):
    table = pd.read_csv(RESULTS / "compare" / "comparison.csv", index_col="sampler")
    table = table.sort_values("criterion_solves")
    header = ("sampler", "solves to the criterion", "over emcee's", "solves per effective draw", "over emcee's")
    rows = rows_under(readme, *header)
    assert [row[0].split("`")[1] for row in rows] == list(table.index)
    columns = ["criterion_solves", "criterion_over_baseline", "solves_per_ess", "per_ess_over_baseline"]
    for (_, *cells), expected in zip(rows, table[columns].to_numpy(), strict=True):
        assert [number(cell) for cell in cells] == pytest.approx(list(expected), rel=0.005, abs=0.005)
    text = plain(read_guide("choosing-a-sampler"))
    assert f"include the search ({whole(round(table['search_solves'].iloc[0], -2))})" in text
    assert f"as the {table.loc['hmc', 'gradient_cost']:.1f} solves that it takes" in text
    assert f"was met after {whole(round(table.loc['emcee', 'total_solves'], -3))}" in text
    assert (RESULTS / "compare" / "compare.png").is_file()
    page = (RESULTS / "compare" / "report" / "index.html").read_text(encoding="utf-8")
    for solves in table["criterion_solves"]:
        assert whole(float(f"{solves:.3g}")) in page


def test_the_readme_says_which_commit_its_figures_are_of(readme):
    stamp = Stamp.of((RESULTS / "compare" / "README.md").read_text(encoding="utf-8"))
    assert f"(results/compare/README.md) on {stamp.date}, commit {stamp.commit}." in plain(readme)


def test_workers_and_kills_are_those_of_their_pages():
    page = plain(read_guide("cluster"))
    table = (RESULTS / "workers.md").read_text(encoding="utf-8").split("| run |")[1]
    faster = [line.split("|")[4].strip() for line in table.splitlines()[2:4]]
    assert f"Two workers were {' and '.join(faster)} times as fast as one" in page
    kills = re.search(r"\*\*(\d+) kills; all \d+ runs came", (RESULTS / "kills.md").read_text(encoding="utf-8"))[1]
    assert f"Runs were killed {kills} times and no draw changed" in page


def test_changelog_is_of_the_version_and_its_numbers_are_those_of_the_pages():
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    version = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    assert re.findall(r"^## \[(\d+\.\d+\.\d+)\] - \d{4}-\d\d-\d\d$", changelog, re.MULTILINE)[0] == version
    said, pages = (
        plain(changelog),
        {path.stem: plain(path.read_text(encoding="utf-8")) for path in RESULTS.glob("*.md")},
    )
    solves = re.search(r"cantilever-young: solves \| ≤ 60 \| (\d+)", pages["surrogate"])[1]
    assert f"{solves} solves for cantilever-young" in said
    gains = [
        int(n)
        for n in re.findall(r"`fmu.MixtureMove`, frozen \| \d+ % \| [\d.]+ \| \d+ \| (\d+)", pages["emcee-moves"])
    ]
    assert f"{min(gains)} to {max(gains)} times as many effective draws" in said
    runs, off = re.search(r"\*\*(\d+) runs are called converged, .*? evidence: (\d+)", pages["densities"]).groups()
    assert (f"Of {runs} runs", off) == (re.search(r"Of \d+ runs", said)[0], "1")
    assert f"[{re.search(r'(\d+) kills;', pages['kills'])[1]} kills]" in said
