"""From a parametrised model in CalculiX to K(θ), M(θ) and a posterior, and back to CalculiX."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.sparse.linalg import eigsh

import fmu
from tests.programs.calculix_plate import NOMINAL, exported, frequencies

# Each parameter alone, the thickness three times, and with E left once more: where both halves meet, E left t and
# E right t could not be told apart otherwise.
STEPS = [
    {"E left": 8.4e10},
    {"t": 0.05},
    {"t": 0.03},
    {"t": 0.045},
    {"E right": 2.3e11},
    {"rho": 3000.0},
    {"E left": 8.4e10, "t": 0.05},
    {"E left": 8.4e10, "t": 0.03},
]
CHECK = {"E left": 6e10, "t": 0.035, "E right": 1.7e11, "rho": 2500.0}
TRUTH = {"E left": 6.6e10, "t": 0.0385, "E right": 2.13e11, "rho": 2810.0}


def keywords(values):
    return {name.replace(" ", "_"): value for name, value in values.items()}


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    folder = tmp_path_factory.mktemp("plate")
    nominal = exported(folder, "nominal")
    exports = [fmu.Export(NOMINAL, fmu.read_model(nominal, mesh=folder / "nominal.inp"), name="nominal")]
    for k, values in enumerate([*STEPS, CHECK]):
        path = exported(folder, f"step{k}", **keywords(values))
        exports.append(fmu.Export(values, fmu.read_model(path), check=values is CHECK, name=path.name))
    return fmu.from_exports(exports)


def test_terms_are_those_of_a_plate_of_solid_elements(model):
    """CalculiX expands shells into bricks: a stiffness has parts in t, 1/t and without t, the mass is linear."""
    powers = {term.powers for term in model.K_terms}
    assert powers == {(1, p, 0, 0) for p in (-1, 0, 1)} | {(0, p, 1, 0) for p in (-1, 0, 1)}
    assert {term.powers for term in model.M_terms} == {(0, 1, 0, 0), (0, 1, 0, 1)}


def test_frequencies_are_those_of_the_program(model, tmp_path):
    """At five points that were never exported, to the digits that CalculiX prints."""
    rng = np.random.default_rng(1)
    for _ in range(5):
        values = {name: x * rng.uniform(0.7, 1.4) for name, x in NOMINAL.items()}
        theta = list(values.values())
        found = eigsh(model.K(theta), 8, model.M(theta), sigma=0.0)[0]
        own = frequencies(tmp_path, **keywords(values))
        assert_allclose(np.sqrt(found) / (2 * np.pi), own, rtol=1e-6)


def test_the_posterior_contains_what_was_planted(model, tmp_path):
    """Five frequencies of CalculiX itself, with errors of 0.2 %."""
    rng = np.random.default_rng(2)
    f = frequencies(tmp_path, **keywords(TRUTH))[:5] * (1 + 0.002 * rng.standard_normal(5))
    parameters = [
        fmu.Parameter(name, x, 0.8 * x, 1.25 * x, prior=fmu.Normal(0.1 * x, mean=x)) for name, x in NOMINAL.items()
    ]
    data = fmu.ModalData(f, sd_hz=0.002 * f)
    problem = fmu.UpdatingProblem.reduced(model, data, parameters, pairing="index")
    trace = fmu.sample(problem, "mixture", draws=300, seed=1)
    found = fmu.summary(trace)
    assert fmu.diagnose(trace).converged
    away = (np.array(list(TRUTH.values())) - found["mean"].to_numpy()) / found["sd"].to_numpy()
    assert np.all(np.abs(away) < 3.0)
    assert np.all(found["sd"].to_numpy() < [0.02 * x for x in NOMINAL.values()][:1] + [np.inf] * 3)
