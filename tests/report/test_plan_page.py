"""The page and the files of a planned test, from a problem file without a measurement."""

import re
import tomllib

import numpy as np
import pytest
from click.testing import CliRunner

import fmu
from fmu.cli import main
from fmu.formats.modes.uff import write_test_geometry

pytestmark = pytest.mark.usefixtures("quick_figures")

FILE = """
name = "portal"

[model]
type = "frame"
[model.materials.steel]
E = 2.1e11
nu = 0.3
rho = 7850.0
[model.sections.tube]
rectangle = { width = 0.1, height = 0.15 }
[model.points]
foot = [0.0, 0.0, 0.0]
corner = [0.0, 0.0, 3.0]
tip = [4.0, 0.0, 3.0]
[model.supports]
foot = "clamped"
[[model.members]]
from = "foot"
to = "corner"
group = "column"
section = "tube"
material = "steel"
elements = 4
[[model.members]]
from = "corner"
to = "tip"
group = "beam"
section = "tube"
material = "steel"
elements = 4

[plan]
sensors = 3
directions = ["x", "z"]
modes = 3
mounted = [["tip", "z"]]
exclude = ["corner"]

[[plan.changes]]
name = "50 kg at the tip"
masses = [{ place = "tip", mass = 50.0 }]

[[parameters]]
name = "E column"
property = "E"
groups = ["column"]
unit = "N/m²"
start = 2.1e11
lower = 1.5e11
upper = 2.7e11
prior = { distribution = "normal", mean = 2.1e11, sd = 2e10 }

[[parameters]]
name = "E beam"
property = "E"
groups = ["beam"]
unit = "N/m²"
start = 2.1e11
lower = 1.5e11
upper = 2.7e11
prior = { distribution = "normal", mean = 2.1e11, sd = 2e10 }
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    found = tmp_path_factory.mktemp("plan")
    (found / "portal.toml").write_text(FILE, encoding="utf-8")
    return found


@pytest.fixture(scope="module")
def planned(folder):
    arguments = ["plan", str(folder / "portal.toml"), "--draws", "4", "--out", str(folder / "out")]
    return CliRunner().invoke(main, arguments)


def test_the_command_says_what_the_plan_tells(planned):
    assert planned.exit_code == 0, planned.output
    assert "nats of information" in planned.output
    assert "50 kg at the tip" in planned.output
    assert "Recommended." in planned.output


def test_the_page_has_its_figures_and_tables(planned, folder):
    page = (folder / "out" / "index.html").read_text(encoding="utf-8")
    assert planned.exit_code == 0
    for words in ("Is the plan recommended?", "upper bound", "AutoMAC", "effective independence", "E beam"):
        assert words in page
    assert page.count("<svg") >= 4


def test_the_measurement_can_be_run_when_filled_in(planned, folder):
    text = (folder / "out" / "measurement.toml").read_text(encoding="utf-8")
    table = tomllib.loads(text)["measurement"]
    assert len(table["sensors"]) == 4
    assert table["sensors"][0] == ["tip", "z"]
    assert np.shape(table["shapes"]) == (3, 4)
    start = FILE.index("[plan]")
    whole = FILE[:start] + text + FILE[FILE.index("[[parameters]]") :]
    (folder / "filled.toml").write_text(whole, encoding="utf-8")
    problem = fmu.load(folder / "filled.toml")
    start_hz = problem.frequencies(problem.start)
    np.testing.assert_allclose(start_hz, table["frequencies"], rtol=1e-4)


def test_the_measurement_has_the_planned_errors_beside_an_error_model_with_its_own(folder):
    """It had an sd, which fmu refused beside that of the [[error]], and the plan ignored the latter."""
    noise = '[[noise]]\nname = "s"\nstart = 0.02\nlower = 0.001\nupper = 0.1\n'
    error = f'{noise}\n[[error]]\nof = "frequencies"\nsd = "s"\n'
    whole = FILE.replace("[model]", f"{error}\n[model]", 1)
    (folder / "own.toml").write_text(whole, encoding="utf-8")
    arguments = ["plan", str(folder / "own.toml"), "--draws", "2", "--out", str(folder / "of_own")]
    found = CliRunner().invoke(main, arguments)
    assert found.exit_code == 0, found.output
    text = (folder / "of_own" / "measurement.toml").read_text(encoding="utf-8")
    (folder / "own_filled.toml").write_text(whole.replace("[plan]", f"{text}\n[plan]"), encoding="utf-8")
    problem = fmu.load(folder / "own_filled.toml")
    sd = tomllib.loads(re.search(r"# (sd = .*)", text)[1])["sd"]
    np.testing.assert_allclose(sd, 0.02 * np.asarray(problem.data.frequencies_hz), rtol=1e-5)
    assert problem.data.sd_hz is None


def test_sensors_are_written_as_table_and_universal_file(planned, folder):
    rows = (folder / "out" / "sensors.csv").read_text(encoding="utf-8").splitlines()
    assert rows[0] == "channel,sensor,place,direction,x,y,z,mounted"
    assert len(rows) == 5
    assert rows[1].split(",")[2] == "tip"
    text = (folder / "out" / "geometry.uff").read_text(encoding="ascii")
    points = [line.split() for line in text.splitlines() if len(line.split()) == 7]
    places = [[float(x) for x in row.split(",")[4:7]] for row in rows[1:]]
    np.testing.assert_allclose([[float(x) for x in point[4:]] for point in points], places)


def test_trace_lines_have_eight_numbers_a_line():
    lines = write_test_geometry(np.arange(30.0).reshape(10, 3)).splitlines()
    at = lines.index("    82")
    assert [len(line.split()) for line in lines[at + 3 : at + 5]] == [8, 2]


def test_a_file_with_a_plan_alone_cannot_be_run(folder):
    with pytest.raises(ValueError, match=r"measurement: must be given.*a plan only, which fmu plan reads"):
        fmu.load(folder / "portal.toml")


def test_every_mistake_of_a_plan_is_said_at_its_key(folder):
    broken = FILE.replace("sensors = 3", "sensors = 0").replace("modes = 3", "modes = []")
    (folder / "broken.toml").write_text(broken, encoding="utf-8")
    found = CliRunner().invoke(main, ["plan", str(folder / "broken.toml")])
    assert found.exit_code == 2
    assert "plan.sensors" in found.output
    assert "plan.modes" in found.output
    many = FILE.replace("modes = 3", "modes = 900")
    (folder / "many.toml").write_text(many, encoding="utf-8")
    found = CliRunner().invoke(main, ["plan", str(folder / "many.toml")])
    assert "plan.modes: must be at most 48, the degrees of freedom (got 900)" in " ".join(found.output.split())


TESTS = """
reference = "before"
damage = { of = ["E column"], beyond = 0.1 }

[[tests]]
name = "May"
group = "before"
frequencies = [2.145, 3.33]
sd = [0.02, 0.03]

[[tests]]
name = "June"
group = "after"
frequencies = [2.03, 3.15]
sd = [0.04, 0.06]
"""


def of_damage(folder, name, *changes):
    """Write a problem file with two tests and a plan of the next one; return its path."""
    reference, damage, tests = TESTS.strip().split("\n", 2)
    text = FILE.replace("\n[model]", f"\n{reference}\n[model]", 1).replace("exclude", f"{damage}\nexclude")
    text = text.replace("[[parameters]]", f"{tests}\n[[parameters]]", 1)
    text = text.replace("sd = 2e10 }", 'sd = 2e10 }\nvaries = "damage"', 1)
    for old, new in changes:
        text = text.replace(old, new)
    (folder / name).write_text(text, encoding="utf-8")
    return str(folder / name)


def test_the_next_test_after_several_is_planned_for_a_decision_about_damage(folder):
    file = of_damage(folder, "damage.toml", ("modes = 3", "modes = 3\nfrequency_sd = 0.005"))
    found = CliRunner().invoke(main, ["plan", file, "--draws", "4", "--out", str(folder / "damage")])
    assert found.exit_code == 0, found.output
    assert "The probability that E column has lost more than 10 %" in " ".join(found.output.split())
    page = (folder / "damage" / "index.html").read_text(encoding="utf-8")
    assert "Probability of a loss of more than 10 %: before the test" in page
    assert "E column loss [after]" in page
    assert re.search(r"P of damage &gt; 99 % if there is, &lt; 1 % if not", page)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("beyond = 0.1", "beyond = 0.7"), "plan.damage.beyond: must be less than 0.5 (got 0.7)"),
        (("exclude", 'target = ["E beam"]\nexclude'), "plan.damage: must not be given with target"),
        (('of = ["E column"]', 'of = ["E beam"]'), "plan.damage.of: must name parameters that vary by damage"),
        (("exclude", 'like = "August"\nexclude'), "plan.like: must be one of May, June (got 'August')"),
        (('"tip", "z"', '"roof", "z"'), "plan.mounted.0: must be a place and a direction"),
    ],
)
def test_mistakes_of_a_plan_for_damage(folder, change, said):
    found = CliRunner().invoke(main, ["plan", of_damage(folder, "wrong.toml", change), "--draws", "4"])
    assert found.exit_code != 0
    assert said in " ".join(found.output.split())


def test_more_sensors_than_places_are_refused_by_their_option(folder):
    found = CliRunner().invoke(main, ["plan", of_damage(folder, "many.toml"), "--sensors", "500"])
    assert "--sensors: must be at most" in " ".join(found.output.split())


def test_simulated_tests_are_on_the_page(folder):
    problem = fmu.expected_modes  # a plan from Python, of a structure without a drawing
    model = fmu.SeparableModel.from_terms(
        ["k1", "k2"], [([[1e6, 0.0], [0.0, 0.0]], "k1"), ([[1e6, -1e6], [-1e6, 1e6]], "k2")], [np.eye(2) * 1e3]
    )
    parameters = [fmu.Parameter(name, 1.0, 0.7, 1.3, fmu.Normal(0.1, mean=1.0)) for name in ("k1", "k2")]
    updating = fmu.UpdatingProblem(model, problem(model, parameters, 2), parameters)
    plan = fmu.plan(updating, 2, draws=8)
    found = fmu.simulate_plan(plan, 1, choices=[], draws=60)
    assert found.ratios().shape == (1, 2)
    assert 0.7 < np.median(found.ratios()) < 1.4
    page = fmu.write_plan(plan, folder / "python", found).read_text(encoding="utf-8")
    assert "What the expected accuracy is worth" in page
    assert not (folder / "python" / "geometry.uff").exists()
    assert re.search(r"Real sd [0-9.]+ of the expected", page)
    with pytest.raises(ValueError, match="choices: must be of this plan, effective independence"):
        fmu.simulate_plan(plan, 1, choices=["best guess"])


def test_a_mode_that_the_sensors_do_not_see_is_left_out_of_the_measurement(folder):
    """Two masses on three springs, and a third mass beside them; one sensor sees the one or the other."""
    K = np.zeros((3, 3))
    K[:2, :2], K[2, 2] = [[2.0, -1.0], [-1.0, 2.0]], 5.0
    model = fmu.SeparableModel.from_terms(["k"], [(1e5 * K, "k")], [np.eye(3) * 100.0])
    parameter = fmu.Parameter("k", 1.0, 0.5, 2.0, fmu.Normal(0.1, mean=1.0))
    updating = fmu.UpdatingProblem(model, fmu.expected_modes(model, [parameter], 3), [parameter])
    plan = fmu.plan(updating, 1, draws=4)
    fmu.write_plan(plan, folder / "unseen")
    text = (folder / "unseen" / "measurement.toml").read_text(encoding="utf-8")
    assert "nan" not in text
    assert "# The sensors do not see mode" in text
    table = tomllib.loads(text)["measurement"]
    assert len(table["frequencies"]) == len(table["labels"]) == len(table["shapes"]) < 3
