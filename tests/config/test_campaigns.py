"""``campaign`` in ``[[tests]]``: several tests in one CSV table, from the file to the run."""

import numpy as np
import pytest
from click.testing import CliRunner
from numpy.testing import assert_allclose

import fmu
from fmu.cli import main
from fmu.config.mistakes import ConfigurationError
from tests.cli.runs import Cut, cut
from tests.config.test_tests_tables import K1, K2, LOADED, PLAIN, written
from tests.runs.keeping import at_keep

TABLE = """\
# tests of the winter
name;group;temperature;bend;sway
monday;old;5.0;4.4;11.5
tuesday;old;7.5;;11.6

wednesday;new;-2.0;4.3;NaN
"""
CAMPAIGN = '[[tests]]\ncampaign = "winter.csv"\nlabels = ["bend", "sway"]\nsd = [0.02, 0.05]\n'
SLOPE = 'slopes = { temperature = { distribution = "normal", sd = 0.005 } }\n'


def problem_in(folder, table=TABLE, *parts, tests=CAMPAIGN, k1=K1, **options):
    (folder / "winter.csv").write_text(table)
    return written(folder, k1, K2, tests, *parts, **options)


def mistakes(path):
    with pytest.raises(ConfigurationError) as raised:
        fmu.load(path)
    return [str(mistake) for mistake in raised.value.mistakes]


def test_a_row_is_a_test_and_a_missed_mode_is_left_out_of_it(tmp_path):
    problem = fmu.load(problem_in(tmp_path))
    by_hand = written(
        tmp_path,
        K1,
        K2,
        '[[tests]]\nname = "monday"\ngroup = "old"\nfrequencies = [4.4, 11.5]\nsd = [0.02, 0.05]\n'
        'labels = ["bend", "sway"]\nnumbers = [1, 2]\ncovariates = { temperature = 5.0 }',
        '[[tests]]\nname = "tuesday"\ngroup = "old"\nfrequencies = [11.6]\nsd = 0.05\n'
        'labels = ["sway"]\nnumbers = [2]\ncovariates = { temperature = 7.5 }',
        '[[tests]]\nname = "wednesday"\ngroup = "new"\nfrequencies = [4.3]\nsd = 0.02\n'
        'labels = ["bend"]\nnumbers = [1]\ncovariates = { temperature = -2.0 }',
    )
    assert problem.configuration() == fmu.load(by_hand).configuration()
    theta = [[0.9, 1.1], [1.2, 0.8]]
    assert_allclose(problem.log_prob(theta), fmu.load(by_hand).log_prob(theta), rtol=1e-12)


@pytest.mark.parametrize("cell", ["", "NaN", "missing"])
def test_a_covariate_that_was_not_measured_is_inferred_and_its_test_keeps_its_place(tmp_path, cell):
    problem = fmu.load(problem_in(tmp_path, TABLE.replace("7.5", cell), k1=K1 + SLOPE))
    assert [test.name for test in problem.tests] == ["monday", "tuesday", "wednesday"]
    assert [test.covariates["temperature"] for test in problem.tests] == [5.0, None, -2.0]
    assert "temperature [tuesday]" in problem.names
    tests = fmu.Test.from_csv(tmp_path / "winter.csv", ["bend", "sway"])
    assert [test.covariates["temperature"] for test in tests] == [5.0, None, -2.0]


def test_the_other_keys_hold_for_every_row_beside_tests_by_hand(tmp_path):
    keys = 'masses = [{ place = "roof", mass = 300.0 }]\nknown = { k2 = 1.0 }\ncovariates = { crowd = 3.0 }\n'
    beta = CAMPAIGN.replace("sd = [0.02, 0.05]", "beta = 1250.0")
    table = TABLE.replace("group;", "").replace("old;", "").replace("new;", "").replace("name", "test")
    by_hand = PLAIN + 'labels = ["bend", "sway"]\n'
    tests = fmu.load(problem_in(tmp_path, table, by_hand, tests=beta + keys + 'group = "late"\n')).tests
    assert [test.name for test in tests] == ["monday", "tuesday", "wednesday", "plain"]
    assert [test.group for test in tests] == ["late"] * 3 + ["old"]
    for test, temperature in zip(tests[:3], (5.0, 7.5, -2.0), strict=True):
        assert dict(test.masses) == {"roof": 300.0}
        assert dict(test.known) == {"k2": 1.0}
        assert dict(test.covariates) == {"crowd": 3.0, "temperature": temperature}
        assert_allclose(test.data.sd_hz, 0.02)


def test_python_reads_the_same_tests(tmp_path):
    expected = fmu.load(problem_in(tmp_path)).tests
    tests = fmu.Test.from_csv(tmp_path / "winter.csv", ["bend", "sway"], sd_hz=[0.02, 0.05])
    assert [test.as_dict() for test in tests] == [test.as_dict() for test in expected]
    assert [test.data.as_dict() for test in tests] == [test.data.as_dict() for test in expected]
    laden = fmu.Test.from_csv(tmp_path / "winter.csv", ["bend", "sway"], masses={"roof": 3.0}, known={"k2": 1.0})[
        1
    ]
    assert (dict(laden.masses), dict(laden.known)) == ({"roof": 3.0}, {"k2": 1.0})
    assert dict(laden.covariates)["temperature"] == 7.5
    with pytest.raises(
        ValueError, match=r"winter\.csv: column twist: must be in the table, which has name, group, "
    ):
        fmu.Test.from_csv(tmp_path / "winter.csv", ["twist"])


def test_covariance_shapes_and_numbers_of_a_row_are_of_its_modes(tmp_path):
    keys = (
        "covariance = [[4e-4, 1e-4], [1e-4, 9e-4]]\nnumbers = [2, 1]\n"
        'sensors = [["floor 1", "x"], ["roof", "x"]]\n'
        "shapes = [[1.0, -0.6], [0.6, 1.0]]\nuse = [true, true]\n"
    )
    path = problem_in(tmp_path, tests=CAMPAIGN.replace("sd = [0.02, 0.05]\n", keys))
    monday, tuesday, wednesday = (test.data for test in fmu.load(path).tests)
    assert_allclose(monday.covariance_hz2, [[4e-4, 1e-4], [1e-4, 9e-4]])
    assert_allclose(tuesday.covariance_hz2, [[9e-4]])
    assert_allclose(wednesday.covariance_hz2, [[4e-4]])
    assert [data.numbers for data in (monday, tuesday, wednesday)] == [(2, 1), (1,), (2,)]
    assert_allclose(tuesday.shapes, [[0.6], [1.0]])
    assert_allclose(wednesday.shapes, [[1.0], [-0.6]])


FIRST = "tests.0.campaign: winter.csv, "
WRONG = {
    "a missing column": (
        TABLE.replace("sway", "swag"),
        ["column sway: must be in the table, which has name, group, "],
    ),
    "no names": (TABLE.replace("name", "who"), ["column name: must be in the table, which has who, group, "]),
    "doubled names": (
        TABLE.replace("wednesday", "monday"),
        ["line 6, column name: must not be the name in line 3 (got 'monday'); rename one of the two tests"],
    ),
    "no frequency": (
        TABLE.replace(";;11.6", ";;nan"),
        ["line 4: must have a frequency in a column of bend, sway (got none); delete the line"],
    ),
    "text": (TABLE.replace("4.4", "4,4"), ["line 3, column bend: must be a positive number (got '4,4')"]),
    "a remark": (
        TABLE.replace("temperature", "remark").replace("-2.0", "snow"),
        ["line 6, column remark: must be a number (got 'snow'); leave the cell empty if "],
    ),
    "a mode that nobody measured": (
        TABLE.replace("4.4", "").replace("4.3;NaN", ";11.4"),
        ["column bend: must have a frequency in one line at least (got none); delete it here and in labels"],
    ),
    "identical tests": (
        "name,bend,sway\na,4.4,11.5\nb,4.4,11.5\nc,4.4,11.5\n",
        ["lines 2 to 4: must differ (got the same numbers in all lines); give what was measured in each test"],
    ),
    "a name that no trace can have": (
        TABLE.replace("monday", "a/b"),
        ["line 3, name: must "],
    ),
    "an empty name": (
        TABLE.replace("monday", ""),
        ["line 3, column name: must not be empty; give the test a name"],
    ),
    "a column without a name": (
        TABLE.replace("temperature", ""),
        ["every column must have a name, in the first line"],
    ),
}


@pytest.mark.parametrize("what", WRONG)
def test_a_wrong_table_is_told_with_file_line_and_column(what, tmp_path):
    table, expected = WRONG[what]
    found = mistakes(problem_in(tmp_path, table))
    assert len(found) == len(expected)
    for one, beginning in zip(found, expected, strict=True):
        assert one.startswith(FIRST + beginning)


def test_contradictions_between_rows_and_parameters_are_told_at_their_line(tmp_path):
    same = TABLE.replace("7.5", "5.0").replace("-2.0", "5.0")
    assert mistakes(problem_in(tmp_path, same, k1=K1 + SLOPE)) == [
        "parameters.0.slopes: temperature must differ between tests (got one value)"
    ]
    wind = SLOPE.replace("temperature", "wind")
    assert mistakes(problem_in(tmp_path, k1=K1 + wind)) == [
        f"{FIRST}line 3, covariates: must have wind, on which k1 depends (got none)"
    ]
    assert mistakes(
        problem_in(tmp_path, TABLE, PLAIN.replace("plain", "monday") + 'labels = ["bend", "sway"]\n')
    ) == ["tests.1.name: must not be that of winter.csv, line 3 (got 'monday')"]
    alone = "name,bend,sway\nmonday,4.4,11.5\n"
    assert mistakes(problem_in(tmp_path, alone)) == ["tests: must be at least 2 (got 1)"]
    twice = CAMPAIGN + 'group = "late"\ncovariates = { temperature = 3.0 }\n'
    assert mistakes(problem_in(tmp_path, tests=twice)) == [
        f"{FIRST}column {name}: must not be a key of [[tests]] too; delete one of them"
        for name in ("temperature", "group")
    ]


def test_wrong_keys_of_a_campaign(tmp_path):
    assert mistakes(problem_in(tmp_path, tests=CAMPAIGN.replace('labels = ["bend", "sway"]', ""))) == [
        "tests.0.labels: must be given with campaign, the headers of its columns with frequencies in the order of "
        "modes (got none)"
    ]
    assert mistakes(problem_in(tmp_path, tests=CAMPAIGN + 'name = "x"\n')) == [
        "tests.0.name: must not be given with campaign, whose table has the names (got x)"
    ]
    assert mistakes(problem_in(tmp_path, tests=CAMPAIGN.replace("[0.02, 0.05]", "[0.02]")))[0].startswith(
        "tests.0: sd must be 2, one per mode (got 1)"
    )
    assert mistakes(problem_in(tmp_path, tests=CAMPAIGN.replace("sd = [0.02, 0.05]", ""))) == [
        "tests.0: must have either sd or beta or covariance, as the file has no standard deviations"
    ]
    assert mistakes(problem_in(tmp_path, tests=CAMPAIGN.replace("winter", "summer")))[0].startswith(
        "tests.0.campaign: must be a file (no such file: "
    )
    assert mistakes(problem_in(tmp_path, tests=CAMPAIGN + "frequencies = [4.4]\n"))[0].startswith(
        "tests.0: must have one of "
    )
    assert mistakes(problem_in(tmp_path, tests=PLAIN.replace('name = "plain"', "") + LOADED)) == [
        "tests.0.name: is missing"
    ]


def test_a_function_gives_its_modes_in_the_order_of_the_labels_though_the_first_test_missed_one(tmp_path):
    (tmp_path / "storeys.py").write_text(
        "import numpy as np\n\n\ndef modes(theta):\n    return theta[0] * np.array([4.4, 11.5])\n"
    )
    model = '[model]\ntype = "python"\nfunction = "storeys:modes"\n'
    (tmp_path / "winter.csv").write_text("name,bend,sway\na,,11.6\nb,4.4,11.5\n")
    path = tmp_path / "function.toml"
    path.write_text(f'name = "function"\npairing = "index"\n{model}\n{CAMPAIGN}\n{K1}')
    problem = fmu.load(path)
    assert_allclose(problem.frequencies([1.0]), [11.5, 4.4, 11.5])


def test_check_run_and_resume(tmp_path, monkeypatch):
    """The table is read beside the problem file, from any folder, by the run and when it is resumed."""
    rng = np.random.default_rng(1)
    rows = [f"t{i},{4.4 * f},{11.5 * f if i != 2 else ''}" for i, f in enumerate(rng.normal(1.0, 0.02, 5))]
    home = tmp_path / "home"
    home.mkdir()
    path = problem_in(home, "name,bend,sway\n" + "\n".join(rows), k1=K1 + 'varies = "population"\n')
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    runner = CliRunner()
    checked = runner.invoke(main, ["check", str(path), "--draws", "20"])
    assert checked.exit_code == 0, checked.output
    assert "5 tests of one structure" in checked.output
    short = ["--draws", "10", "--warmup", "10", "--keep-draws", "5", "--no-report", "--out", "run"]
    with pytest.MonkeyPatch.context() as patch:
        at_keep(patch, 3, cut)
        with pytest.raises(Cut):
            runner.invoke(main, ["run", str(path), *short])
    table = (home / "winter.csv").read_text()
    (home / "winter.csv").write_text(table.replace("t4", "t5"))
    other = runner.invoke(main, ["run", "--resume", "run", "--no-report"])
    assert other.exit_code == 2
    assert 'problem.data.labels.7 "t4: bend" there, "t5: bend" here' in other.output
    (home / "winter.csv").write_text(table)
    again = runner.invoke(main, ["run", "--resume", "run", "--no-report"])
    assert again.exit_code == 0, again.output
    trace = fmu.load_trace(elsewhere / "run" / "gibbs.nc")
    assert list(trace["tests"]["test"].values) == [f"t{i}" for i in range(5)]
