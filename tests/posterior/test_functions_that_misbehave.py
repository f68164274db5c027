"""A user's function that raises, or returns what it should not: a sentence, whatever the function is part of."""

import numpy as np
import pytest

import fmu

EDGE = 1.1
START = [1.0, 1.0]


def raises(theta):
    raise RuntimeError("mesh is inverted")


WRONG = {
    "raises": (raises, "RuntimeError: mesh is inverted"),
    "length": (lambda theta: theta[:1], "must give the measured modes, numbers [1, 2] (gave 1 modes)"),
    "NaN": (lambda theta: [np.nan, 1.0], "frequencies: must be finite and not negative (got [nan, 1.0])"),
    "complex": (lambda theta: theta * 1j, "frequencies: must be real numbers (got ndarray of complex128)"),
    "text": (lambda theta: "high", "frequencies: must be real numbers (got str of <U4)"),
    "nothing": (lambda theta: None, "frequencies: must be real numbers (got nothing)"),
    "shape": (lambda theta: np.ones((2, 2)), "frequencies: must have shape (n,) (got (2, 2))"),
}


class Function:
    """Two frequencies of two stiffnesses; wrong everywhere, or where the first is beyond an edge."""

    def __init__(self, wrong, everywhere=False):
        self.wrong, self.everywhere, self.calls = wrong, everywhere, 0

    def __call__(self, theta):
        self.calls += 1
        good = np.array([1.0, 2.0]) * np.sqrt(theta)
        return self.wrong(theta) if self.everywhere or theta[0] > EDGE else good


def parameters():
    return [fmu.Parameter("a", 1.0, 0.8, 1.3), fmu.Parameter("b", 1.0, 0.5, 2.0)]


def single(function):
    return fmu.UpdatingProblem(fmu.BlackBoxModel(function, 2), fmu.ModalData([1.0, 2.0], sd_hz=0.02), parameters())


def joint(function, **varies):
    tests = [
        fmu.Test(name, fmu.ModalData([1.0, second], sd_hz=0.02, labels=("one", "two")))
        for name, second in (("spring", 2.0), ("autumn", 2.01))
    ]
    return fmu.JointProblem(fmu.BlackBoxModel(function, 2), tests, parameters(), varies=varies)


@pytest.fixture(params=WRONG)
def wrong(request):
    return WRONG[request.param]


@pytest.mark.parametrize("make", [single, joint])
def test_at_the_start_it_is_refused(make, wrong):
    answer, sentence = wrong
    with pytest.raises(ValueError, match=r"^model\.function: ") as refused:
        make(Function(answer, everywhere=True))
    assert sentence in str(refused.value)
    assert f"at the start {START}" in str(refused.value)


@pytest.mark.parametrize(("make", "where"), [(single, ""), (joint, "test spring: ")])
def test_elsewhere_the_point_has_failed_after_one_call(make, where, wrong):
    answer, sentence = wrong
    function = Function(answer)
    problem = make(function)
    calls = function.calls
    assert problem.log_prob([1.2, 1.0]) == -np.inf
    assert function.calls == calls + 1
    (failed,) = problem.take_failures()
    assert failed.reason == f"{where}{sentence}"
    assert [reason for _, reason in problem.model.reasons] == [sentence]
    assert np.isfinite(problem.log_prob([1.05, 1.0]))


def test_of_several_tests_the_one_that_failed_is_named():
    function = Function(raises)
    problem = joint(function, a="test")
    calls = function.calls
    assert problem.names == ("a [spring]", "a [autumn]", "b")
    points = [[1.0, 1.2, 1.0], [1.2, 1.0, 1.0], [1.05, 1.0, 1.0]]
    assert np.isfinite(problem.log_prob(points)).tolist() == [False, False, True]
    assert function.calls == calls + 2  # at 1.2 and at 1.05: it has been called at the start
    reasons = [failed.reason for failed in problem.take_failures()]
    assert reasons == [f"test {name}: RuntimeError: mesh is inverted" for name in ("autumn", "spring")]


def test_of_several_tests_of_matrices_too():
    """Without mass at the second node there is one mode less."""
    tests = [
        fmu.Test(name, fmu.ModalData([0.1, 0.3], sd_hz=0.01, labels=("one", "two"))) for name in ("dry", "wet")
    ]
    model = fmu.SeparableModel.from_terms(
        ["k", "m"],
        [(np.array([[2.0, -1.0], [-1.0, 2.0]]), "k")],
        [np.diag([1.0, 0.0]), (np.diag([0.0, 1.0]), "m")],
    )
    stiff = [fmu.Parameter("k", 1.0, 0.5, 4.0), fmu.Parameter("m", 1.0, 0.0, 4.0)]
    problem = fmu.JointProblem(model, tests, stiff, varies={"m": "test"}, pairing="index", reduction=False)
    assert problem.log_prob([1.0, 1.0, 0.0]) == -np.inf
    (failed,) = problem.take_failures()
    assert failed.reason == "test wet: M gives 1 modes of finite frequency, 2 are needed"


@pytest.mark.parametrize(  # the others are told in the same way
    "wrong", ["raises", pytest.param("shape", marks=pytest.mark.validate)], indirect=True
)
def test_behind_a_surrogate_the_reason_is_that_of_the_function(wrong):
    answer, sentence = wrong
    learnt = fmu.surrogate(single(Function(answer)), max_solves=30)
    assert learnt.model.certificate.failed > 0
    assert learnt.log_prob([1.3, 1.0]) == -np.inf
    (failed,) = learnt.take_failures()
    assert failed.reason == (
        f"near points at which the model could not be solved ({sentence}), where its surrogate expects no "
        "frequencies"
    )


def test_a_surrogate_of_a_function_that_fails_everywhere_is_refused_with_the_reason():
    def fails(theta):
        if not np.array_equal(theta, START):
            raise RuntimeError("no licence")
        return np.array([1.0, 2.0])

    with pytest.raises(
        ValueError, match=r"must be solved at more points .* failed, first with: RuntimeError: no l"
    ):
        fmu.surrogate(single(fails))
