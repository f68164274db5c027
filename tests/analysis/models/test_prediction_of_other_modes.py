"""Modes that were not measured, of a structure as it is or changed, predicted with the error of the model."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import fmu
from fmu.analysis.models.prediction import predict_modes
from fmu.fem.modes.changes import changed_model
from tests import plain_traces
from tests.shear_building import frequencies_hz, shear_building

NAMES = ["k1", "k2", "k3", "k4"]
MASS = np.array([1.0, 1.5, 1.2, 0.8])
DOFS = [(j, "x") for j in range(1, 5)]
TAU = 0.04
KINDS = {
    "none": (),
    "embedded": fmu.Discrepancy(tau=TAU),
    "modes": fmu.Discrepancy("modes", sd=TAU, correlation=0.5),
}


def building(mass=MASS):
    return shear_building(NAMES, 1e3, mass=mass, dofs=DOFS)


@pytest.fixture(scope="module", params=KINDS)
def sampled(request):
    """Return the name of a discrepancy, a problem with it and two measured modes, and draws."""
    measured = frequencies_hz(building(), np.ones(4))[0][:2]
    parameters = [fmu.Parameter(n, 1.0, 0.5, 2.0, prior=fmu.Normal(0.05, mean=1.0)) for n in NAMES]
    parameters[3] = fmu.Parameter("k4", 1.0, 0.5, 2.0, updated=False)
    problem = fmu.UpdatingProblem(
        building(), fmu.ModalData(measured, sd_hz=0.01 * measured), parameters, pairing="index",
        discrepancy=KINDS[request.param],
    )  # fmt: skip
    trace = fmu.sample(
        problem, "mh", draws=100, warmup=50, maxima=fmu.find_map(problem, starts=2), progress=False
    )  # fmt: skip
    return request.param, problem, trace


def test_the_error_of_the_model_is_added_to_modes_that_were_not_measured(sampled):
    kind, problem, trace = sampled
    table = fmu.predict_modes(trace, problem, 4)
    theta = np.stack([trace["posterior"][n].to_numpy().ravel() for n in NAMES[:3]], axis=1)
    values = np.column_stack([theta, np.ones(len(theta))])
    every = fmu.UpdatingProblem(
        building(), fmu.ModalData([1.0, 2.0, 3.0, 4.0]), [fmu.Parameter(n, 1.0, 0.5, 2.0) for n in NAMES],
        pairing="index",
    )  # fmt: skip
    f, J = every.model.frequencies_and_gradient(values)
    assert_allclose(table["model_sd"], f.std(axis=0, ddof=1))
    assert_allclose(table["model_eti90_ub"], np.quantile(f, 0.95, axis=0))
    added = {
        "none": np.zeros(4),
        "embedded": TAU * np.sqrt(np.mean(np.sum((J * values[:, None]) ** 2, axis=2), axis=0)),
        "modes": TAU * np.sqrt(0.5) * f.mean(axis=0),  # at least: of the common part the data know something
    }[kind]
    sd = np.sqrt(table["sd"] ** 2 - table["model_sd"] ** 2)
    error = 5.0 / np.sqrt(2.0 * len(theta))
    assert np.all(sd >= added * (1.0 - error))
    assert np.all(sd <= added * (1.0 + error) * (np.sqrt(2.0) if kind == "modes" else 1.0))


def test_a_structure_that_was_changed(sampled):
    _, problem, trace = sampled
    change = fmu.Change(masses={4: 0.5})
    table = fmu.predict_modes(trace, problem, 3, change=change, factors={"k4": 0.6}, draws=3)
    rows = [[trace["posterior"][n].to_numpy().ravel()[i] for n in NAMES[:3]] for i in (0, 199, 399)]
    heavier = building(np.add(MASS, [0.0, 0.0, 0.0, 0.5]))
    expected = [frequencies_hz(heavier, np.array([*row, 0.6]))[0][:3] for row in rows]
    assert_allclose(table["model_sd"], np.std(expected, axis=0, ddof=1), rtol=1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"modes": 5}, "modes: must be at most the 4 of the model"),
        ({"factors": {"k9": 0.5}}, "factors: must be of k1, k2, k3, k4"),
        ({"test": "later"}, "test: must be of"),
    ],
)
def test_what_does_not_exist_is_refused(sampled, change, message):
    _, problem, trace = sampled
    with pytest.raises(ValueError, match=message):
        predict_modes(trace, problem, **({"modes": 2} | change))


LOADED = {"masses": {4: 0.5}, "springs": {(1, "x"): 200.0}, "known": {"k2": 0.7}}


@pytest.mark.parametrize("order", [("empty", "loaded"), ("loaded", "empty")])
def test_the_structure_is_that_of_the_named_test(order):
    """Its masses, springs and known values are included, whichever test is the first."""
    changes, heavier = {"empty": {}, "loaded": LOADED}, building(np.add(MASS, [0.0, 0.0, 0.0, 0.5]))
    f = frequencies_hz(building(), np.ones(4))[0]
    tests = [fmu.Test(name, fmu.ModalData(f, sd_hz=0.05 * f), **changes[name]) for name in order]
    parameters = [fmu.Parameter(n, 1.0, 0.5, 2.0, prior=fmu.Normal(0.1, mean=1.0)) for n in NAMES]
    scatter = fmu.Discrepancy(tau=TAU)
    problem = fmu.JointProblem(building(), tests, parameters, pairing="index", discrepancy=scatter)
    theta = np.random.default_rng(1).normal(1.0, 0.02, (40, 4))
    trace = plain_traces.trace_of(problem, theta)
    supported = changed_model(heavier, springs=LOADED["springs"], known={1: 0.7})
    at = {
        "empty": [frequencies_hz(building(), row * [1.0, 1.0, 0.6, 1.0])[0] for row in theta],
        "loaded": [frequencies_hz(supported, row[[0, 2, 3]] * [1.0, 0.6, 1.0])[0] for row in theta],
    }
    for name in order:
        table = fmu.predict_modes(trace, problem, 4, test=name, factors={"k3": 0.6})
        assert_allclose(table["model_sd"], np.std(at[name], axis=0, ddof=1))
        assert_allclose(table["model_eti90_ub"], np.quantile(at[name], 0.95, axis=0))
        assert (table["sd"] > table["model_sd"]).all()
    with pytest.raises(ValueError, match="factors: must be of k1, k3, k4 "):
        fmu.predict_modes(trace, problem, 4, test="loaded", factors={"k2": 0.5})


@pytest.mark.parametrize("is_allowed_for", [False, True])
def test_a_wrong_model_is_not_sure_of_a_damage(is_allowed_for):
    """No storey lost stiffness, but k1 is 40 % softer than in the model, and other modes are measured later."""
    truth = np.array([0.6, 1.0, 1.0, 1.0])
    f = frequencies_hz(building(), truth)[0]
    model = shear_building(["k1", "upper", "upper", "k4"], 1e3, mass=MASS, dofs=DOFS)
    parameters = [fmu.Parameter("k1", 1.0, 0.5, 2.0, updated=False), fmu.Parameter("upper", 1.0, 0.5, 2.0)]
    parameters.append(fmu.Parameter("k4", 1.0, 0.5, 2.0, updated=False))
    tests = [
        fmu.Test(name, fmu.ModalData(f[modes], sd_hz=0.01 * f[modes], numbers=[m + 1 for m in modes],
                                     labels=[f"mode {m + 1}" for m in modes]), group=name)
        for name, modes in (("before", [1, 2, 3]), ("after", [0, 1]))
    ]  # fmt: skip
    problem = fmu.JointProblem(
        model, tests, parameters, varies={"upper": fmu.Damage()}, pairing="index",
        discrepancy=fmu.Discrepancy(groups=("k1",), prior_sd=0.2) if is_allowed_for else (),
    )  # fmt: skip
    trace = fmu.sample(
        problem, "mh", draws=150, warmup=150, maxima=fmu.find_map(problem, starts=4), progress=False
    )
    loss = next(name for name in problem.names if "loss" in name)
    sure = float((trace["posterior"][loss] > 0.05).mean())
    assert sure < 0.6 if is_allowed_for else sure > 0.99
