"""A model of the user's own that misbehaves: a sentence for each way, no traceback from deep inside."""

import numpy as np
import pytest

import fmu


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
