"""`run_paper` on one experiment, from an empty directory to one that holds other people's files."""

import json
from dataclasses import replace

import matplotlib.image
import numpy as np
import pandas as pd
import pytest

from fmu.analysis.convergence.diagnosis import maxima_of
from fmu.analysis.trace.conversion import load_trace
from fmu.analysis.trace.reading import parameter_names
from fmu.paper import run_paper
from fmu.paper.run import file_names
from fmu.report.document import Page
from fmu.report.files import MANIFEST
from fmu.report.pages import sampler_page
from fmu.report.plots import DPI, plot_corner

COARSER = 4
"""Coarse pictures take less time."""
DRAWN = "slice"
"""The sampler whose page is written; the other pages have a title alone, for what they say is of other tests."""


@pytest.fixture(scope="module")
def out(plan, result, wrong_model, quick_figures, no_pictures, tmp_path_factory):
    """The files on the experiment that the other tests compute; pages, and large figures, are of other tests."""

    def page_of(run, *more):
        return sampler_page(run, *more) if run.name == DRAWN else Page(run.name, "", "", (), (), (), "")

    def corner_of_two(trace, *more):
        return plot_corner(trace, *more, names=parameter_names(trace)[:2])

    directory = tmp_path_factory.mktemp("paper") / "results"
    directory.mkdir()
    (directory / "notes.md").write_text("mine")
    with pytest.MonkeyPatch.context() as patch:
        for module in ("fmu.paper.figures", "fmu.paper.run"):
            patch.setattr(f"{module}.DPI", DPI // COARSER)
        patch.setattr("fmu.paper.figures.plot_corner", corner_of_two)
        patch.setattr("fmu.report.pages.sampler_page", page_of)
        patch.setattr("fmu.paper.run.compute", lambda *experiment: result)
        patch.setattr("fmu.paper.run.study_wrong_model", lambda *experiment: wrong_model)
        run_paper(directory, plan=plan, workers=1)
    return directory


def files(directory):
    return {path.relative_to(directory).as_posix() for path in directory.rglob("*") if path.is_file()}


def test_writes_what_it_announces_and_leaves_the_rest(out, plan):
    assert files(out) == {*file_names(plan), MANIFEST, "notes.md"}
    assert (out / "notes.md").read_text() == "mine"
    assert set(json.loads((out / MANIFEST).read_text())["files"]) == files(out) - {MANIFEST, "notes.md"}


def test_numbers_in_the_files_are_those_of_the_runs(out, findings):
    parameters = pd.read_csv(out / "section-shape" / "parameters.csv", index_col="parameter")
    np.testing.assert_array_equal(parameters["long_hmc_mean"], findings.parameters["long_hmc_mean"])
    trace = load_trace(out / "traces" / "section-shape-hmc-long.nc")
    assert float(trace["posterior"]["Ix1"].mean()) == pytest.approx(parameters.loc["Ix1", "long_hmc_mean"])
    assert maxima_of(trace)[0].theta[0] == pytest.approx(parameters.loc["Ix1", "maximum"])
    recomputed = pd.read_csv(out / "recomputed.csv")
    assert len(recomputed) == 40
    assert recomputed["within"].all()


def test_pages(out):
    summary = (out / "README.md").read_text()
    assert "[section-shape](section-shape/tables.md)" in summary
    assert "34 of 40 published frequencies come out of one model as printed; 5 more" in summary
    assert "fmu paper --out results" in summary
    for name in ("errata.md", "recomputed.md", "section-shape/tables.md"):
        assert (out / name).read_text().startswith("# ")
    assert str(out) not in summary


def test_figures_can_be_read(out):
    for path in (out / "section-shape").glob("*.png"):
        image = matplotlib.image.imread(path)
        assert min(image.shape[:2]) > 400 / COARSER
        assert np.ptp(image[..., :3]) > 0.5


def test_foreign_files_stop_the_command_before_it_computes(plan, tmp_path, monkeypatch):
    (tmp_path / "errata.md").write_text("mine")
    monkeypatch.setattr("fmu.paper.run.run_experiment", None)
    with pytest.raises(ValueError, match=r"did not write .*\(errata.md\)"):
        run_paper(tmp_path, plan=plan, workers=1)
    assert files(tmp_path) == {"errata.md"}
    assert (tmp_path / "errata.md").read_text() == "mine"


def test_a_failing_experiment_leaves_the_results_as_they_were(plan, tmp_path, monkeypatch):
    def fail(*_):
        raise RuntimeError("no luck")

    monkeypatch.setattr("fmu.paper.run.run_experiment", fail)
    with pytest.raises(RuntimeError, match="no luck"):
        run_paper(tmp_path / "results", plan=replace(plan, seed=2), workers=1)
    assert list(tmp_path.iterdir()) == []
