"""Error models and inferred standard deviations from files: as from Python, or a mistake."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import fmu
from fmu.arguments import OldNameWarning
from fmu.config import ConfigurationError, load
from tests.shear_building import shear_building

ERRORS = """\
[[error]]
of = "frequencies"
kind = "relative"
sd = "sigma"
weights = [1.0, 0.5]

[[error]]
of = "shapes"
sd = [[0.05, 0.1], [0.1, 0.2]]
model_sd = "delta"

[[error]]
of = "mac"
sd = 0.05

[[noise]]
name = "sigma"
start = 0.02
lower = 1e-4
prior = { distribution = "half-normal", sd = 0.05 }

[[noise]]
name = "delta"
start = 0.1
lower = 0.01
upper = 0.5

[model]
"""


@pytest.fixture
def text(matrices_text):
    return matrices_text.replace("[model]\n", ERRORS, 1).replace("sd = 0.05\nshapes", "shapes", 1)


def test_error_models(text, folder):
    (folder / "two.toml").write_text(text)
    from_file = load(folder / "two.toml")
    sigma = fmu.Parameter("sigma", 0.02, 1e-4, prior=fmu.HalfNormal(0.05))
    delta = fmu.Parameter("delta", 0.1, 0.01, 0.5)
    errors = [
        fmu.FrequencyErrors("relative", sigma, [1.0, 0.5]),
        fmu.ShapeErrors([[0.05, 0.1], [0.1, 0.2]], model_sd=delta),
        fmu.MACErrors(0.05),
    ]
    model = shear_building(["k1", "k2"], mass=[16.5e3, 16.1e3], dofs=[("first", "x"), ("second", "x")])
    data = fmu.ModalData([3.1, 9.8], sensors=[("first", "x"), ("second", "x")], shapes=[[0.6, 1.0], [1.0, -0.6]])
    parameters = [fmu.Parameter(name, 2.97e7, 1e7, 6e7) for name in ("k1", "k2")]
    built = fmu.UpdatingProblem(model, data, parameters, error=errors)
    assert from_file.names == built.names == ("k1", "k2", "sigma", "delta")
    theta = built.sample_prior(np.random.default_rng(1), 20)
    assert_allclose(from_file.log_prob(theta), built.log_prob(theta), rtol=1e-12)


def test_the_old_name_of_model_sd(text, folder):
    """Files and scripts of version 1.0 say ``discrepancy``; their densities are the same in every bit."""
    (folder / "new.toml").write_text(text)
    new = load(folder / "new.toml")
    (folder / "old.toml").write_text(text.replace("model_sd", "discrepancy"))
    with pytest.warns(OldNameWarning, match="discrepancy is now called model_sd") as seen:
        old = load(folder / "old.toml")
    assert seen[0].filename == __file__
    theta = new.sample_prior(np.random.default_rng(1), 20)
    assert_array_equal(old.log_prob(theta), new.log_prob(theta))
    delta = fmu.Parameter("delta", 0.1, 0.01, 0.5)
    for make in (fmu.FrequencyErrors, fmu.ShapeErrors, fmu.StudentErrors):
        with pytest.warns(OldNameWarning) as seen:
            assert make(discrepancy=delta) == make(model_sd=delta)
        assert seen[0].filename == __file__
    both = text.replace('model_sd = "delta"', 'model_sd = "delta"\ndiscrepancy = "delta"')
    (folder / "both.toml").write_text(both)
    with pytest.raises(ConfigurationError, match=r"error\.1\.discrepancy"):
        load(folder / "both.toml")


BROKEN = [
    ('sd = "sigma"', 'sd = "tau"', "error.0.sd: must be the name of a [[noise]] table: sigma, delta (got 'tau')"),
    ('model_sd = "delta"', 'model_sd = "eps"', "error.1.model_sd: must be the name of a [[noise]] table"),
    (
        'model_sd = "delta"\n',
        "",
        "noise.1.name: must be used as sd, model_sd or freedom of an [[error]] (got 'delta')",
    ),
    ('name = "delta"', 'name = "k1"', "noise.1.name: must not be the name of another parameter (got 'k1')"),
    ("lower = 0.01", "lower = 0.2", "noise.1.start: must be finite and within [0.2, 0.5] (got 0.1)"),
    ("lower = 0.01", "lower = -0.2", "noise.1.lower: must be greater than or equal to 0 (got -0.2)"),
    ("upper = 0.5\n", "", "noise.1.prior: a uniform prior needs finite bounds"),
    ('kind = "relative"', 'kind = "cubic"', "error.0.kind: must be 'absolute', 'relative' or 'eigenvalue'"),
    ('of = "mac"', 'of = "ear"', "error.2.of: must be"),
    ("sd = 0.05\n", "sd = -0.05\n", "error.2.sd: must be greater than 0 (got -0.05)"),
    ("sd = 0.05\n", "", "error.2.sd: is missing"),
    ("weights = [1.0, 0.5]", "weights = [1.0]", "weights: must be 2 positive numbers, one per mode (got [1.0])"),
    (
        "sd = [[0.05, 0.1], [0.1, 0.2]]",
        "sd = [[0.05], [0.1], [0.2]]",
        "shape errors: sd must be a number or of shape",
    ),
    ("shapes = [[0.6, 1.0], [1.0, -0.6]]\n", "", "shape errors: need measured shapes at the sensors"),
    (
        'of = "mac"\n',
        'of = "mass"\nmass = 10.0\nat_supports = 11.0\n',
        "error.2.at_supports: must be at least 0 and less than the mass, 10.0 kg (got 11.0)",
    ),
    ("sd = 0.05\n", 'sd = "tau"\n', "error.2.sd: must be the name of a [[noise]] table: sigma, delta (got 'tau')"),
]


def test_the_freedom_of_robust_errors_is_a_number_or_a_name(text, folder):
    frequencies = 'of = "frequencies"\nkind = "relative"\n'
    assert frequencies in text
    (folder / "two.toml").write_text(text.replace(frequencies, 'of = "robust-frequencies"\nfreedom = 6\n'))
    assert load(folder / "two.toml").likelihood.frequency_term.freedom(np.zeros((1, 2)), 0) == 6.0


@pytest.mark.parametrize(
    ("only", "expected"),
    [
        ('of = "mac"\nsd = "tau"', "error.0.sd: must be the name of a [[noise]] table: there is none (got 'tau')"),
        (
            'of = "robust-frequencies"\nsd = 0.01\nfreedom = 0.5',
            "error.0.freedom: must be a finite number of at least 1 (got 0.5)",
        ),
    ],
)
def test_a_wrong_table_is_the_only_mistake(matrices_text, folder, only, expected):
    text = matrices_text.replace("sd = 0.05\nshapes", "shapes", 1)
    (folder / "two.toml").write_text(text.replace("[model]\n", f"[[error]]\n{only}\n\n[model]\n", 1))
    with pytest.raises(ConfigurationError) as caught:
        load(folder / "two.toml")
    assert [str(one) for one in caught.value.mistakes] == [expected]


@pytest.mark.parametrize(("old", "new", "expected"), BROKEN)
def test_a_broken_error_model(text, folder, old, new, expected):
    assert text.count(old) >= 1
    (folder / "two.toml").write_text(text.replace(old, new, 1))
    with pytest.raises(ConfigurationError) as caught:
        load(folder / "two.toml")
    assert expected in str(caught.value)


def test_an_unknown_name(matrices_text, folder):
    (folder / "two.toml").write_text('error = "mac"\n' + matrices_text)
    with pytest.raises(ConfigurationError, match=r"error: must be 'frequency' or 'modal-residual'"):
        load(folder / "two.toml")


FITTED = "noise.0.lower: must be positive (or use a log-normal prior): 2 parameters can fit these 2 errors exactly"


def test_a_deviation_that_an_exact_fit_would_let_vanish(text, folder):
    free = text.replace("lower = 1e-4\n", "", 1)
    (folder / "two.toml").write_text(free)
    with pytest.raises(ConfigurationError) as caught:
        load(folder / "two.toml")
    assert [FITTED in str(mistake) for mistake in caught.value.mistakes] == [True]


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('"half-normal", sd = 0.05', '"log-normal", median = 0.02, sigma = 1.0'),  # vanishes faster
        ('sd = "sigma"', 'sd = 0.01\nmodel_sd = "sigma"'),  # beside errors of a known size
        ('of = "mac"\nsd = 0.05', 'of = "mac"\nsd = "sigma"'),  # of four errors
    ],
)
def test_a_deviation_that_may_start_at_zero(text, folder, old, new):
    free = text.replace("lower = 1e-4\n", "", 1)
    assert old in free
    (folder / "two.toml").write_text(free.replace(old, new, 1))
    problem = load(folder / "two.toml")
    assert problem.lower[problem.names.index("sigma")] == 0.0


MODEL_ERROR = """\
[[noise]]
name = "delta"
start = 0.1
lower = 0.01
upper = 0.5

[[error]]
of = "frequencies"
kind = "absolute"
model_sd = "delta"

[model]
"""


def test_beta_is_the_standard_deviation_beside_a_model_error(matrices_text, folder):
    """It was ignored, in the file and in ``fmu.load``, as if the frequencies had no errors of measurement."""
    rest = matrices_text.replace("[model]\n", MODEL_ERROR, 1)
    theta = np.array([2.9e7, 3.1e7, 0.2])

    def density(trust, **options):
        (folder / "two.toml").write_text(rest.replace("sd = 0.05\n", f"{trust}\n"))
        problem = load(folder / "two.toml", **options)
        assert_allclose(problem.data.sd_hz, sd, rtol=1e-12)
        return problem.log_prob(theta), problem.frequencies(theta)

    sd = np.array([0.5, 0.25])
    found, f = density("sd = [0.5, 0.25]")
    V, off = sd**2 + 0.2**2, f - [3.1, 9.8]
    expected = np.sum(-0.5 * off**2 / V - 0.5 * np.log(2 * np.pi * V)) - np.log(0.49 * 5e7**2)
    assert_allclose(found, expected, rtol=1e-12)
    assert_allclose(density("beta = [2.0, 8.0]")[0], expected, rtol=1e-12)
    assert_allclose(density("sd = 0.05", beta=[2.0, 8.0])[0], expected, rtol=1e-12)
    assert_allclose(density("covariance = [[1.0, 0.5], [0.5, 1.0]]", beta=[2.0, 8.0])[0], expected, rtol=1e-12)
    with pytest.raises(ConfigurationError, match=r"beta: must be a number or 2 numbers"):
        load(folder / "two.toml", beta=[1.0, 2.0, 3.0])


@pytest.mark.parametrize("key", ["sd = 0.05", "beta = 2.0", "covariance = [[1.0, 0.5], [0.5, 1.0]]"])
@pytest.mark.parametrize("of", ["frequencies", "robust-frequencies"])
def test_frequencies_have_one_standard_deviation(matrices_text, folder, key, of):
    table = f'[[error]]\nof = "mac"\nsd = 0.1\n[[error]]\nof = "{of}"\nsd = 0.01\n[model]\n'
    text = matrices_text.replace("[model]\n", table, 1)
    said = "must not be given together with error.1.sd, as one of them would be ignored; delete one"
    (folder / "two.toml").write_text(text.replace("sd = 0.05\nshapes", f"{key}\nshapes"))
    with pytest.raises(ConfigurationError) as caught:
        load(folder / "two.toml")
    assert [str(one) for one in caught.value.mistakes] == [f"measurement.{key.split()[0]}: {said}"]
    (folder / "two.toml").write_text(text.replace("sd = 0.05\nshapes", "shapes"))
    with pytest.raises(ConfigurationError, match=f"beta: {said}"):
        load(folder / "two.toml", beta=2.0)
    assert load(folder / "two.toml").names == ("k1", "k2")
