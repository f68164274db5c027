"""The memory of a run that is told before training: nothing for small structures, and more for larger ones."""

import re

import numpy as np
import pytest
import scipy.sparse as sp

from fmu.fem.frame.stability import free_motions
from fmu.fem.modes.separable import SeparableModel
from fmu.fem.reduced import cost
from fmu.fem.reduced.cost import memory_in_words


def chain(n):
    """Return a chain of n masses, held at both ends, whose stiffness the check for mechanisms has factorised."""
    K = sp.csr_array(sp.diags_array([[2.0] * n, [-1.0] * (n - 1), [-1.0] * (n - 1)], offsets=[0, 1, -1]))
    model = SeparableModel.from_terms(["k"], [(K, "k")], [sp.eye_array(n, format="csr")])
    free_motions(model, [1.0])
    return model


def gib(sentence):
    return [float(number) for number in re.findall(r"([0-9.]+) GiB", sentence)]


@pytest.fixture
def plenty(monkeypatch):
    monkeypatch.setattr(cost, "free_memory", lambda: 2**40)


def test_a_small_structure_has_no_such_sentence(plenty):
    assert memory_in_words(chain(1000)) == ""


def test_factors_and_vectors_count(plenty):
    n = 200_000
    run, factors = gib(memory_in_words(chain(n)))
    assert factors == pytest.approx(8 * 2 * n / 2**30, rel=0.1)  # a diagonal and one beside it, to two digits
    vectors = 80 * 8 * n * (1 + 2) / 2**30
    assert run == pytest.approx(0.35 + vectors + 2 * factors + 12 * n * (3 + 1 + 6 * 3) / 2**30, rel=0.05)


def test_it_says_if_less_is_free(monkeypatch):
    model = chain(20_000)
    monkeypatch.setattr(cost, "free_memory", lambda: 2**20)
    assert memory_in_words(model).endswith(", but only 0.00098 GiB more are free.")
    monkeypatch.setattr(cost, "free_memory", lambda: None)  # where the system does not tell
    assert "free" not in memory_in_words(model)


def test_it_says_if_the_factors_are_in_single_precision(plenty, monkeypatch):
    model = chain(20_000)
    assert "single" not in memory_in_words(model)
    (dofs,) = model.blocks
    monkeypatch.setattr(model.last_factor(dofs).factor, "is_single", True)
    assert memory_in_words(model).endswith(" GiB, in single precision.")


def test_factors_are_not_pickled_with_the_model():
    import pickle

    model = chain(20_000)
    assert memory_in_words(model)
    assert memory_in_words(pickle.loads(pickle.dumps(model))) == ""
    assert np.array_equal(pickle.loads(pickle.dumps(model)).K([2.0]).data, model.K([2.0]).data)
