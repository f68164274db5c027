"""A table says what each parameter of several tests is for; no name does."""

import numpy as np

import fmu
from fmu.analysis.trace.reading import is_loss, roles_of, told_names
from fmu.posterior.joint.varies.base import Role

HINGE = "hinge score [left]"
"""A stiffness that the user has named as scores are named."""


def joint(names, n=4, **options):
    tests = [
        fmu.Test(
            f"test {i}",
            fmu.ModalData([1.0, 2.0 + 0.01 * i], sd_hz=0.02, labels=("one", "two")),
            group="old" if i < n // 2 else "new",
            covariates={"temperature": float(i)},
        )
        for i in range(n)
    ]
    parameters = [fmu.Parameter(name, 1.0, 0.5, 2.0) for name in names]
    model = fmu.BlackBoxModel(lambda theta: np.array([1.0, 2.0]) * np.sqrt(theta[:2]), len(names))
    return fmu.JointProblem(model, tests, parameters, **options)


def sampled(problem):
    return fmu.sample(problem, "mh", draws=4, warmup=4, chains=2, init="prior")


def test_every_kind_has_its_role():
    problem = joint(
        ["a", "b", "c", "d", "e"],
        varies={"a": fmu.Population(), "b": "test", "c": fmu.Damage(), "d": "group", "e": fmu.Population()},
        slopes={"d": {"temperature": fmu.Normal(0.01)}},
        correlation=2.0,
        error=fmu.FrequencyErrors("relative", sd=fmu.Parameter("noise", 0.01, 0.001, 0.1)),
    )
    found = dict(zip(problem.names, problem.roles, strict=True))
    assert len(found) == problem.ndim
    assert found["a mean"] == Role("mean", 0)
    assert found["a sd"] == Role("sd", 0)
    assert found["a score [test 2]"] == Role("score", 0, "test 2")
    assert found["b [test 1]"] == Role("test", 1, "test 1")
    assert found["c"] == Role("group", 2, "old")
    assert found["c loss [new]"] == Role("loss", 2, "new")
    assert found["d [new]"] == Role("group", 3, "new")
    assert found["d per temperature"] == Role("slope", 3, "temperature")
    assert found["a e correlation"] == Role("correlation", None)
    assert found["noise"] == Role("noise", None)


def test_a_parameter_may_have_a_name_like_that_of_a_score():
    problem = joint(["k", HINGE], n=40, varies={"k": fmu.Population()})
    trace = sampled(problem)
    assert roles_of(trace)[HINGE] == ("shared", HINGE, "")
    assert told_names(trace) == ("k mean", "k sd", HINGE)


def test_a_parameter_may_have_a_name_like_that_of_a_loss():
    trace = sampled(joint(["k", "depth [new]"], varies={"k": fmu.Damage()}))
    assert [name for name in ("k", "k loss [new]", "depth [new]") if is_loss(trace, name)] == ["k loss [new]"]


def test_a_single_test_has_no_roles():
    assert roles_of(sampled(fmu.cases.load("shear-2dof"))) == {}
