"""fmu run --discrepancy: a run for each, and a page that compares them."""

import pandas as pd
import pytest

from fmu.config.variants import VARIANTS
from tests.cli.runs import QUIET, invoke, problem_in, run

LENGTH = ("--sampler", "mh", "--warmup", 10, "--draws", 15, "--chains", 2, "--starts", 2)
ROBUST = '[[error]]\nof = "robust-frequencies"\nkind = "relative"\nsd = 0.01\n'
TITLES = [one.title for one in VARIANTS.values()]


@pytest.fixture(scope="module")
def every(tmp_path_factory):
    """Return the folder in which all discrepancies have been run, and the result."""
    folder = problem_in(tmp_path_factory.mktemp("discrepancies"))
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        yield folder, run("--discrepancy", "all", length=LENGTH)


def test_each_has_a_directory_of_its_own_and_a_row_in_the_comparison(every):
    folder, result = every
    assert result.exit_code == 0, result.output
    for k, (kind, (title, *_)) in enumerate(VARIANTS.items(), 1):
        assert f"Discrepancy {k} of {len(VARIANTS)}: {title}" in result.stderr
        assert (folder / "out" / kind / "mh.nc").is_file()
        text = (folder / "out" / kind / "problem.toml").read_text()
        assert ("[[discrepancy]]" in text) == (kind != "none")
        assert ('kind = "embedded"' in text) == kind.startswith("embedded")
    table = pd.read_csv(folder / "out" / "models.csv", index_col=0)
    assert table.index.tolist() == TITLES
    assert table["log_evidence"].notna().all()
    assert "Discrepancies compared" in result.output
    assert "embedded: the 90 % intervals of the parameters are" in result.output


@pytest.mark.usefixtures("no_pictures")
def test_the_directory_is_compared_again_with_a_page(every):
    folder, result = every
    again = invoke("compare", folder / "out")
    assert again.exit_code == 0, again.output
    told = result.output[result.output.index("Discrepancies compared") :].splitlines()[:8]
    assert all(line in again.output for line in told)
    page = (folder / "out" / "report" / "index.html").read_text()
    for words in (
        "Which model do the data prefer?",
        "Where the misfit lives",
        *TITLES,
        "../embedded/report/index.html",
    ):
        assert words in page


def test_one_discrepancy_is_an_ordinary_run(every, monkeypatch):
    folder, _ = every
    monkeypatch.chdir(folder)
    result = invoke("run", "two.toml", *LENGTH, "--discrepancy", "embedded", *QUIET)
    assert result.exit_code == 0, result.output
    assert (folder / "runs" / "two-shape-embedded" / "mh.nc").is_file()
    assert "Discrepancies compared" not in result.output


def test_a_discrepancy_that_does_not_suit_the_problem_is_left_out_of_all_and_refused_alone(tmp_path, monkeypatch):
    problem_in(tmp_path)
    monkeypatch.chdir(tmp_path)
    text = (tmp_path / "two.toml").read_text().replace("sd = 0.3\n", "")
    (tmp_path / "two.toml").write_text(
        text + '[[error]]\nof = "robust-frequencies"\nkind = "relative"\nsd = 0.01\n'
    )
    for kind in ("inferred", "embedded"):
        result = run("--discrepancy", kind, length=LENGTH)
        assert result.exit_code == 2
        assert "discrepancy" in result.stderr
        assert not (tmp_path / "out").exists()
    result = run("--discrepancy", "all", length=LENGTH)
    assert result.exit_code == 0, result.output
    assert result.stderr.count("Left out, as it does not suit the problem") == len(VARIANTS) - 1
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["none"]
    assert "Discrepancies compared" not in result.output
