"""Models in OpenSees in problem files: by terms and at every theta, and what is wrong told at its place."""

import numpy as np
import pytest
from click.testing import CliRunner
from numpy.testing import assert_allclose

import fmu
from fmu import cli
from fmu.config import ConfigurationError, load
from fmu.config.template import write_template

pytest.importorskip("openseespy.opensees", reason="needs openseespy: pip install 'fmu[opensees]'")

TRUTH = np.array([1.95e11, 1.6e7])


def changed(folder, *pairs, module=()):
    path = write_template("opensees", folder)
    for file, replaced in ((path, pairs), (folder / "portal.py", module)):
        text = file.read_text()
        for old, new in replaced:
            assert old in text
            text = text.replace(old, new)
        file.write_text(text)
    return path


def test_terms_and_solves_at_every_theta_agree(tmp_path):
    terms = load(changed(tmp_path / "terms"))
    anew = load(changed(tmp_path / "anew", ("#: per_theta = false ", "per_theta = true ")))
    theta = np.random.default_rng(1).uniform(terms.lower, terms.upper, (5, 2))
    assert_allclose(anew.frequencies(theta), terms.model.truth.frequencies(theta), rtol=1e-8)
    assert_allclose(anew.log_prob(theta), terms.log_prob(theta), atol=1e-2)  # of the reduced model
    assert terms.model.structure.notes[0] == "The stiffness is a sum of 3 terms: constant, k feet and E beam."
    assert anew.configuration()["model"]["sha256"]


def test_workers_build_their_own_models(tmp_path):
    problem = load(changed(tmp_path / "anew", ("#: per_theta = false ", "per_theta = true ")))
    theta = np.random.default_rng(2).uniform(problem.lower, problem.upper, (4, 2))
    other = load(tmp_path / "anew" / "opensees.toml")
    with fmu.engine(workers=2) as engine, other.model.functions[0].spread_over(engine):
        assert_allclose(other.frequencies(theta), problem.frequencies(theta), rtol=1e-12)


def test_a_run_has_the_planted_truth(tmp_path):
    exact = load(changed(tmp_path / "a")).model.truth.frequencies(TRUTH[None])[0]
    measured = (exact * (1.0 + 0.001 * np.array([1.0, -1.0, 0.5, -0.5]))).tolist()
    path = changed(
        tmp_path / "b",
        ("frequencies = [9.93, 28.24, 66.33, 71.65] ", f"frequencies = {measured} "),
        ("sd = [0.03, 0.1, 0.2, 0.2]", f"sd = {(0.0015 * exact).tolist()}"),
    )
    words = ["run", str(path), "--draws", "300", "--warmup", "200", "--progress", "none", "--no-report"]
    outcome = CliRunner().invoke(cli.main, [*words, "--out", str(tmp_path / "out")])
    assert outcome.exit_code == 0, outcome.output
    draws = fmu.load_trace(tmp_path / "out" / "mixture.nc")["posterior"]
    for name, value in zip(("E beam", "k feet"), TRUTH, strict=True):
        assert abs(float(draws[name].mean()) - value) < 3.0 * float(draws[name].std())
    assert float(draws["E beam"].std()) < 0.02 * TRUTH[0]


@pytest.mark.parametrize(
    ("pairs", "module", "said"),
    [
        ([('"portal.py"', '"gate.py"')], [], "model.file: must be in a module beside the file or installed"),
        ([('"portal.py"', '"portal"')], [], "model.file: must be a Python file beside this one, as portal.py"),
        ([('"portal.py"', '"../portal.py"')], [], "model.file: must be a Python file beside this one"),
        ([], [("def build(theta", "def make(theta")], "model.file: must be in the module portal (got 'build')"),
        ([], [("E_beam, k = theta", "E_beam, k, m = theta")], "model.file: must work at [210000000000.0, 1"),
        ([], [("    ops.geomTransf", "    raise SystemExit(3)\n    ops.geomTransf")], "(SystemExit: 3)"),
        ([], [("-ndf\", 3", "-ndf\", 2")], "model.file: must work at ["),
        ([], [(", \"-mass\", RHO * A, \"-cMass\"", "")], "model.file: must give mass (that of OpenSees is zero)"),
        ([], [("PARTS = 6.0, 4.0", "PARTS = 6.0, float('nan')")], "OpenSees must assemble a finite stiffness"),
        ([], [("places = [(0.0, HEIGHT * s)", "places = [(0.0, HEIGHT * s * E_beam / 2.1e11)")],
         "; with per_theta = true the model may depend on the parameters in any way"),
        ([], [('1, k)', '1, 1e7)')], "k feet must change the matrices"),
        ([], [("ops.fix(foot, 1, 1, 0)", "pass")], "model.file: the structure is a mechanism"),
        ([('[7, "x"]', '[101, "x"]')], [], "measurement.sensors.0: must be a point and a direction that are free"),
        ([("#: modes = 20 ", "modes = 0 ")], [], "model.modes: must be greater than or equal to 1 (got 0)"),
        ([('name = "E beam"', 'name = "E beam"\nproperty = "E"')], [], "is allowed for frames only"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_told_at_its_place(tmp_path, pairs, module, said):
    with pytest.raises(ConfigurationError) as told:
        load(changed(tmp_path / "a", *pairs, module=module))
    assert said in str(told.value)
