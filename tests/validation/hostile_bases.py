"""Right problems, to be changed: all templates with and without their options, every source of modes, all cases."""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import NamedTuple

import fmu
from fmu import cases
from fmu.config.template import files, template
from fmu.formats.modes.pyoma import save_pyoma

PROBLEM = "problem.toml"


class Base(NamedTuple):
    """A problem that is right: its text, and the files beside it."""

    text: str
    beside: Mapping[str, bytes]


def plain(kind: str) -> str:
    """Return a template without a reduced model, which takes seconds, and with two elements a member."""
    text = template(kind).replace("#: reduction = true ", "reduction = false #", 1)
    return re.sub(r"elements = \d+", "elements = 2", text)


def _without_options(text: str) -> str:
    return re.sub(r"(?m)^#: .*\n", "", text)


def _with_errors(text: str) -> str:
    """Return a template with its error models, which are at its end, in place of the measured deviations."""
    first, last = text.split("#: [[error]]")
    first = re.sub(r"(?m)^sd = .*\n", "", _without_options(first))
    return first + ("#: [[error]]" + last).replace("#: ", "")


def _case(name: str) -> Base:
    path = cases.path(name)
    text = path.read_text(encoding="utf-8").replace("\ndescription = ", "\nreduction = false\ndescription = ", 1)
    text = re.sub(r"(?m)^elements = \d+", "elements = 1", text) if name == "garteur" else text
    folder = path.with_suffix("")
    found = folder.iterdir() if folder.is_dir() else ()
    return Base(text, {f"{name}/{file.name}": file.read_bytes() for file in sorted(found)})


def universal_file(folder: Path) -> bytes:
    """Return a universal file of two modes at the nodes 1 and 3."""
    sensors = ((1, "x"), (3, "x"))
    data = fmu.ModalData([2.314, 6.312], (1, 2), sensors, shapes=[[0.46, -0.98], [0.99, 0.91]])
    data.to_uff(folder / "modes.uff")
    return (folder / "modes.uff").read_bytes()


def identified(folder: Path) -> bytes:
    """Return a file of an operational modal analysis, two modes at two sensors."""
    result = {
        "Fn": [2.314, 6.312],
        "Phi": [[0.46, -0.98], [0.99, 0.91]],
        "Fn_std": [0.01, 0.02],
        "Xi": [0.01, 0.01],
    }
    save_pyoma(folder / "oma.npz", result)
    return (folder / "oma.npz").read_bytes()


FREQUENCIES = "mode,number,frequency,sd\nsway,1,2.314,0.01\nsecond,2,6.312,0.03\nthird,3,8.818,0.04\n"
SHAPES = "place,direction,sway,second,third\nfloor 1,x,0.46,-0.98,-1\nfloor 3,x,0.99,0.91,-0.83\n"
_MEASURED = re.compile(r"(?s)(\[measurement\]\n).*?(?=\n\[\[parameters\]\])")
_SENSORS = 'sensors = [["floor 1", "x"], ["floor 3", "x"]]\n'


@cache
def bases(folder: Path) -> dict[str, Base]:
    """Return the problems to start from: all templates with and without their options, every source, all cases."""
    storeys = {name: _template_file("python", name) for name in files("python")[1:]}
    matrices = {name: _template_file("matrices", name) for name in files("matrices")[1:]}
    python = _without_options(plain("python"))

    def measured(text: str) -> str:
        return _MEASURED.sub(lambda found: found.group(1) + text, python)

    rows = "[[model.stiffness]]\nmatrix = [[3e7, -1e7], [-1e7, 1e7]]\npowers = { k = 1 }\n[[model.mass]]\n"
    rows += "matrix = [[1e4, 0.0], [0.0, 1e4]]\n\n[measurement]\nfrequencies = [4.0, 10.0]\nsd = [0.1, 0.2]\n\n"
    rows += '[[parameters]]\nname = "k"\nstart = 1.0\nlower = 0.5\nupper = 2.0\n'
    tests = "tests = [[2.31, 6.31, 8.81], [2.32, 6.33, 8.80], [2.30, nan, 8.83], [2.31, 6.30, 8.82]]\n"
    nodes = '[measurement.uff]\nfile = "modes.uff"\n[measurement.uff.nodes]\n1 = "floor 1"\n3 = "floor 3"\n'
    table = 'file = "modes.csv"\nshapes_file = "shapes.csv"\n'
    deck, other_deck = ({"structure.inp.in": text} for text in (b"{k feet}\n", b"{lower columns}\n"))
    tables = {"modes.csv": FREQUENCIES.encode(), "shapes.csv": SHAPES.encode()}
    return {
        "frame": Base(_without_options(plain("frame")), {}),
        "frame with errors": Base(_with_errors(plain("frame")), deck),
        "matrices": Base(_without_options(plain("matrices")), matrices),
        "matrices with errors": Base(_with_errors(plain("matrices")), matrices | other_deck),
        "rows of matrices": Base(f'name = "rows"\nreduction = false\n[model]\ntype = "matrices"\n{rows}', {}),
        "python": Base(python, storeys),
        "python with errors": Base(_with_errors(plain("python")), storeys),
        "tests": Base(measured(tests + _SENSORS), storeys),
        "tables": Base(measured(table), storeys | tables),
        "universal file": Base(measured("sd = 0.02\n" + nodes), storeys | {"modes.uff": universal_file(folder)}),
        "operational": Base(
            measured(_SENSORS + 'oma = { file = "oma.npz" }\n'), storeys | {"oma.npz": identified(folder)}
        ),
        **{name: _case(name) for name in cases.names()},
    }


def _template_file(kind: str, name: str) -> bytes:
    from importlib.resources import files as resources

    return resources("fmu.config").joinpath("templates", kind, name).read_bytes()


def put(folder: Path, base: Base, content: bytes) -> Path:
    """Write a problem file and its neighbours."""
    for name, beside in base.beside.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(beside)
    (folder / PROBLEM).write_bytes(content)
    return folder / PROBLEM
