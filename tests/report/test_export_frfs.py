"""Export of a run on frequency response functions: updated stiffness and damping, and the table of the data."""

import tomllib

import numpy as np

import fmu
from fmu.report.export import export
from tests.report.exported import run


def test_the_updated_file_has_stiffness_and_damping(tmp_path):
    problem, trace = run(fmu.cases.path("cantilever-frf"), tmp_path / "run", draws=8, warmup=8)
    written = export(tmp_path / "run")
    folder = written.directory
    assert "cantilever-frf/frfs.csv" in written.files
    start = {
        one["name"]: one["start"] for one in tomllib.loads((folder / "updated.toml").read_text())["parameters"]
    }
    for name in ("E1", "E5", "zeta1", "zeta5"):
        np.testing.assert_allclose(start[name], float(trace["posterior"][name].mean()), rtol=1e-12)
    updated = fmu.load(folder / "updated.toml")
    assert updated.log_prob(updated.start) > updated.log_prob(problem.start)
