"""Models that are the user's own Python: found, imported, run, and every way in which they can be wrong."""

import re
import sys
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

import fmu
from fmu import cli
from fmu.config import ConfigurationError, load
from tests.shear_building import shear_building

MODULE = """\
import numpy as np

from masses import M

K1, K2 = np.array([[1.0, 0.0], [0.0, 0.0]]), np.array([[1.0, -1.0], [-1.0, 1.0]])


def modes(theta):
    size = 1.0 / np.sqrt(M)
    lam, y = np.linalg.eigh(size[:, None] * (theta[0] * K1 + theta[1] * K2) * size)
    return {"frequencies": np.sqrt(lam) / (2 * np.pi), "shapes": size[:, None] * y}


class Surrogate:
    @staticmethod
    def frequencies(theta):
        return np.stack([modes(point)["frequencies"] for point in theta])


two = 2


def wrong(theta):
    raise RuntimeError("no licence")


def one(theta):
    return [4.0]


def nothing(theta):
    return [float("nan"), 9.0]


def words(theta):
    return "4.0, 9.0"


def table(theta):
    return np.ones((2, 2))


def stop(theta):
    raise SystemExit(3)
"""

TOML = """\
name = "two storeys"

[model]
type = "python"
function = "storeys:modes"

[measurement]
frequencies = [4.1, 10.9]
sd = 0.05
shapes = [[0.6, 1.0], [1.0, -0.6]]
sensors = [["first", "x"], ["second", "x"]]

[[parameters]]
name = "k1"
start = 2.9e7
lower = 1e7
upper = 6e7

[[parameters]]
name = "k2"
start = 2.9e7
lower = 1e7
upper = 6e7
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("storeys")
    (path / "storeys.py").write_text(MODULE)
    (path / "masses.py").write_text("import numpy as np\n\nM = np.array([16.5e3, 16.1e3])\n")
    (path / "broken.py").write_text("def modes(theta:\n")
    (path / "quits.py").write_text("raise SystemExit(1)\n")
    (path / "needs.py").write_text("import no_such_package\n")
    (path / "two.toml").write_text(TOML)
    return path


def loaded(folder, text):
    (folder / "changed.toml").write_text(text)
    return load(folder / "changed.toml")


def test_a_function_beside_the_file(folder):
    path, modules = list(sys.path), set(sys.modules)
    problem = load(folder / "two.toml")
    model = shear_building(["k1", "k2"], mass=[16.5e3, 16.1e3])
    data = fmu.ModalData([4.1, 10.9], sensors=[(0, "x"), (1, "x")], shapes=[[0.6, 1.0], [1.0, -0.6]])
    built = fmu.UpdatingProblem(model, data, problem.parameters, beta=0.5 / 0.05**2)
    theta = built.sample_prior(np.random.default_rng(1), 30)
    assert_allclose(problem.log_prob(theta), built.log_prob(theta), rtol=1e-9)
    assert problem.model.by_shape
    assert problem.configuration()["model"]["function"] == "storeys:modes"
    assert sys.path == path
    assert not {"storeys", "masses"} & (set(sys.modules) - modules)
    assert not (folder / "__pycache__").exists()


def test_a_batched_function_in_a_class(folder):
    text = TOML.replace('"storeys:modes"', '"storeys:Surrogate.frequencies"\nbatched = true\nstep = 1e-3')
    problem = loaded(folder, text)
    theta = problem.sample_prior(np.random.default_rng(1), 10)
    assert_allclose(problem.log_prob(theta), load(folder / "two.toml").log_prob(theta), rtol=1e-12)
    assert problem.model.functions[0].step == 1e-3


def test_each_file_has_the_modules_of_its_own_folder(folder, tmp_path):
    (tmp_path / "storeys.py").write_text(MODULE)
    (tmp_path / "masses.py").write_text("import numpy as np\n\nM = np.array([33e3, 32.2e3])\n")
    (tmp_path / "two.toml").write_text(TOML)
    light, heavy, again = load(folder / "two.toml"), load(tmp_path / "two.toml"), load(folder / "two.toml")
    assert_allclose(heavy.frequencies(heavy.start), light.frequencies(light.start) / np.sqrt(2.0), rtol=1e-12)
    assert_allclose(again.frequencies(again.start), light.frequencies(light.start), rtol=1e-12)
    (tmp_path / "masses.py").write_text("import numpy as np\n\nM = np.array([66e3, 64.4e3])\n")
    edited = load(tmp_path / "two.toml")
    assert_allclose(edited.frequencies(edited.start), light.frequencies(light.start) / 2.0, rtol=1e-12)


def test_a_package_beside_the_file(tmp_path):
    (tmp_path / "bridge").mkdir()
    (tmp_path / "bridge" / "__init__.py").write_text("")
    (tmp_path / "bridge" / "masses.py").write_text("import numpy as np\n\nM = np.array([16.5e3, 16.1e3])\n")
    (tmp_path / "bridge" / "modal.py").write_text(MODULE.replace("from masses", "from .masses"))
    problem = loaded(tmp_path, TOML.replace("storeys:modes", "bridge.modal:modes"))
    assert problem.model.by_shape
    assert "bridge" not in sys.modules


def test_an_installed_function(tmp_path):
    problem = loaded(tmp_path, TOML.replace("storeys:modes", "numpy:sqrt"))
    assert_allclose(problem.frequencies(problem.start), np.sqrt(problem.start))


BROKEN = [
    (
        "storeys:modes",
        "towers:modes",
        "model.function: must be in a module beside the file or installed (got 'towers')",
    ),
    ("storeys:modes", "storeys.floors:modes", "model.function: must be in a module"),
    ("storeys:modes", "storeys:shapes", "model.function: must be in "),
    ("storeys:modes", "storeys:two", "model.function: must be a function (got storeys:two, of type int)"),
    ("storeys:modes", "storeys", 'model.function: must be "module:function"'),
    ("storeys:modes", "../storeys:modes", 'model.function: must be "module:function"'),
    (
        "storeys:modes",
        "broken:modes",
        "model.function: must be in a module that can be imported (broken: SyntaxError",
    ),
    (
        "storeys:modes",
        "quits:modes",
        "model.function: must be in a module that can be imported (quits: SystemExit: 1)",
    ),
    ("storeys:modes", "needs:modes", "(needs: ModuleNotFoundError: No module named 'no_such_package')"),
    (
        "storeys:modes",
        "storeys:wrong",
        "model.function: must work at the start [29000000.0, 29000000.0] (RuntimeError: no",
    ),
    (
        "storeys:modes",
        "storeys:stop",
        "model.function: must work at the start [29000000.0, 29000000.0] (SystemExit: 3)",
    ),
    (
        "storeys:modes",
        "storeys:one",
        "model.function: must give the measured modes, numbers [1, 2] (gave 1 modes)",
    ),
    (
        "storeys:modes",
        "storeys:nothing",
        "model.function: frequencies: must be finite and not negative (got [nan, 9.0])",
    ),
    ("storeys:modes", "storeys:words", "frequencies: must be real numbers (got str of <U8)"),
    ("storeys:modes", "storeys:table", "frequencies: must have shape (n,) (got (2, 2))"),
    ('modes"', 'modes"\nbatched = "yes"', "model.batched: must be a valid boolean (got 'yes')"),
    ('modes"', 'modes"\nstep = 0.5', "model.step: must be less than or equal to 0.1 (got 0.5)"),
    ('modes"', 'modes"\ncolour = 1', "model.colour: is not a known key"),
    (
        'type = "python"',
        'type = "pyhton"',
        "model.type: must be one of frame, matrices, exports, command, opensees, python (got 'pyhton')",
    ),
    ('name = "k1"', 'name = "k1"\nproperty = "E"', "parameters.0.property: is allowed for frames only"),
    (
        'sensors = [["first", "x"], ["second", "x"]]',
        'sensors = [["first", "x"]]',
        "shapes: must have shape (1, 2)",
    ),
    ("frequencies = [4.1, 10.9]", "frequencies = [4.1, 10.9]\nnumbers = [1, 7]", None),
]


@pytest.mark.parametrize(("old", "new", "expected"), BROKEN)
def test_what_is_wrong_is_said(folder, old, new, expected):
    assert old in TOML
    path = list(sys.path)
    text = TOML.replace(old, new, 1)
    if expected is None:  # by shape, numbers do not matter; by number they do
        assert loaded(folder, text).model.by_shape
        text, expected = (
            text.replace("[model]", 'pairing = "index"\n\n[model]', 1),
            "numbers [1, 7] (gave 2 modes)",
        )
    with pytest.raises(ConfigurationError) as caught:
        loaded(folder, text)
    assert expected in str(caught.value)
    assert sys.path == path


def test_the_modal_residual_needs_matrices(folder):
    text = TOML.replace("[model]", 'error = "modal-residual"\n\n[model]', 1).replace("sd = 0.05", "beta = 1.0")
    with pytest.raises(ConfigurationError, match="modal residual needs a SeparableModel"):
        loaded(folder, text)


NASTY = st.sampled_from(
    [
        '""',
        "0",
        "-1",
        "1e400",
        "nan",
        "inf",
        "true",
        "[]",
        "{}",
        '"x"',
        '"a:b"',
        "[[]]",
        '"\\u0000"',
        '"storeys:two"',
        "[1.0]",
    ]
)


@settings(
    max_examples=60, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(data=st.data())
def test_values_changed_at_random_never_crash(folder, data):
    places = [m.span(1) for m in re.finditer(r"= (.+)$", TOML, re.MULTILINE)]
    first, last = data.draw(st.sampled_from(places))
    with suppress(ConfigurationError):
        loaded(folder, TOML[:first] + data.draw(NASTY) + TOML[last:])


@pytest.mark.usefixtures("no_pictures")
def test_a_run_with_a_report(folder, tmp_path, monkeypatch):
    """From the file to the pages; there is no structure to draw."""
    monkeypatch.chdir(tmp_path)
    arguments = ["run", str(folder / "two.toml"), "--draws", "20", "--warmup", "20", "--chains", "2"]
    result = CliRunner().invoke(cli.main, [*arguments, "--sampler", "hmc"], prog_name="fmu")
    assert result.exit_code == 0, result.output
    page = Path("runs/two-shape/report/index.html").read_text()
    assert "two storeys" in page
    assert 'id="identifiability"' in page
    assert 'id="shapes"' not in page
    assert 'id="mac"' not in page
    trace = fmu.load_trace("runs/two-shape/hmc.nc")
    stats = trace["sample_stats"]
    steps = stats.to_dataset().where(stats["candidate_log_weight"].isnull(), drop=True)  # the others are jumps
    assert int(steps["n_solves"].sum()) == 5 * int(steps["n_gradients"].sum())


def test_a_function_that_works_at_the_start_alone_is_checked(tmp_path, monkeypatch):
    """The prior predicts nothing where the model fails at all draws from it, and that is what is said."""
    monkeypatch.chdir(tmp_path)
    body = "    if theta[0] != 2.9e7: raise GeneratorExit\n    return [4.1, 10.9]\n"
    (tmp_path / "storeys.py").write_text(f"def modes(theta):\n{body}")
    text = re.sub(r"(?m)^s(hapes|ensors) = .*\n", "", TOML)
    (tmp_path / "two.toml").write_text(text)
    result = CliRunner().invoke(cli.main, ["check", "two.toml", "--draws", "5"], prog_name="fmu")
    assert result.exit_code == 0, result.output
    assert "The model failed at 5 of 5 prior draws." in result.output


def test_a_module_that_is_too_large_is_not_read(tmp_path):
    with (tmp_path / "storeys.py").open("wb") as file:
        file.truncate(2**30)
    (tmp_path / "two.toml").write_text(TOML)
    with pytest.raises(ConfigurationError, match=r"model\.function: storeys\.py must have at most 16777216 bytes"):
        load(tmp_path / "two.toml")
