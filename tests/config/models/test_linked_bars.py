"""A deck with rigid links: what a parameter changes behind them, and what explains a mechanism."""

import re

import numpy as np
import pytest
from numpy.testing import assert_array_equal

import fmu
from fmu.fem.frame.changed_elements import changed_elements, find_elements

DECK = """\
SOL 103
CEND
SPC = 1
BEGIN BULK
GRID,1,,0.,0.,0.
GRID,2,,1.,0.,0.
GRID,3,,2.,0.,0.
GRID,11,,0.,.2,0.
GRID,12,,0.,-.2,0.
GRID,21,,1.,.2,0.
GRID,22,,1.,-.2,0.
CBAR,1,1,11,21,0.,0.,1.
CBAR,2,2,12,22,0.,0.,1.
CBAR,3,3,2,3,0.,0.,1.
RBE2,4,1,123456,11,12
RBE2,5,2,123456,21,22
SPC1,1,123456,3
ENDDATA
"""
MATRICES = """\
name = "bars"
reduction = false
[model]
type = "matrices"
mesh = "deck.bdf"
stiffness = [
    { file = "all.npz", variable = "K1", powers = { E1 = 1 } },
    { file = "all.npz", variable = "K2", powers = { E2 = 1 } },
    { file = "all.npz", variable = "K3", powers = { E3 = 1 } },
]
mass = [{ file = "all.npz", variable = "M" }]
"""
EXPORTS = """\
name = "bars"
reduction = false
[model]
type = "exports"
mesh = "deck.bdf"
exports = [
    { stiffness = "K.npy", mass = "M.npy", values = { E1 = 1, E2 = 1, E3 = 1 } },
    { stiffness = "K1.npy", mass = "M.npy", values = { E1 = 2 } },
    { stiffness = "K2.npy", mass = "M.npy", values = { E2 = 2 } },
    { stiffness = "K3.npy", mass = "M.npy", values = { E3 = 2 } },
]
"""
MEASURED = '[measurement]\nfrequencies = [5.0]\nsd = 0.1\nsensors = [[1, "z"]]\n'
NODES = [1, 2, 3, 11, 12, 21, 22]


@pytest.fixture
def load(tmp_path):
    """Return a function that loads the bars, as springs between all components of two nodes."""
    every = {}
    for k, pair in enumerate([(11, 21), (12, 22), (2, 3)], 1):
        K = np.zeros((42, 42))
        for c in range(6):
            at = [6 * NODES.index(node) + c for node in pair]
            K[np.ix_(at, at)] = 1e5 * np.array([[1, -1], [-1, 1]])
        every[f"K{k}"] = K
    np.savez(tmp_path / "all.npz", **every, M=np.eye(42))
    K = sum(every.values())
    for name, matrix in {"K": K, "M": np.eye(42), **{key: K + own for key, own in every.items()}}.items():
        np.save(tmp_path / f"{name}.npy", matrix)

    def loaded(model, deck=DECK):
        parameters = "".join(
            f'[[parameters]]\nname = "{name}"\nstart = 1.0\nlower = 0.5\nupper = 2.0\n'
            for name in ("E1", "E2", "E3")
        )
        (tmp_path / "deck.bdf").write_text(deck)
        (tmp_path / "bars.toml").write_text(model + MEASURED + parameters)
        return fmu.load(tmp_path / "bars.toml")

    return loaded


def test_elements_that_links_hide_are_not_counted(load):
    """Both bars between the two links act on the same degrees of freedom: each was counted for E1 and for E2."""
    model = load(MATRICES).model.structure
    assert_array_equal(find_elements(model).hidden.sum(axis=0), [2, 2, 0])
    assert_array_equal(changed_elements(model).sum(axis=0), [0, 0, 1])
    said = list(fmu.check(load(MATRICES), draws=2).parameters["changes"])
    assert said == ["stiffness at 12 of 12 degrees of freedom"] * 2 + ["stiffness of 1 of 3 elements"]


def test_hidden_elements_of_one_parameter_are_counted(load):
    model = load(MATRICES.replace("{ E2 = 1 }", "{ E1 = 1 }").replace("{ E3 = 1 }", "{ E2 = 1, E3 = 1 }"))
    assert_array_equal(changed_elements(model.model.structure).sum(axis=0), [2, 1, 1])


@pytest.mark.parametrize("model", [MATRICES, EXPORTS])
def test_a_mechanism_is_told_with_what_may_explain_it(load, model):
    rule = "set free = true if it is free on purpose. No SPC set acts, as the case control selects none"
    with pytest.raises(ValueError, match=re.escape(rule)):
        load(model, DECK.replace("SPC = 1\n", ""))
