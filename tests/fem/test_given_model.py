"""A model of the user's own that misbehaves: a sentence for each way, no traceback from deep inside."""

from dataclasses import replace

import numpy as np
import pytest

import fmu
from fmu.fem.pairing.prediction import ModalPrediction


class Given:
    """Two modes of one parameter, given by a function of theta (n, 1)."""

    n_parameters, n_modes = 1, 2

    def __init__(self, answer):
        self.answer = answer

    def frequencies(self, theta):
        return self.answer(theta)

    def frequencies_and_gradient(self, theta):
        return self.answer(theta), np.ones((len(theta), 2, 1))


def problem(answer):
    data = fmu.ModalData([1.0, 2.0], sd_hz=0.01)
    return fmu.UpdatingProblem(Given(answer), data, [fmu.Parameter("k", 1.0, 0.5, 2.0)], pairing="index")


@pytest.mark.parametrize(
    ("answer", "sentence"),
    [
        (
            lambda theta: {}["k"],
            r"must return NaN where a solve fails, and not raise \(got KeyError: 'k', at \[\[",
        ),
        (
            lambda theta: np.ones((len(theta), 3)),
            r"must return real numbers of shape \(1, 2\) \(got float64 of shape",
        ),
        (
            lambda theta: np.ones((len(theta), 2)) * 1j,
            r"must return real numbers of shape \(1, 2\) \(got complex128",
        ),
        (lambda theta: None, r"must return real numbers of shape \(1, 2\) \(got object"),
    ],
    ids=["raises", "length", "complex", "nothing"],
)
def test_a_sentence_says_what_is_wrong(answer, sentence):
    with pytest.raises(ValueError, match=f"model: Given.frequencies {sentence}"):
        problem(answer).log_prob([1.0])


def test_nan_is_a_failed_solve_with_a_reason():
    posed = problem(lambda theta: np.full((len(theta), 2), np.nan))
    assert posed.log_prob([1.0]) == -np.inf
    assert posed.n_failures == 1
    assert posed.failures[0].reason


def test_a_gradient_that_is_none_is_told():
    class Poor(Given):
        def frequencies_and_gradient(self, theta):
            return self.answer(theta)

    data = fmu.ModalData([1.0, 2.0], sd_hz=0.01)
    model = Poor(lambda theta: np.ones((len(theta), 2)))
    posed = fmu.UpdatingProblem(model, data, [fmu.Parameter("k", 1.0, 0.5, 2.0)], pairing="index")
    with pytest.raises(ValueError, match=r"Poor.frequencies_and_gradient must return two arrays \(got ndarray\)"):
        posed.log_prob_and_grad([1.0])


SENSORS = (("top", "x"), ("middle", "x"), ("foot", "x"))


class Seen(Given):
    """With shapes at three sensors; `answer` changes what they are."""

    def __init__(self, answer):
        super().__init__(lambda theta: np.ones((len(theta), 2)))
        self.change = answer

    def observed(self, theta, gradient=False):
        n = len(theta)
        slopes = (np.ones((n, 2, 1)), np.ones((n, 3, 2, 1))) if gradient else (None, None)
        return self.change(ModalPrediction(np.ones((n, 2)), np.ones((n, 3, 2)), *slopes))


def with_shapes(answer):
    data = fmu.ModalData([1.0, 2.0], sd_hz=0.01, sensors=SENSORS, shapes=[[1.0, 1.0], [0.7, -0.7], [0.3, -1.0]])
    errors = [fmu.FrequencyErrors(), fmu.ShapeErrors(0.05)]
    return fmu.UpdatingProblem(Seen(answer), data, [fmu.Parameter("k", 1.0, 0.5, 2.0)], error=errors)


@pytest.mark.parametrize(
    ("answer", "sentence"),
    [
        (lambda seen: {}["phi"], r" must return NaN where a solve fails, and not raise \(got KeyError: 'phi'"),
        (lambda seen: None, r" must return a ModalPrediction \(got NoneType\)"),
        (
            lambda seen: replace(seen, shapes=seen.shapes[:, :2]),
            r"\(…\).shapes must return real numbers of shape \(1, 3, 2\) \(got float64 of shape \(1, 2, 2\)\)",
        ),
    ],
    ids=["raises", "nothing", "sensors"],
)
def test_a_sentence_says_what_is_wrong_with_shapes(answer, sentence):
    with pytest.raises(ValueError, match=f"model: Seen.observed{sentence}"):
        with_shapes(answer).log_prob([1.0])


def test_slopes_of_shapes_that_are_left_out_are_told():
    posed = with_shapes(lambda seen: replace(seen, shape_slopes=None))
    assert np.isfinite(posed.log_prob([1.0]))
    with pytest.raises(ValueError, match=r"Seen.observed\(…\).shape_slopes must return real numbers of shape"):
        posed.log_prob_and_grad([1.0])


def test_a_model_of_the_user_s_own_takes_part_in_several_tests():
    data = [fmu.ModalData([1.0, f], sd_hz=0.01, labels=("one", "two")) for f in (2.0, 2.1)]
    tests = [fmu.Test(name, one) for name, one in zip("ab", data, strict=True)]
    given = Given(lambda theta: np.array([1.0, 2.0]) * theta)
    joint = fmu.JointProblem(given, tests, [fmu.Parameter("k", 1.0, 0.5, 2.0)], varies={"k": "test"})
    np.testing.assert_array_equal(joint.frequencies([1.0, 1.5]), [1.0, 2.0, 1.5, 3.0])
