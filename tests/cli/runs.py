"""A short run of two storeys in the shell, broken off and resumed: what the tests of it share."""

import h5py
import numpy as np
from click.testing import CliRunner

from fmu.cli import main

PROBLEM = """\
name = "two storeys"
reduction = false

[model]
type = "matrices"
dofs = [["first", "x"], ["second", "x"]]

[[model.stiffness]]
matrix = [[1.0, 0.0], [0.0, 0.0]]
powers = { k1 = 1 }

[[model.stiffness]]
file = "k2.csv"
powers = { k2 = 1 }

[[model.mass]]
matrix = [[16.5e3, 0.0], [0.0, 16.1e3]]

[measurement]
frequencies = [4.1, 10.9]
sd = 0.3

[[parameters]]
name = "k1"
start = 2.97e7
lower = 1e7
upper = 6e7

[[parameters]]
name = "k2"
start = 2.97e7
lower = 1e7
upper = 6e7
"""
SECOND = "1.0,-1.0\n-1.0,1.0\n"
LENGTH = ("--warmup", 10, "--draws", 15, "--chains", 2, "--starts", 2)
SAMPLERS = ("mh", "hmc", "emcee", "tempering")
QUIET = ("--no-report", "--progress", "none")
# a function is called again where that was forgotten, hence the solves
CLOCKS = {"created_at", "wall_s", "warmup_wall_s", "gradient_cost", "before_n_solves", "after_n_solves"}
LINKS = {"DIMENSION_LIST", "REFERENCE_LIST"}  # places in the file


class Cut(BaseException):
    """Ends a process like a kill, as far as the code under test can tell."""


def problem_in(folder):
    (folder / "two.toml").write_text(PROBLEM)
    (folder / "k2.csv").write_text(SECOND)
    return folder


def cut():
    raise Cut


def invoke(*arguments):
    return CliRunner().invoke(main, list(map(str, arguments)), prog_name="fmu")


def run(*more, length=LENGTH):
    return invoke("run", "two.toml", *length, "--keep-draws", 5, "--out", "out", *QUIET, *more)


def of(*samplers):
    return (*LENGTH, *(word for name in samplers for word in ("--sampler", name)))


def resume(*more):
    return invoke("run", "--resume", "out", *QUIET, *more)


def content(path):
    """Return all values and attributes of a trace but for the clocks, by their place in the file."""
    found = {}

    def visit(place, item):
        found.update({f"{place}@{key}": value for key, value in item.attrs.items() if key not in LINKS})
        if isinstance(item, h5py.Dataset):
            found[place] = item[()]

    with h5py.File(path) as file:
        visit("", file)
        file.visititems(visit)
    return {place: value for place, value in found.items() if place.removeprefix("@") not in CLOCKS}


def assert_same(name, one, other):
    """The traces of a sampler are the same bit for bit, but for the clocks."""
    first, second = (content(folder / f"{name}.nc") for folder in (one, other))
    assert first.keys() == second.keys()
    for place, value in first.items():
        np.testing.assert_array_equal(value, second[place], place)


def assert_refused(result, *words):
    assert result.exit_code == 2, result.output
    assert len(result.stderr.splitlines()) == 1, result.stderr
    assert all(word in result.stderr for word in words), result.stderr
