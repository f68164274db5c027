"""The hash of a user's function depends on which function of its file it is, and on the values that it holds."""

import os
import subprocess
import sys
from functools import lru_cache

import numpy as np
import pytest
import scipy.sparse as sp

import fmu
from fmu.config.models.python import PythonTable
from fmu.fem.programs.sources import source_digest, unknown_value

FUNCTIONS = """
from functools import partial, wraps

import numpy as np


def make(mesh):
    def modes(theta):
        return 10.0 * theta ** (0.5 if mesh == "fine" else 0.25)
    return modes


def scaled(factor):
    def decorate(function):
        @wraps(function)
        def call(theta):
            return factor * function(theta)
        return call
    return decorate


def plain(theta, power=0.5):
    return theta**power


class Model:
    def __init__(self, power):
        self.power = power

    def modes(self, theta):
        return theta**self.power


one, other = lambda theta: 10.0 * theta**0.5, lambda theta: 10.0 * theta**0.25
half, quarter = partial(plain, power=0.5), partial(plain, power=0.25)
twice, thrice = scaled(2.0)(plain), scaled(3.0)(plain)
many = make({"fine", "coarse", "a", "b", "c"})
"""


@pytest.fixture
def functions(tmp_path, monkeypatch):
    (tmp_path / "functions.py").write_text(FUNCTIONS)
    monkeypatch.syspath_prepend(str(tmp_path))
    import functions

    yield functions
    del sys.modules["functions"]


PAIRS = {
    "closures": lambda f: (f.make("fine"), f.make("coarse")),
    "lambdas of one line": lambda f: (f.one, f.other),
    "partial": lambda f: (f.half, f.quarter),
    "decorators": lambda f: (f.twice, f.thrice),
    "arrays": lambda f: (f.make(np.arange(3.0)), f.make(np.arange(1.0, 4.0))),
    "large arrays": lambda f: (
        f.make(np.arange(5000.0)),
        f.make(np.r_[np.arange(2500.0), 0.0, np.arange(2501.0, 5000.0)]),
    ),
    "sparse matrices": lambda f: (f.make(sp.eye_array(3)), f.make(sp.eye_array(3, k=1))),
    "nested": lambda f: (f.make([{"a": (1, 2.0)}]), f.make([{"a": (1, 2.5)}])),
    "lengths": lambda f: (f.make([(1, 2), 3]), f.make([(1,), 2, 3])),
    "functions": lambda f: (f.make(f.one), f.make(f.other)),
    "names": lambda f: (f.make(np.linalg.norm), f.make(np.linalg.det)),
    "cached": lambda f: (f.make(lru_cache(f.one)), f.make(lru_cache(f.other))),
}


@pytest.mark.parametrize("pair", PAIRS)
def test_functions_of_one_file_have_stores_of_their_own(functions, tmp_path, pair):
    hashes = [source_digest(function) for function in (*PAIRS[pair](functions), *PAIRS[pair](functions))]
    assert hashes[:2] == hashes[2:]
    assert hashes[0] != hashes[1]
    folders = {fmu.BlackBoxModel(f, 1, name="name", store=tmp_path).solves.folder for f in PAIRS[pair](functions)}
    assert len(folders) == 2


def test_a_second_function_is_not_answered_by_the_first(functions, tmp_path):
    theta = np.array([2.0])
    for mesh, power in (("fine", 0.5), ("coarse", 0.25)):
        model = fmu.BlackBoxModel(functions.make(mesh), 1, store=tmp_path)
        model.solved.least_s = 0.0
        assert model.at(np.array([1.0])).frequencies == 10.0  # both
        assert model.solve(theta).frequencies == 10.0 * theta**power


def test_the_hash_is_the_same_in_every_process(functions, tmp_path):
    code = "import functions as f, fmu.fem.programs.sources as s; print(*map(s.source_digest, (f.many, f.one)))"
    for seed in ("1", "2"):
        environment = os.environ | {"PYTHONHASHSEED": seed, "PYTHONPATH": str(tmp_path)}
        printed = subprocess.run(
            [sys.executable, "-c", code], env=environment, capture_output=True, check=True, text=True
        )
        assert printed.stdout.split() == [source_digest(functions.many), source_digest(functions.one)]


@pytest.mark.parametrize(
    ("held", "function"),
    [
        ("functions.Model", lambda f: f.Model(0.5).modes),
        ("functions.Model", lambda f: f.make([f.Model(0.5)])),
        ("numpy.ndarray", lambda f: f.make(np.array([object()]))),
        ("<lambda>, which is in no file", lambda f: f.make(eval("lambda theta: theta"))),
    ],
)
def test_a_store_is_refused_if_a_change_would_not_be_noticed(functions, tmp_path, held, function):
    function = function(functions)
    assert source_digest(function)  # as before
    assert unknown_value(function) == held
    with pytest.raises(ValueError, match=f"store: the function must hold only values .*it holds: {held}"):
        fmu.BlackBoxModel(function, 1, store=tmp_path)
    assert fmu.BlackBoxModel(function, 1).solves is None


def test_a_problem_file_with_such_a_function_has_no_store(tmp_path):
    (tmp_path / "functions.py").write_text(FUNCTIONS + "\nmethod = Model(0.5).modes\n")
    for name, has_store in (("method", False), ("plain", True), ("many", True)):
        model = PythonTable(type="python", function=f"functions:{name}").build(tmp_path, [None]).model
        assert (model.solves is not None) == has_store
