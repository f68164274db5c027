"""Small problems whose frequencies are known in closed form."""

import numpy as np
import pytest
import scipy.sparse as sp

from fmu import cases
from fmu.fem.modes.separable import SeparableModel
from fmu.fem.modes.terms import Term
from tests.centring import all_half_centred, half_centred  # noqa: F401


class Oscillators:
    """A ModalModel that is no finite-element model: f_i = √θ_i, and NaN where θ_0 exceeds `fails_above`."""

    def __init__(self, n_modes, fails_above=np.inf):
        self.n_parameters = self.n_modes = n_modes
        self.fails_above = fails_above

    def frequencies(self, theta):
        frequencies = np.sqrt(theta)
        return np.where(theta[:, :1] > self.fails_above, np.nan, frequencies)

    def frequencies_and_gradient(self, theta):
        frequencies = self.frequencies(theta)
        return frequencies, np.eye(self.n_modes) * (0.5 / frequencies)[:, None, :]


@pytest.fixture
def oscillators():
    return Oscillators


@pytest.fixture(scope="session")
def chain():
    """Return a chain of three masses held by two kinds of springs, K = θ₀ K₀ + θ₁ K₁."""
    ends, between = np.diag([1.0, 0.0, 1.0]), np.array([[1.0, -1, 0], [-1, 2, -1], [0, -1, 1]])
    K_terms = [Term(sp.csr_array(ends), (1.0, 0.0)), Term(sp.csr_array(between), (0.0, 1.0))]
    return SeparableModel(K_terms, [Term(sp.csr_array(np.diag([1.0, 2.0, 3.0])), (0.0, 0.0))])


@pytest.fixture(scope="session")
def load_case():
    """Return a function that loads a built-in case once."""
    loaded = {}

    def load(name, pairing):
        if (name, pairing) not in loaded:
            loaded[name, pairing] = cases.load(name, pairing)
        return loaded[name, pairing]

    return load
