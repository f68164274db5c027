"""``[[tests]]``: problem files with several tests of one structure, from the file to the run."""

import json
import tomllib

import numpy as np
import pytest
from click.testing import CliRunner
from numpy.testing import assert_allclose

import fmu
from fmu.analysis.trace.provenance import canonical_json
from fmu.cli import main
from fmu.config import read
from fmu.config.mistakes import ConfigurationError
from fmu.posterior.assumptions import assumptions

HEAD = """
name = "two storeys"
pairing = "index"

[model]
type = "matrices"
dofs = [["floor 1", "x"], ["roof", "x"]]
"""
MATRICES = """
[[model.stiffness]]
matrix = [[2e6, 0.0], [0.0, 0.0]]
powers = { k1 = 1 }

[[model.stiffness]]
matrix = [[2e6, -2e6], [-2e6, 2e6]]
powers = { k2 = 1 }

[[model.mass]]
matrix = [[1000.0, 0.0], [0.0, 1000.0]]
"""
K1 = '[[parameters]]\nname = "k1"\nstart = 1.0\nlower = 0.5\nupper = 1.5\n'
K2 = '[[parameters]]\nname = "k2"\nstart = 1.0\nlower = 0.5\nupper = 1.5\n'
PLAIN = '[[tests]]\nname = "plain"\ngroup = "old"\nfrequencies = [4.4, 11.5]\nsd = 0.02\n'
LOADED = (
    '[[tests]]\nname = "loaded"\ngroup = "new"\nfrequencies = [4.0, 11.2]\nbeta = 1250.0\n'
    'masses = [{ place = "roof", mass = 300.0 }]\n'
    'springs = [{ place = "floor 1", direction = "x", stiffness = 1e4 }]\n'
)


def written(tmp_path, *parts, head=HEAD):
    path = tmp_path / "building.toml"
    path.write_text("\n".join([head, MATRICES, *parts]))
    return path


def mistakes(path):
    with pytest.raises(ConfigurationError) as told:
        fmu.load(path)
    return [str(mistake) for mistake in told.value.mistakes]


def test_two_configurations(tmp_path):
    problem = fmu.load(written(tmp_path, K1, K2 + 'varies = "group"\n', PLAIN, LOADED))
    assert len(problem.tests) > 1
    assert problem.names == ("k1", "k2 [old]", "k2 [new]")
    loaded = problem.tests[1]
    assert dict(loaded.masses) == {"roof": 300.0}
    assert dict(loaded.springs) == {("floor 1", "x"): 1e4}
    assert_allclose(loaded.data.sd_hz, 0.02)
    K = np.array([[4e6 + 1e4, -2e6], [-2e6, 2e6]])
    exact = np.sqrt(np.sort(np.linalg.eigvals(np.linalg.solve(np.diag([1000.0, 1300.0]), K)))) / (2 * np.pi)
    assert_allclose(problem.frequencies([1.0, 1.0, 1.0])[2:], exact, rtol=1e-8)


def test_masses_and_springs_at_one_place_add_up(tmp_path):
    """The last one took the place of the others."""
    masses, springs = LOADED.split("\n")[-3:-1]
    twice = LOADED.replace(masses, masses.replace("300.0 }", '100.0 }, { place = "roof", mass = 200.0 }'))
    twice = twice.replace(
        springs, springs.replace("1e4 }", '4e3 }, { place = "floor 1", direction = "x", stiffness = 6e3 }')
    )
    assert twice.count("place") == 4
    test = fmu.load(written(tmp_path, K1, K2, PLAIN, twice)).tests[1]
    assert (dict(test.masses), dict(test.springs)) == ({"roof": 300.0}, {("floor 1", "x"): 1e4})
    change = twice.replace("[[tests]]", "[[plan.changes]]").split("\n")
    path = written(tmp_path, K1, K2, PLAIN, "\n".join([change[0], change[1], *change[-3:]]))
    (planned,) = read(path).plan_options(path.name, tmp_path)["changes"].values()
    assert (planned.masses, planned.springs) == (test.masses, test.springs)


def test_an_error_of_a_size_of_its_own_beside_repeated_tests(tmp_path):
    """The scatter of the tests would be ignored, as in a file of one test."""
    repeated = PLAIN.replace("frequencies = [4.4, 11.5]\nsd = 0.02", "tests = [[4.4, 11.5], [4.41, 11.55]]")
    error = '[[error]]\nof = "mass"\nmass = 2000.0\nsd = 20.0\ntest = "plain"\n[[error]]\nof = "frequencies"\n'
    other = LOADED.replace("beta = 1250.0\n", "")
    (found,) = mistakes(written(tmp_path, error + "sd = 0.01\n", K1, K2, repeated, other))
    assert found.startswith("error.1.sd: must not be given together with tests of tests.0, whose scatter gives")
    assert len(fmu.load(written(tmp_path, error, K1, K2, repeated, LOADED)).tests) == 2
    beside = mistakes(written(tmp_path, error + "sd = 0.01\n", K1, K2, PLAIN, LOADED))
    assert [one.partition(":")[0] for one in beside] == ["tests.0.sd", "tests.1.beta"]


def test_populations_slopes_and_losses(tmp_path):
    temperature = "covariates = { temperature = 5.0 }\n"
    sd = '{ distribution = "half-normal", sd = 0.1 }'
    of_k1 = f'varies = "population"\npopulation = {{ distribution = "log-normal", sd = {sd} }}\n'
    of_k2 = 'varies = "damage"\nloss = { distribution = "uniform" }\n'
    slope = 'slopes = { temperature = { distribution = "normal", sd = 0.005 } }\n'
    third = (
        LOADED.replace("loaded", "again").replace("beta = 1250.0", "sd = 0.02")
        + "covariates = { temperature = 20.0 }\n"
    )
    path = written(tmp_path, K1 + of_k1 + slope, K2 + of_k2, PLAIN + temperature, LOADED + temperature, third)
    problem = fmu.load(path)
    assert problem.names[:4] == ("k1 median", "k1 log sd", "k1 per temperature", "k2")
    assert problem.names[4:] == ("k2 loss [new]", *(f"k1 score [{name}]" for name in ("plain", "loaded", "again")))
    assert problem.parameters[1].prior == fmu.HalfNormal(0.1)
    assert problem.parameters[4].prior == fmu.Uniform()


def test_a_loss_of_a_parameter_that_scatters(tmp_path):
    sd = '{ distribution = "half-normal", sd = 0.1 }'
    scatters = f'varies = "damage"\npopulation = {{ distribution = "log-normal", sd = {sd} }}\n'
    tests = [PLAIN, PLAIN.replace("plain", "again"), LOADED.replace("beta = 1250.0", "sd = 0.02")]
    problem = fmu.load(written(tmp_path, K1 + scatters, K2, *tests))
    assert problem.names[:4] == ("k1 median", "k1 log sd", "k1 loss [new]", "k2")
    assert problem.parameters[1].prior == fmu.HalfNormal(0.1)
    shared = 'varies = "group"\npopulation = {}\n'
    assert mistakes(written(tmp_path, K1 + shared, K2, *tests)) == [
        'parameters.0.population: must be given with varies = "population" or "damage" or "undated-damage" '
        "(got group)"
    ]


def test_scatter_between_groups(tmp_path):
    scatters = 'varies = "population"\npopulation = {{ between = {} }}\n'
    sd = '{ distribution = "half-normal", sd = 0.1 }'
    tests = [PLAIN.replace("plain", f"t{t}").replace("old", "abc"[t // 2]) for t in range(6)]
    problem = fmu.load(written(tmp_path, K1 + scatters.format(sd), K2, *tests))
    assert problem.names[:6] == ("k1 mean", "k1 sd", "k1 sd between groups", *(f"k1 effect [{g}]" for g in "abc"))
    assert problem.parameters[2].prior == fmu.HalfNormal(0.1)
    assert mistakes(written(tmp_path, K1 + scatters.format(WRONG), K2, *tests)) == [
        "parameters.0.population.between.sd: must be greater than 0 (got -1.0)"
    ]
    assert mistakes(written(tmp_path, K1 + scatters.format(sd), K2, *tests[:4])) == [
        "parameters.0.varies: scatters between groups, and needs 3 groups or more (got 2)"
    ]


def test_an_sd_in_each_group(tmp_path):
    scatters = 'varies = "population"\npopulation = { sd_by_group = true }\n'
    tests = [PLAIN.replace("plain", f"t{t}").replace("old", "ab"[t // 2]) for t in range(4)]
    problem = fmu.load(written(tmp_path, K1 + scatters, K2, *tests))
    assert problem.names[:3] == ("k1 mean", "k1 sd [a]", "k1 sd [b]")
    assert mistakes(written(tmp_path, K1 + scatters, K2, *tests[:3])) == [
        "parameters.0.varies: has an sd in each group, and needs two tests or more in it (got 1 in 'b')"
    ]


def test_values_that_are_correlated_in_time(tmp_path):
    tests = [PLAIN.replace("plain", f"t{t}") + f"covariates = {{ day = {t}.0 }}\n" for t in range(4)]
    scatters = 'varies = "population"\npopulation = { correlation_time = HOW, by = "day" }\n'
    inferred = {
        '"inferred"': None,
        '{ distribution = "log-normal", median = 3.0, sigma = 0.5 }': fmu.LogNormal(3.0, 0.5),
    }
    for how, prior in inferred.items():
        problem = fmu.load(written(tmp_path, K1 + scatters.replace("HOW", how), K2, *tests))
        assert problem.names[:3] == ("k1 mean", "k1 sd", "k1 correlation time")
        assert problem.roles[2] == ("correlation time", 0, "day")
        assert prior in (None, problem.parameters[2].prior)
        configuration = json.loads(canonical_json(problem.configuration()))
        said = " ".join(assumptions(configuration, None, None).sentences)
        assert "The values of k1 are correlated in time" in said
    problem = fmu.load(written(tmp_path, K1 + scatters.replace("HOW", "2.5"), K2, *tests))
    assert problem.layout.in_time.every[0].correlation_time == 2.5
    assert mistakes(written(tmp_path, K1 + scatters.replace("HOW", "-1"), K2, *tests)) == [
        "parameters.0.population.correlation_time: must be greater than 0 (got -1)"
    ]
    assert mistakes(written(tmp_path, K1 + scatters.replace('HOW, by = "day"', '2.5, by = "hour"'), K2, *tests))[
        0
    ] == ("tests.0.covariates: must have hour as a number, as values of k1 are correlated in time (got None)")


def test_tests_that_may_be_outliers(tmp_path):
    scatters = 'varies = "population"\n'
    tests = [PLAIN.replace("plain", f"t{t}") for t in range(4)]
    path = written(tmp_path, K1 + scatters, K2, *tests)
    text = path.read_text()
    path.write_text("outliers = { share = 0.1, scale = 4 }\n" + text)
    assert fmu.load(path).layout.outliers.of == fmu.Outliers(0.1, 4.0)
    path.write_text('outliers = { share = { distribution = "beta", a = 1, b = 9 } }\n' + text)
    problem = fmu.load(path)
    assert problem.names[:4] == ("k1 mean", "k1 sd", "k2", "share of outliers")
    assert problem.roles[3] == ("share", None, "")
    path.write_text("outliers = { share = 1.5, scale = 1 }\n" + text)
    assert mistakes(path) == ["outliers.scale: must be a finite number above 1 (got 1.0)"]
    path.write_text('outliers = { share = { distribution = "half-normal", sd = 0.1 } }\n' + text)
    assert mistakes(path) == ["outliers.share.distribution: must be one of beta (got 'half-normal')"]
    path.write_text("outliers = {}\n" + text.replace(scatters, ""))
    assert mistakes(path) == [
        "outliers: needs a parameter with a population, of which a test may be an outlier (got none)"
    ]


def test_damage_at_an_unknown_date(tmp_path):
    onset = 'varies = "undated-damage"\nonset = { by = "day", grows = true, event = "corrosion" }\n'
    tests = [PLAIN.replace("plain", f"t{t}") + f"covariates = {{ day = {t}.5 }}\n" for t in range(4)]
    problem = fmu.load(written(tmp_path, K1 + onset + "population = {}\n", K2 + onset, *tests))
    assert problem.names[:6] == ("k1 mean", "k1 sd", "k1 loss", "day of corrosion", "k2", "k2 loss")
    assert (problem.lower[3], problem.upper[3]) == (0.5, 2.5)
    by_order = 'varies = "undated-damage"\nloss = { distribution = "uniform" }\n'
    problem = fmu.load(written(tmp_path, K1 + by_order, K2, *tests))
    assert problem.names == ("k1", "k1 loss", "test of damage", "k2")
    date = onset.replace("grows = true", f"date = {WRONG}")
    assert mistakes(written(tmp_path, K1 + date, K2, *tests)) == [
        "parameters.0.onset.date.sd: must be greater than 0 (got -1.0)"
    ]
    assert mistakes(written(tmp_path, K1 + onset, K2, *tests[:2])) == [
        "parameters.0.varies: the date of a damage needs tests at 3 times or more (got 2)"
    ]
    assert mistakes(written(tmp_path, K1 + onset.replace('"day"', '"hour"'), K2, *tests[:3])) == [
        f"tests.{t}.covariates: must have hour as a number, which is the time of the damage of k1 (got None)"
        for t in range(3)
    ]
    group = onset.replace("undated-damage", "damage")
    assert mistakes(written(tmp_path, K1 + group, K2, *tests)) == [
        'parameters.0.onset: must be given with varies = "undated-damage" (got damage)'
    ]


def test_every_mistake_at_its_place(tmp_path):
    wrong = PLAIN.replace("[4.4, 11.5]", "[4.4, 11.5, -1.0]")
    assert mistakes(written(tmp_path, K1, K2, wrong, LOADED)) == [
        "tests.0.frequencies.2: must be greater than 0 (got -1.0)"
    ]
    assert mistakes(written(tmp_path, K1, K2, PLAIN.replace("sd = 0.02", ""), LOADED)) == [
        "tests.0: must have either sd or beta or covariance (got [])"
    ]
    same = LOADED.replace('name = "loaded"', 'name = "plain"')
    slope = 'slopes = { temperature = { distribution = "normal", sd = 0.005 } }\n'
    assert mistakes(written(tmp_path, K1 + slope, K2, PLAIN, same)) == [
        "tests.1.name: must not be that of tests.0 (got 'plain')",
        "tests.0.covariates: must have temperature, on which k1 depends (got none)",
        "tests.1.covariates: must have temperature, on which k1 depends (got none)",
    ]
    known = PLAIN + "known = { k1 = 1.0 }\n"
    assert mistakes(written(tmp_path, K1 + 'varies = "test"\n', K2, known, LOADED)) == [
        "parameters.0.varies: varies by test, and needs two tests or more (got 1)"
    ]
    nowhere = LOADED.replace('place = "roof"', 'place = "cellar"')
    assert mistakes(written(tmp_path, K1, K2, PLAIN, nowhere)) == [
        "tests.1.masses.cellar: must be a place that is free to move (got 'cellar')"
    ]
    assert mistakes(written(tmp_path, K1, K2, PLAIN, LOADED.replace("300.0", "nan"))) == [
        "tests.1.masses.0.mass: must be a finite number (got nan)"
    ]
    loss = 'loss = { distribution = "spike-and-slab" }\n'
    assert mistakes(written(tmp_path, K1 + loss, K2, PLAIN, LOADED)) == [
        'parameters.0.loss: must be given with varies = "damage" or "undated-damage" (got None)'
    ]


def test_one_measurement_or_several_tests(tmp_path):
    measurement = "[measurement]\nfrequencies = [4.4, 11.5]\nsd = 0.02\n"
    assert mistakes(written(tmp_path, K1, K2)) == [
        "measurement: must be given, or several [[tests]] instead (got none)"
    ]
    assert mistakes(written(tmp_path, K1, K2, measurement, PLAIN, LOADED)) == [
        "measurement: must be given, or several [[tests]] instead (got both)"
    ]
    assert mistakes(written(tmp_path, K1 + 'varies = "test"\n', K2, measurement)) == [
        "parameters.0.varies: is allowed with several [[tests]] only"
    ]
    losses = 'varies = "damage"\nloss = { distribution = "normal", sd = 0.1 }\n'
    slopes = 'slopes = { temperature = { distribution = "normal", sd = 0.01 } }\n'
    assert mistakes(written(tmp_path, K1 + losses, K2 + slopes, measurement)) == [
        f"parameters.{i}.{key}: is allowed with several [[tests]] only"
        for i, key in ((0, "varies"), (0, "loss"), (1, "slopes"))
    ]


@pytest.mark.usefixtures("quick_figures")
def test_check_run_and_damage(tmp_path):
    """From the file to the losses, by the commands; a population has no maxima to search for."""
    losses = written(tmp_path, K1 + 'varies = "damage"\n', K2, PLAIN, LOADED)
    runner = CliRunner()
    checked = runner.invoke(main, ["check", str(losses), "--out", str(tmp_path / "check")])
    assert checked.exit_code == 0, checked.output
    assert "2 tests of one structure in 2 configurations" in checked.output
    out = tmp_path / "run"
    short = ["--draws", "10", "--warmup", "10", "--starts", "2", "--no-report", "--out", str(out)]
    ran = runner.invoke(main, ["run", str(losses), *short])
    assert ran.exit_code == 0, ran.output
    assert "Losses since " in ran.output
    assert f"fmu damage {out}\n" in ran.output
    told = runner.invoke(main, ["damage", str(out), "--beyond", "0.05"])
    assert told.exit_code == 0, told.output
    assert "P > 5 %" in told.output
    assert (out / "damage.png").is_file()

    of_both = 'varies = "population"\n'
    again = LOADED.replace("loaded", "again")
    scattered = written(tmp_path, K1 + of_both, K2 + of_both, PLAIN, LOADED, again)
    out = tmp_path / "scattered"
    ran = runner.invoke(
        main, ["run", str(scattered), "--draws", "5", "--warmup", "5", "--no-report", "--out", str(out)]
    )
    assert ran.exit_code == 0, ran.output
    assert (out / "gibbs.nc").is_file()
    assert not (out / "map.csv").exists()
    assert set(fmu.load_trace(out / "gibbs.nc").children) >= {"tests", "next_test"}
    assert tomllib.loads((out / "problem.toml").read_text())["tests"][2]["name"] == "again"


AT = "covariates = {{ temperature = {} }}\n"
NORMAL = '{ distribution = "normal", sd = 0.002 }'
WRONG = '{ distribution = "normal", sd = -1.0 }'


def campaign(tmp_path, slopes, *temperatures, k2=""):
    """Return the file of a campaign in which `k1` has the `slopes`."""
    tests = [
        PLAIN.replace('"plain"', f'"t{t}"') + AT.format(temperature) for t, temperature in enumerate(temperatures)
    ]
    return written(tmp_path, K1 + f"slopes = {{ {slopes} }}\n", K2 + k2, *tests)


def test_laws_of_covariates(tmp_path):
    kinks = f'temperature = {{ law = "piecewise-linear", prior = {NORMAL}, kinks = [0.0] }}'
    problem = fmu.load(campaign(tmp_path, kinks, -5.0, 5.0, 20.0, k2='slopes = { temperature = "k1" }\n'))
    assert problem.names == (
        "k1", "k1 and k2 per temperature below 0", "k1 and k2 per temperature above 0", "k2",
    )  # fmt: skip
    inferred = (
        f'temperature = {{ law = "piecewise-linear", prior = {NORMAL}, kinks = {{ distribution = "uniform" }} }}'
    )
    assert fmu.load(campaign(tmp_path, inferred, -5.0, 5.0, 20.0)).names[3] == "k1 kink in temperature"
    square = '{ distribution = "normal", sd = 1e-5 }'
    powers = f'temperature = {{ law = "polynomial", priors = [{NORMAL}, {square}] }}'
    problem = fmu.load(campaign(tmp_path, powers, -5.0, 5.0, 20.0))
    assert problem.names == ("k1", "k1 per temperature", "k1 per temperature^2", "k2")
    assert problem.parameters[2].prior == fmu.Normal(1e-5)


def test_covariates_that_are_not_known(tmp_path):
    given = '{ distribution = "normal", mean = 20.0, sd = 0.5 }'
    problem = fmu.load(campaign(tmp_path, f"temperature = {NORMAL}", -5.0, '"missing"', given))
    assert problem.names[1:3] == ("temperature [t1]", "temperature [t2]")
    assert problem.parameters[2].prior == fmu.Normal(0.5, mean=20.0)


def test_mistakes_in_laws_and_covariates(tmp_path):
    at, piecewise = "slopes.temperature", f'law = "piecewise-linear", prior = {NORMAL}'
    slopes = {
        '{ law = "cubic" }': f"{at}.law: must be one of polynomial, piecewise-linear (got 'cubic')",
        '{ law = "polynomial", priors = [] }': f"{at}.priors: must have a prior for each coefficient (got none)",
        f"{{ {piecewise}, kinks = [2.0, 1.0] }}": f"{at}.kinks: must be one value or several in ascending order "
        "(got [2.0, 1.0])",
        f"{{ {piecewise}, kinks = [40.0] }}": "slopes: the kinks in temperature must be between its values in the "
        "tests, -5 and 20 (got 40)",
        f"{{ {piecewise}, kinks = {WRONG} }}": f"{at}.kinks.sd: must be greater than 0 (got -1.0)",
        f'{{ law = "polynomial", priors = [{NORMAL}, {WRONG}] }}': f"{at}.priors.1.sd: must be greater than 0 "
        "(got -1.0)",
        f'{{ law = "piecewise-linear", kinks = [0.0], prior = {WRONG} }}': f"{at}.prior.sd: must be greater than "
        "0 (got -1.0)",
        WRONG: f"{at}.sd: must be greater than 0 (got -1.0)",
        '"k3"': "slopes: must name a parameter with a law of temperature of its own (got 'k3')",
    }
    found = {given: mistakes(campaign(tmp_path, f"temperature = {given}", -5.0, 5.0, 20.0)) for given in slopes}
    assert found == {given: [f"parameters.0.{message}"] for given, message in slopes.items()}
    slope = f"temperature = {NORMAL}"
    assert mistakes(campaign(tmp_path, slope, -5.0, '"lost"', 20.0)) == [
        "tests.1.covariates.temperature: must be 'missing' (got 'lost')"
    ]
    assert mistakes(campaign(tmp_path, slope, -5.0, WRONG, 20.0)) == [
        "tests.1.covariates.temperature.sd: must be greater than 0 (got -1.0)"
    ]
    assert mistakes(campaign(tmp_path, slope, -5.0, "nan", 20.0)) == [
        "tests.1.covariates.temperature: must be a finite number (got nan)"
    ]
    assert mistakes(campaign(tmp_path, slope, 5.0, 5.0)) == [
        "parameters.0.slopes: temperature must differ between tests (got one value)"
    ]


SIGMA = '[[noise]]\nname = "sigma"\nstart = 0.01\nupper = 0.1\n{}\n[[error]]\nof = "frequencies"\nsd = "sigma"\n'


def test_a_deviation_that_an_exact_fit_of_all_tests_would_let_vanish(tmp_path):
    """Only files with one measurement were asked."""
    plain = PLAIN.replace("sd = 0.02\n", "")
    tests = plain, plain.replace("plain", "again")
    each = K1 + 'varies = "test"\n', K2 + 'varies = "test"\n'
    said = "must be positive (or use a log-normal prior): 4 parameters can fit these 4 errors exactly"
    (mistake,) = mistakes(written(tmp_path, SIGMA.format(""), *each, *tests))
    assert mistake.startswith(f"noise.0.lower: {said}")
    assert mistake.endswith("tends to zero (got 0.0)")
    scatter = 'varies = "population"\npopulation = {}\n'
    (mistake,) = mistakes(written(tmp_path, SIGMA.format(""), K1 + scatter, K2 + scatter, *tests))
    assert mistake.startswith(f"noise.0.lower: {said}")  # a population's mean and sd fit no more of them
    allowed = (
        (SIGMA.format("lower = 0.001"), *each, *tests),
        (SIGMA.format(""), K1, each[1], *tests),  # three parameters of four errors
        (SIGMA.format(""), *each, *tests, plain.replace("plain", "third") + "known = { k1 = 1.0 }\n"),
    )
    for parts in allowed:
        assert "sigma" in fmu.load(written(tmp_path, *parts, head=f"reduction = false\n{HEAD}")).names
