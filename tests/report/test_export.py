"""An updated model is the one that was sampled, at its posterior, and comes back as a problem of its own."""

import tomllib

import numpy as np
import pandas as pd
import pytest
import scipy.linalg
from scipy.io import mmread

import fmu
from fmu.analysis.convergence.diagnosis import maxima_of
from fmu.config.template import write_template
from fmu.report.export import export
from tests.report.exported import run


@pytest.fixture(scope="module", params=["frame", "matrices"])
def done(request, tmp_path_factory):
    """A run on each template that has matrices, and what was exported of it."""
    folder = tmp_path_factory.mktemp(request.param)
    problem, trace = run(write_template(request.param, folder), folder / "runs" / "one", draws=25, warmup=25)
    return problem, trace, export(folder / "runs" / "one"), folder


def mean_of(trace):
    return np.array([float(trace["posterior"][name].mean()) for name in trace["posterior"].data_vars])


def test_matrices_have_the_frequencies_of_the_problem(done):
    problem, trace, written, _ = done
    K, M = (mmread(written.directory / f"{name}.mtx", spmatrix=False).toarray() for name in "KM")
    found = np.sqrt(scipy.linalg.eigh(K, M, eigvals_only=True)) / (2 * np.pi)
    exact = np.sqrt(problem.model.truth.modes(mean_of(trace)[None]).eigenvalues[0]) / (2 * np.pi)
    for frequency in exact:
        assert np.min(np.abs(found / frequency - 1.0)) < 1e-9
    np.testing.assert_allclose(problem.frequencies(mean_of(trace)), exact, rtol=1e-6)
    text = (written.directory / "K.mtx").read_text(encoding="ascii")
    assert text.startswith("%%MatrixMarket matrix coordinate real symmetric\n% Stiffness in N/m")
    assert "posterior mean" in text.splitlines()[1]


def test_rows_of_the_matrices_are_named(done):
    problem, _, written, _ = done
    table = pd.read_csv(written.directory / "dofs.csv", keep_default_na=False)
    dofs = problem.model.structure.dofs
    assert [(str(node), d) for node, d in zip(table["node"], table["direction"], strict=True)] == [
        (str(node), direction) for node, direction in dofs
    ]
    assert list(table["row"]) == list(range(1, len(dofs) + 1))
    if "x" in table:
        middle = table[table["place"] == "middle"]
        assert list(middle["direction"]) == ["x", "y", "z", "rx", "ry", "rz"]
        assert middle[["x", "y", "z"]].to_numpy().tolist() == [[3.0, 0.0, 4.0]] * 6


def test_values_are_those_of_the_trace(done):
    problem, trace, written, _ = done
    table = pd.read_csv(written.directory / "theta.csv", index_col="name", keep_default_na=False)
    assert tuple(table.index) == problem.names
    assert tuple(table["unit"]) == problem.units
    summary = fmu.summary(trace)
    np.testing.assert_allclose(table["mean"], summary["mean"])
    np.testing.assert_allclose(table["sd"], summary["sd"])
    np.testing.assert_array_equal(table["start"], problem.start)
    np.testing.assert_array_equal(table["value"], table["mean"])
    assert tuple(table["determined_by"]) == fmu.information(trace).basis


def test_the_updated_file_starts_where_the_posterior_is(done):
    problem, trace, written, folder = done
    path = written.directory / "updated.toml"
    updated = fmu.load(path)
    table = pd.read_csv(written.directory / "theta.csv")
    np.testing.assert_array_equal(updated.start, table["value"])
    np.testing.assert_allclose(updated.start, mean_of(trace), rtol=1e-12)  # the sum in another order
    np.testing.assert_array_equal(updated.lower, problem.lower)
    assert np.all((updated.start > updated.lower) & (updated.start < updated.upper))
    original = next(folder.glob("*.toml")).read_text(encoding="utf-8")
    changed = [line for line in path.read_text(encoding="utf-8").splitlines() if line not in original.splitlines()]
    assert changed[0].startswith("# The start values are the posterior mean of ")
    renamed = [line for line in changed[1:] if not line.startswith("start = ")]
    assert renamed == ([] if "points" in tomllib.loads(original)["model"] else ['file = "model-M.mtx"'])
    assert any("# the model before updating" in line for line in changed)
    found = [fmu.check(one, draws=10).modes.table()["error_percent"].abs().max() for one in (updated, problem)]
    assert found[0] < 0.7 * found[1]
    assert written.files == tuple(sorted(f.name for f in written.directory.iterdir() if f.name != "manifest.json"))


def test_the_highest_maximum(done, tmp_path):
    _, trace, _, folder = done
    written = export(folder / "runs" / "one", at="map", out=tmp_path / "there")
    table = pd.read_csv(tmp_path / "there" / "theta.csv", index_col="name")
    np.testing.assert_array_equal(table["value"], maxima_of(trace)[0].theta)
    assert "highest maximum of the posterior" in (written.directory / "updated.toml").read_text(encoding="utf-8")


def test_a_short_run_by_number(tmp_path):
    """It is exported with a warning, and the pairing that the run was given is in the updated file."""
    run(write_template("matrices", tmp_path), tmp_path / "out", pairing="index", draws=4, warmup=5)
    written = export(tmp_path / "out")
    assert any(remark.startswith("The run is not converged: ") for remark in written.remarks)
    updated = tomllib.loads((written.directory / "updated.toml").read_text(encoding="utf-8"))
    assert updated["pairing"] == "index"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"sampler": "mh"}, r"sampler: must be one of hmc \(got 'mh'\)"),
        ({"at": "median"}, r"at: must be one of \('mean', 'map'\) \(got 'median'\)"),
    ],
)
def test_what_is_asked_for_must_be_there(done, arguments, words):
    with pytest.raises(ValueError, match=words):
        export(done[3] / "runs" / "one", **arguments)


def test_nothing_to_export(tmp_path):
    with pytest.raises(ValueError, match="contains no traces"):
        export(tmp_path)
