"""``[measurement]``: where the modes come from, how far they are trusted, and what is wrong with either."""

import re
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fmu.config import ConfigurationError, load
from fmu.formats.modes.pyoma import save_pyoma
from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.errors.frequency import CorrelatedFrequencyTerm

GIVEN = """\
frequencies = [3.1, 9.8]
sd = 0.05
shapes = [[0.6, 1.0], [1.0, -0.6]]
sensors = [["first", "x"], ["second", "x"]]
"""
SENSORS = 'sensors = [["first", "x"], ["second", "-x"]]\n'
BY_NUMBER = 'name = "two storeys"', 'name = "two storeys"\npairing = "index"'
SHAPES = np.array([[0.6, 1.0], [1.0, -0.6]])


@pytest.fixture
def problem(folder, matrices_text):
    """Return a function that loads the two storeys with another measurement."""
    assert GIVEN in matrices_text

    def loaded(measurement, old="", new="", **options):
        path = folder / "storeys.toml"
        path.write_text(matrices_text.replace(GIVEN, measurement).replace(old, new))
        return load(path, **options)

    return loaded


@pytest.fixture
def mistakes(problem):
    def found(*arguments):
        with pytest.raises(ConfigurationError) as caught:
            problem(*arguments)
        return [str(mistake) for mistake in caught.value.mistakes]

    return found


def test_standard_deviations_belong_to_the_data(problem):
    found = problem(GIVEN)
    assert_array_equal(found.data.sd_hz, [0.05, 0.05])
    assert_allclose(found.likelihood.error.sd, 0.05)
    assert_array_equal(problem(GIVEN, beta=3.0).likelihood.beta, [3.0, 3.0])
    assert problem(GIVEN, beta=3.0).data.sd_hz is None
    weighted = problem(GIVEN.replace("sd = 0.05", "beta = [1.0, 2.0]"))
    assert weighted.data.sd_hz is None
    assert_array_equal(weighted.likelihood.beta, [1.0, 2.0])


def test_covariance(problem):
    covariance = [[0.01, 0.004], [0.004, 0.04]]
    found = problem(GIVEN.replace("sd = 0.05", f"covariance = {covariance}"))
    assert isinstance(found.likelihood.error, CorrelatedFrequencyTerm)
    assert_array_equal(found.data.covariance_hz2, covariance)


@pytest.mark.parametrize("name", ["covariance.csv", "covariance.npz"])
def test_covariance_in_a_file(problem, folder, name):
    covariance = np.array([[0.01, 0.004], [0.004, 0.04]])
    if name.endswith(".csv"):
        np.savetxt(folder / name, covariance, delimiter=",")
    else:
        np.savez(folder / name, covariance=covariance)
    found = problem(GIVEN.replace("sd = 0.05", f'covariance = "{name}"'))
    assert_array_equal(found.data.covariance_hz2, covariance)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "must be a file (no such file: "),
        ("0.01,0.004\n0.005,0.04", "must be symmetric (row 1, column 2 differs by 0.001)"),
        ("0.01,0.1\n0.1,0.04", "must be positive definite"),
        ("0.01", "must have shape (2, 2), modes x modes (got (1, 1))"),
    ],
)
def test_wrong_covariances_in_files(mistakes, folder, content, message):
    if content is not None:
        (folder / "covariance.csv").write_text(content)
    (mistake,) = mistakes(GIVEN.replace("sd = 0.05", 'covariance = "covariance.csv"'))
    assert mistake.startswith(f"measurement.covariance: {message}")


@pytest.mark.parametrize("scatter", ["each", "pooled"])
def test_repeated_tests(problem, scatter):
    rows = "tests = [[3.1, 9.8], [3.12, nan], [3.09, 9.9]]\n" + SENSORS
    found = problem(rows + f'scatter = "{scatter}"\n')
    expected = ModalData.from_tests([[3.1, 9.8], [3.12, np.nan], [3.09, 9.9]], scatter=scatter)
    assert_array_equal(found.data.frequencies_hz, expected.frequencies_hz)
    assert_array_equal(found.data.sd_hz, expected.sd_hz)


def test_joint_scatter_of_tests(problem):
    rows = [[3.1, 9.8], [3.12, 9.9], [3.09, 9.7], [3.11, 9.85], [3.1, 9.95]]
    found = problem(f'tests = {rows}\nscatter = "joint"\n')
    assert_array_equal(found.data.covariance_hz2, ModalData.from_tests(rows, scatter="joint").covariance_hz2)


SHAPES_OF_TESTS = np.array([[[0.6, 1.0], [1.0, -0.6]], [[-1.3, -1.9], [1.0, -0.6]], [[0.6, 1.05], [np.nan] * 2]])


def test_repeated_tests_from_a_table(problem, folder):
    rows = "test;sway;bend\nMonday 9:00;3.1;9.8\n# a comment\nMonday 9:30;3.12;\nlater;3.09;NaN\n;3.08;9.9\n"
    (folder / "tests.csv").write_text(rows)
    data = problem('tests_file = "tests.csv"\n' + SENSORS).data
    values = [[3.1, 9.8], [3.12, np.nan], [3.09, np.nan], [3.08, 9.9]]
    assert data.labels == ("sway", "bend")
    assert_array_equal(data.tests.frequencies_hz, values)
    assert_array_equal(data.sd_hz, ModalData.from_tests(values).sd_hz)
    (folder / "tests.csv").write_text("sway,bend\n3.1,9.8\n3.1,-2\n3.2,x\n")
    with pytest.raises(ConfigurationError) as caught:
        problem('tests_file = "tests.csv"\n')
    assert [str(mistake) for mistake in caught.value.mistakes] == [
        "measurement.tests_file: line 3, column bend: must be a positive number (got '-2')",
        "measurement.tests_file: line 4, column bend: must be a positive number (got 'x')",
    ]


def test_shapes_of_each_test(problem):
    """Brought to one scale and sign; their scatter is the standard deviation that errors of shapes take."""
    text = f"tests = [[3.1, 9.8], [3.12, 9.85], [3.09, 9.9]]\ntest_shapes = {SHAPES_OF_TESTS.tolist()}\n" + SENSORS
    with pytest.raises(ConfigurationError, match="errors: needs sd"):  # of the second mode there are but two alike
        problem(text, *OF_SHAPES)
    shapes = SHAPES_OF_TESTS.copy()
    shapes[2, 1] = [1.0, -0.7]
    data = problem(text.replace(str(SHAPES_OF_TESTS.tolist()), str(shapes.tolist())), *OF_SHAPES).data
    expected = ModalData.from_tests(data.tests.frequencies_hz, np.swapaxes(shapes, 1, 2), sensors=data.sensors)
    assert_array_equal(data.shapes, expected.shapes)
    assert_array_equal(data.shapes_sd, expected.shapes_sd)
    assert_array_equal(data.tests.freedom_of_shapes(data.shapes_sd), [2.0, 2.0])


OF_SHAPES = ('[[parameters]]\nname = "k1"', '[[error]]\nof = "shapes"\n\n[[parameters]]\nname = "k1"')


@pytest.mark.parametrize("sd", ["0.01", "[0.01, 0.02]", '"scatter"'])
def test_an_error_of_a_size_of_its_own_beside_tests(mistakes, sd):
    """Silently, it would have taken the place of the scatter that the tests were repeated for."""
    noise = '\n[[noise]]\nname = "scatter"\nstart = 0.01\nlower = 0.001\nupper = 0.1' if "scatter" in sd else ""
    table = f'[[error]]\nof = "frequencies"\nsd = {sd}\n{noise}\n[[parameters]]\nname = "k1"'
    (found,) = mistakes("tests = [[3.1, 9.8], [3.12, 9.85]]\n", '[[parameters]]\nname = "k1"', table)
    assert found.startswith(
        "error.0.sd: must not be given together with tests, whose scatter gives the error of their mean"
    )
    assert "model_sd" in found


def test_tables(problem, folder):
    (folder / "modes.csv").write_text("mode,frequency,sd\nsway,3.1,0.02\nbend,9.8,0.05\n")
    (folder / "shapes.csv").write_text("place,direction,bend,sway\nfirst,x,1.0,0.6\nsecond,-x,0.6,-1.0\n")
    data = problem('file = "modes.csv"\nshapes_file = "shapes.csv"\n').data
    assert data.labels == ("sway", "bend")
    assert_array_equal(data.sd_hz, [0.02, 0.05])
    assert_array_equal(data.shapes, [[0.6, 1.0], [-1.0, 0.6]])
    assert data.sensors == (("first", "x"), ("second", "-x"))
    own = 'file = "modes.csv"\nsd = 0.1\nnumbers = [2, 1]\nlabels = ["a", "b"]\n'
    mine = problem(own, *BY_NUMBER).data
    assert_array_equal(mine.sd_hz, [0.1, 0.1])
    assert (mine.numbers, mine.labels, mine.shapes) == ((2, 1), ("a", "b"), None)


def test_shapes_in_a_table_beside_frequencies_in_the_file(problem, folder):
    (folder / "shapes.csv").write_text("place,direction,1,2\nfirst,x,0.6,1.0\nsecond,x,1.0,-0.6\n")
    one = problem('frequencies = [3.1, 9.8]\nsd = 0.05\nshapes_file = "shapes.csv"\n')
    theta = np.array([3.1e7, 2.8e7])
    assert one.log_prob(theta) == problem(GIVEN).log_prob(theta)


def test_fewer_modes_than_the_model_has(problem):
    text = "frequencies = [9.8]\nsd = 0.05\nnumbers = [2]\n"
    found = problem(text, *BY_NUMBER)
    both = problem(GIVEN)
    theta = np.array([3.1e7, 2.8e7])
    assert found.frequencies(theta)[0] == pytest.approx(both.frequencies(theta)[1])


def test_modes_in_another_order_than_the_model_has_them(problem):
    text = "frequencies = [9.8, 3.1]\nsd = 0.05\n"
    theta = np.array([3.1e7, 2.8e7])
    found = problem(text + "counterparts = [2, 1]\n")
    assert found.data.counterparts == (2, 1)
    assert_allclose(found.frequencies(theta), problem(text).frequencies(theta)[::-1])


def test_modes_must_be_chosen_in_the_way_in_which_they_are_paired(problem, mistakes):
    text = "frequencies = [9.8, 3.1]\nsd = 0.05\n"
    assert mistakes(text + "counterparts = [2, 1]\n", *BY_NUMBER) == [
        "measurement.counterparts: must not be given where modes are paired by number; give numbers (got (2, 1))"
    ]
    (said,) = mistakes(text + "numbers = [2, 1]\n")
    assert said.startswith('measurement.numbers: must be those of the modes that pairing = "shape" takes')
    assert 'choose modes by counterparts, or set pairing = "index"' in said
    both = text + "numbers = [2, 1]\ncounterparts = [2, 1]\n"
    theta = np.array([3.1e7, 2.8e7])
    assert_allclose(problem(both).frequencies(theta), problem(both, *BY_NUMBER).frequencies(theta))
    assert problem("frequencies = [3.1, 9.8]\nsd = 0.05\nnumbers = [1, 2]\n").data.numbers == (1, 2)


def test_universal_file(problem, folder):
    pytest.importorskip("pyuff")
    data = ModalData([3.1, 9.8], (4, 7), ((11, "x"), (12, "x"), (13, "y")), shapes=[*SHAPES, [0.1, 0.2]])
    data.to_uff(folder / "test.uff")
    text = 'uff = { file = "test.uff", nodes = { 11 = "first", 12 = "second" }, modes = [7, 4] }\nsd = 0.05\n'
    found = problem(text).data
    assert_array_equal(found.frequencies_hz, [9.8, 3.1])
    assert found.labels == ("7", "4")
    assert found.sensors == (("first", "x"), ("second", "x"))
    assert_allclose(found.shapes, SHAPES[:, ::-1])
    turned = problem(text + SENSORS).data
    assert turned.sensors == (("first", "x"), ("second", "-x"))
    assert_allclose(turned.shapes, SHAPES[:, ::-1] * [[1.0], [-1.0]])


def test_result_of_pyoma(problem, folder):
    result = SimpleNamespace(Fn=[3.1, 9.8], Phi=SHAPES * np.exp(0.3j), Fn_std=[0.02, 0.03])
    save_pyoma(folder / "oma.npz", result)
    found = problem('oma = { file = "oma.npz" }\n' + SENSORS).data
    assert_array_equal(found.sd_hz, [0.02, 0.03])
    assert_allclose(np.abs(found.shapes), np.abs(SHAPES))
    assert found.sensors == (("first", "x"), ("second", "-x"))
    assert_array_equal(problem('oma = { file = "oma.npz" }\nbeta = 2.0\n' + SENSORS).likelihood.beta, [2.0, 2.0])


BROKEN = {
    "": "measurement: must have one of frequencies, tests, tests_file, file, uff, oma, f06, calculix (got [])",
    'frequencies = [3.1]\nsd = 0.1\nfile = "modes.csv"': "measurement: must have one of frequencies, tests,",
    "frequencies = [3.1, 9.8]": "measurement: must have either sd or beta or covariance (got [])",
    "frequencies = [3.1, 9.8]\nsd = 0.1\nbeta = 1.0": "measurement: must have either sd or beta or covariance",
    "frequencies = [3.1, -9.8]\nsd = 0.1": "measurement.frequencies.1: must be greater than 0 (got -9.8)",
    "frequencies = [3.1, nan]\nsd = 0.1": "measurement.frequencies.1: must be a finite number (got nan)",
    "frequencies = []\nsd = 0.1": "measurement.frequencies: must have at least 1 item",
    "frequencies = [3.1, 9.8]\nsd = [0.1, 0.0]": "measurement.sd",
    "frequencies = [3.1, 9.8]\nsd = [0.1]": "measurement: sd must be 2, one per mode (got 1)",
    "frequencies = [3.1, 9.8]\ncovariance = [[1.0]]": "measurement: covariance must be 2, one per mode (got 1)",
    "frequencies = [3.1, 9.8]\ncovariance = [[1.0, 0.0], [0.5, 1.0]]": (
        "measurement.covariance: must be symmetric (got 0.0 at 0.1 and 0.5 at 1.0)"
    ),
    "frequencies = [3.1, 9.8]\ncovariance = [[1.0, 1.0], [1.0, 1.0]]": (
        "measurement.covariance: must be positive definite"
    ),
    "frequencies = [3.1, 9.8]\ncovariance = [[1.0, 1.0], [1.0]]": "measurement.covariance: ",
    "frequencies = [3.1, 9.8]\ncovariance = [[1.0, 0.0], [0.0, -1.0]]": "measurement.covariance",
    "frequencies = [3.1, 9.8]\nsd = 0.1\nshapes = [[1.0, 1.0], [1.0]]\n" + SENSORS: (
        "measurement.shapes: must have rows of one length, one value per sensor (got [2, 1])"
    ),
    "frequencies = [3.1, 9.8]\nsd = 0.1\nshapes = [[1.0], [1.0]]\n" + SENSORS: (
        "measurement.shapes: must have shape (2, 2), sensors x modes (got (1, 2))"
    ),
    "frequencies = [3.1, 9.8]\nsd = 0.1\nshapes = [[1.0, 1.0]]\n" + SENSORS: (
        "measurement: shapes must be 2, one per mode (got 1)"
    ),
    'frequencies = [3.1, 9.8]\nsd = 0.1\nsensors = [["first", "x"], ["third", "x"], ["first", "up"]]': (
        "measurement.sensors.1: must be at a place that exists in the model (got ['third', 'x'])"
    ),
    "frequencies = [3.1, 9.8, 20.0]\nsd = 0.1": (
        "measurement: must have at most 2 modes, one per degree of freedom of the model (got 3)"
    ),
    "tests = [[3.1, 9.8]]": "measurement.tests: must have at least 2 items",
    "tests = [[3.1, 9.8], [3.2]]": "measurement.tests: must have rows of one length, one value per mode (got "
    "[2, 1",
    "tests = [[3.1, 9.8], [3.2, 9.9]]\nsd = 0.1": "measurement: sd must not be given together with tests",
    "tests = [[3.1, 9.8], [3.2, -9.9]]": "measurement.tests.1.1: must be positive and finite, or NaN (got -9.9",
    "tests = [[3.1, 9.8], [3.2, nan]]": "measurement.tests: every mode must have at least 2 values (got 1 of",
    'tests = [[3.1, 9.8], [3.1, 9.9]]\nscatter = "each"': "measurement.tests: the values of a mode must differ",
    'tests = [[3.1, 9.8], [3.2, 9.9]]\nscatter = "joint"': "measurement.tests: must be of at least 5 tests",
    'tests_file = "none.csv"': "measurement.tests_file: must be a file (no such file: ",
    'tests_file = "tests.csv"\nsd = 0.1': "measurement: sd must not be given together with tests_file, whose "
    "scatter",
    'tests_file = "no-sd.csv"': "measurement.tests_file: line 2, column mode: must be a positive number (got 'a')",
    "frequencies = [3.1]\nsd = 0.1\ntest_shapes = [[[1.0]]]": "measurement: test_shapes must be given with tests",
    "tests = [[3.1, 9.8], [3.2, 9.9]]\ntest_shapes = [[[1.0, 0.5], [1.0, -0.5]]]\n" + SENSORS: (
        "measurement.test_shapes: must be 2, one per test (got 1)"
    ),
    "tests = [[3.1, 9.8], [3.2, 9.9]]\ntest_shapes = [[[1.0, 0.5]], [[1.0, 0.5], [1.0, -0.5]]]\n" + SENSORS: (
        "measurement.test_shapes.0: must be 2, one per mode (got 1)"
    ),
    "tests = [[3.1], [3.2]]\ntest_shapes = [[[1.0, 0.5]], [[1.0]]]\n" + SENSORS: (
        "measurement.test_shapes: must have rows of one length, one value per sensor (got [1, 2])"
    ),
    "tests = [[3.1], [3.2], [3.3]]\ntest_shapes = [[[1.0, 0.0]], [[1.0, 0.1]], [[0.0, 1.0]]]\n" + SENSORS: (
        "measurement.test_shapes.2: mode 1 must have a MAC of at least 0.5"
    ),
    'file = "none.csv"': "measurement.file: must be a file (no such file: ",
    'frequencies = [3.1, 9.8]\nsd = 0.1\nscatter = "each"': "measurement: scatter must be given with tests",
    'file = "no-sd.csv"': "measurement: must have either sd or beta or covariance, as the file has no standard",
    'file = "broken.csv"': "measurement.file: line 2, column frequency: must be a positive number (got '-3')",
    'file = "no-sd.csv"\nsd = [0.1, 0.2, 0.3]': "measurement.sd: must be a number or have shape (2,)",
    'file = "no-sd.csv"\nsd = 0.1\nshapes_file = "none.csv"': "measurement.shapes_file: must be a file",
    'file = "no-sd.csv"\nsd = 0.1\nshapes_file = "off.csv"': (
        "measurement.shapes_file: must be at a place that exists in the model (got ['roof', 'x'])"
    ),
    'file = "no-sd.csv"\nsd = 0.1\nshapes_file = "off.csv"\n' + SENSORS: (
        "measurement: sensors must not be given together with shapes_file"
    ),
    'file = "no-sd.csv"\nsd = 0.1\nshapes_file = "off.csv"\nshapes = [[1.0, 1.0], [1.0, 1.0]]': (
        "measurement: must have either shapes or shapes_file"
    ),
    'uff = { file = "none.uff" }\nsd = 0.1': "measurement.uff: must be a file (no such file: ",
    'uff = { file = "test.uff" }': "measurement.uff: must be a file (no such file: ",
    'uff = { file = "test.uff" }\nsd = 0.1\nshapes = [[1.0]]': "measurement: shapes must not be given "
    "together with uff",
    'uff = { file = "test.uff", nodes = { tip = 3 } }\nsd = 0.1': "measurement.uff.nodes.tip",
    'oma = { file = "oma.npz" }': "measurement: sensors must be given with oma, one per channel",
    'oma = { file = "no-sd.csv" }\n'
    + SENSORS: "measurement.oma: must be a file of fmu.formats.modes.pyoma.save_pyoma",
    'oma = { file = "oma.npz", modes = [3] }\n' + SENSORS: "measurement.oma: modes: must lie in 1..2 (got [3])",
}


@pytest.mark.parametrize(("text", "mistake"), BROKEN.items(), ids=range(len(BROKEN)))
def test_mistakes(mistakes, folder, text, mistake):
    (folder / "no-sd.csv").write_text("mode,frequency\na,3.1\nb,9.8\n")
    (folder / "broken.csv").write_text("mode,frequency\na,-3\nb,9.8\n")
    (folder / "off.csv").write_text("place,direction,a,b\nfirst,x,1,1\nroof,x,1,-1\n")
    save_pyoma(folder / "oma.npz", {"Fn": [3.1, 9.8], "Phi": SHAPES})
    found = mistakes(text + "\n")
    assert found[0].startswith(mistake), found


def test_all_mistakes_of_a_table_at_once(mistakes, folder):
    (folder / "modes.csv").write_text("mode,frequency\na,-3\n,x\n")
    found = mistakes('file = "modes.csv"\n')
    assert len(found) == 3
    assert all(mistake.startswith("measurement.file: line") for mistake in found)


def test_all_sensors_off_the_model_at_once(mistakes):
    found = mistakes('frequencies = [3.1]\nsd = 0.1\nsensors = [["a", "x"], ["first", "y"]]\n')
    assert [re.match(r"measurement\.sensors\.(\d)", mistake)[1] for mistake in found] == ["0", "1"]


def test_modal_residual_needs_beta(problem, mistakes):
    option = ('name = "two storeys"', 'name = "two storeys"\nerror = "modal-residual"')
    assert mistakes(GIVEN, *option) == ["measurement.beta: must be given for the modal residual, as a number"]
    found = problem(GIVEN.replace("sd = 0.05", "beta = 100.0"), *option)
    assert_array_equal(found.likelihood.beta, [100.0, 100.0])


def test_modes_that_are_not_used(problem, folder):
    found = problem(f"{GIVEN}use = [true, false]\n")
    assert found.data.use == (True, False)
    both = problem(GIVEN)
    theta = np.tile(found.start, (3, 1)) * np.array([[0.9], [1.0], [1.1]])
    assert_array_equal(found.log_likelihood(theta), both.log_likelihood_terms(theta)[:, 0])
    assert_array_equal(found.frequencies(theta), both.frequencies(theta))
    (folder / "modes.csv").write_text("mode,frequency,sd,use\na,3.1,0.05,no\nb,9.8,0.05,yes\n")
    rest = GIVEN[GIVEN.index("shapes") :]
    assert problem(f'file = "modes.csv"\n{rest}').data.use == (False, True)
    tests = "tests = [[3.1, 9.8], [3.2, 9.7], [3.0, 9.9]]\nuse = [false, true]\n"
    assert problem(tests + rest).data.use == (False, True)


@pytest.mark.parametrize(
    ("use", "message"),
    [
        ("[true]", r"measurement: use must be 2, one per mode \(got 1\)"),
        ("[false, false]", r"measurement.use: must be true for at least one mode \(got .*\)"),
        ("[true, 1]", r"measurement.use.1: .*"),
    ],
)
def test_wrong_use(mistakes, use, message):
    (found,) = mistakes(f"{GIVEN}use = {use}\n")
    assert re.fullmatch(message, found)
