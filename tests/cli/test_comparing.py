"""``fmu compare`` on a case, a file and a run, and ``fmu run --sampler all``."""

import sys

import pandas as pd
import pytest

from fmu.samplers.registry import COMPARED, sampler_class
from tests.cli.runs import QUIET, assert_same, invoke

FEW = ("--chains", 2, "--starts", 2, "--max-solves", 100)
TWO = COMPARED[0], COMPARED[-1]


@pytest.fixture
def short(folder, monkeypatch):
    """The problem in the current directory, and samplers that are judged after a few steps."""
    for name in COMPARED:
        monkeypatch.setattr(sampler_class(name), "first", (3, 8))
    return folder


def compared(case):
    result = invoke("compare", case, *FEW, *QUIET)
    assert result.exit_code == 1, result.output  # none has enough draws
    return result.stdout


def test_a_file_is_sampled_by_all_and_its_run_compared_again(short, monkeypatch):
    said = compared("two.toml")
    out = short / "compare" / "two-shape"
    table = pd.read_csv(out / "comparison.csv", index_col="sampler")
    assert tuple(table.index) == COMPARED
    assert (table["search_solves"] > 100).all()
    assert table["criterion_solves"].isna().all()
    assert (table["total_solves"] >= table["search_solves"] + table["n_solves"] - 1e-6).all()  # and gradients
    assert table.loc["emcee", "per_ess_over_baseline"] == 1.0
    assert "emcee did not meet the criterion" in said
    again = invoke("compare", out)
    assert again.exit_code == 0
    assert again.stdout.strip() in said

    # all samplers of a run are those that compare runs; two of them show that they draw the same
    assert sys.modules["fmu.cli.run"].COMPARED is COMPARED
    monkeypatch.setattr(sys.modules["fmu.cli.run"], "COMPARED", TWO)
    assert invoke("run", "two.toml", "--sampler", "all", *FEW, "--out", "run", *QUIET).exit_code == 1
    assert {path.stem for path in (short / "run").glob("*.nc")} == set(TWO)
    for name in TWO:
        assert_same(name, out, short / "run")


def test_a_case(short, monkeypatch):
    monkeypatch.setattr(sys.modules["fmu.cli.compare"], "COMPARED", TWO)
    compared("shear-2dof")
    assert {path.stem for path in (short / "compare").glob("shear-2dof-*/*.nc")} == set(TWO)
