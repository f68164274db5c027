"""Broken files of other programs: each is refused in a sentence that names the argument and what is wrong."""

import importlib.util
import shutil
from pathlib import Path

import numpy as np
import pytest

import fmu

FILES = Path(__file__).parent / "nastran"
DECK = "*NODE\n5, 0., 0., 0.\n9, 1., 0., 0.\n*ELEMENT, TYPE=T3D2\n1, 5, 9\n"
BULK = "GRID,5,,0.,0.,0.\nGRID,9,,1.,0.,0.\nCBAR,1,1,5,9\n"
STI, MAS, DOF = "1 1 2.0\n1 2 -1.0\n2 2 2.0\n", "1 1 1.0\n2 2 1.0\n", "5.1\n9.1\n"
OP4 = (FILES / "little.op4").read_bytes()
TEXT = (FILES / "sparse.op4").read_text()
PUNCH = "DMIG,K,0,6,2\nDMIG,K,5,1,,5,1,2.\nDMIG,M,0,6,2\nDMIG,M,5,1,,5,1,1.\n"


def changed(content, at, value):
    return content[:at] + value + content[at + len(value) :]


def number(value):
    return np.array(value, "<i4").tobytes()


BROKEN = {
    # CalculiX
    "no .dof": ({"j.sti": STI, "j.mas": MAS}, {}, r"^path: .*j\.dof beside it \(no such file"),
    "no .mas": ({"j.sti": STI, "j.dof": DOF}, {}, r"^mass: must be a file"),
    ".dof of another mesh": ({"j.sti": STI, "j.mas": MAS, "j.dof": DOF * 3}, {}, r"^path: must have the 6 rows"),
    ".dof too short": ({"j.sti": STI, "j.mas": MAS, "j.dof": "5.1\n"}, {}, r"^path: must have the 1 rows.*got row 2"),
    ".dof of temperatures": ({"j.sti": STI, "j.mas": MAS, "j.dof": "5.0\n9.0\n"}, {}, r"line 1 must be node\.dir"),
    ".dof of words": ({"j.sti": STI, "j.mas": MAS, "j.dof": "five.x\n"}, {}, r"line 1 must be node\.direction"),
    "absurd node": ({"j.sti": STI, "j.mas": MAS, "j.dof": "9" * 400 + ".1\n9.1\n"}, {}, r"line 1 must be node\.dir"),
    "NaN": ({"j.sti": STI.replace("-1.0", "nan"), "j.mas": MAS, "j.dof": DOF}, {}, r"^path: must be finite"),
    "half a line": ({"j.sti": STI + "2 2", "j.mas": MAS, "j.dof": DOF}, {}, r"^path: must hold a matrix"),
    "fraction of a row": ({"j.sti": "1.5 1 2.\n", "j.mas": MAS, "j.dof": DOF}, {}, r"whole numbers from 1"),
    "empty .sti": ({"j.sti": "", "j.mas": MAS, "j.dof": DOF}, {}, r"^path: must hold a matrix .*no numbers"),
    "UTF-16": ({"j.sti": STI.encode("utf-16"), "j.mas": MAS, "j.dof": DOF}, {}, r"NUL bytes"),
    "entries twice": (
        {"j.sti": STI + "2 1 7.0\n", "j.mas": MAS, "j.dof": DOF}, {}, r"^path: must have each pair of entries once",
    ),
    # input decks
    "another deck": (
        {"j.sti": STI, "j.mas": MAS, "j.dof": DOF, "j.inp": "*NODE\n1, 0., 0., 0.\n"},
        {"mesh": "j.inp"}, r"^mesh: must have the nodes of the matrices, such as 5",
    ),
    "included file": ({"j.inp": "*INCLUDE, INPUT=/etc/passwd\n"}, None, r"\*INCLUDE names are not followed"),
    "nodes in a file": ({"j.inp": "*NODE, INPUT=/etc/passwd\n"}, None, r"\*INPUT names are not followed"),
    "parts": ({"j.inp": "*PART, NAME=A\n" + DECK}, None, r"line 1: it has parts and instances"),
    "generated nodes": ({"j.inp": DECK + "*NGEN\n5, 9, 1\n"}, None, r"\*NGEN generates"),
    "no nodes": ({"j.inp": "** empty\n"}, None, r"must have nodes \(it has none"),
    "unknown node": ({"j.inp": DECK.replace("1, 5, 9", "1, 5, 7")}, None, r"there is no node 7"),
    "half an element": ({"j.inp": DECK.replace("1, 5, 9", "1, 5,")}, None, r"1 of its 2 nodes"),
    "coordinate": ({"j.inp": DECK.replace("1., 0., 0.", "one, 0., 0.")}, None, r"line 3: a coordinate must be a num"),
    "infinite": ({"j.inp": DECK.replace("1., 0., 0.", "1e999, 0., 0.")}, None, r"finite coordinates \(node 9"),
    "negative node": ({"j.inp": DECK.replace("5, 0.", "-5, 0.")}, None, r"line 2: numbers of nodes and elements must be"),
    # OP4
    "truncated": ({"a.op4": OP4[:-60], "a.bdf": ""}, {}, r"^path: must hold .*cut short"),
    "half a header": ({"a.op4": OP4[:10]}, {}, r"^path: must hold .*cut short"),
    "absurd columns": ({"a.op4": changed(OP4, 4, number(2**31 - 1))}, {}, r"^path: "),
    "absurd rows": ({"a.op4": changed(OP4, 8, number(-(2**31)))}, {}, r"^path: "),
    "absurd record": ({"a.op4": changed(OP4, 32, number(2**31 - 1))}, {}, r"^path: must hold .*cut short"),
    "complex": ({"a.op4": changed(OP4, 16, number(4))}, {"variables": ("KGG", "MGG")}, r"^path: must hold a real"),
    "type": ({"a.op4": changed(OP4, 16, number(9))}, {}, r"a type from 1 to 4"),
    "not OP4": ({"a.op4": "hello\n"}, {}, r"^path: must hold .*must begin with columns, rows, form"),
    "text cut": ({"a.op4": TEXT[: len(TEXT) // 3]}, {}, r"^path: must hold .*cut short"),
    "text entry outside": ({"a.op4": TEXT.replace(" 1638407\n", " 1638430\n")}, {"variables": ("KGG", "MGG")}, r"outside"),
    "one matrix": ({"a.op4": TEXT[TEXT.index("      30      30       6       2MGG") :]}, {}, r"one matrix: give the other"),
    "no names": ({"a.op4": OP4}, {}, r"^path: has 30 rows without names"),
    "rows of another deck": ({"a.op4": OP4, "a.bdf": BULK}, {"mesh": "a.bdf"}, r"^path: has 30 rows .* 12 of the g-set"),
    "too few names": ({"a.op4": OP4, "n.csv": "5,x\n"}, {"dofs": "n.csv"}, r"^dofs: must name 30 degrees"),
    "broken names": ({"a.op4": OP4, "n.csv": "5,x\n5,w\n"}, {"dofs": "n.csv"}, r"^dofs: n\.csv: line 2 must be node,dir"),
    "same name": ({"a.op4": OP4, "n.csv": "5,x\n" * 30}, {"dofs": "n.csv"}, r"^path: must name each .* once \(got 5 x"),
    # DMIG
    "other rows": ({"a.pch": PUNCH.replace("M,5,1,,5", "M,7,1,,7")}, {}, r"^path: must have degrees of freedom that"),
    "no such matrix": ({"a.pch": PUNCH}, {"variables": ("K", "B")}, r"^path: must be one of K, M \(got 'B'"),
    "component": ({"a.pch": PUNCH.replace("5,1,,5,1", "5,9,,5,1")}, {}, r"^path: .*components 1 to 6"),
    "entry": ({"a.pch": PUNCH.replace("2.\n", "two\n")}, {}, r"^path: .*an entry must be a real number"),
    "no entries": ({"a.pch": "SOL 103\nCEND\n"}, {}, r"^path: must hold a matrix \(it holds none"),
    "both triangles": (
        {"a.pch": PUNCH.replace("5,1,2.\n", "5,1,2.\n,5,2,1.\nDMIG,K,5,2,,5,1,1.\n")}, {}, r"each pair of entries once",
    ),
    # bulk data
    "included bulk": ({"a.bdf": "INCLUDE '/etc/passwd'\n"}, None, r"inside the folder of the deck .INCLUDE '/etc/pas"),
    "node twice": ({"a.bdf": BULK + "GRID,5,,0.,0.,0.\n"}, None, r"each node once \(it has GRID 5 twice"),
    "system of itself": ({"a.bdf": "CORD2R,1,1,0.,0.,0.,0.,0.,1.\n,1.,0.,0.\nGRID,5,1,0.,0.,0.\n"}, None, r"refer to them"),
    "no system": ({"a.bdf": "GRID,5,7,0.,0.,0.\n"}, None, r"the coordinate system 7 \(it has not"),
    "points in line": ({"a.bdf": "CORD2R,1,,0.,0.,0.,0.,0.,1.\n,0.,0.,2.\nGRID,5,1,0.,0.,0.\n"}, None, r"not in line"),
    "absurd THRU": ({"a.bdf": BULK + "SPOINT,1,THRU,999999999\n"}, None, r"at most 1048576 numbers"),
    "superelements": ({"a.bdf": BULK + "BEGIN SUPER=1\n" + BULK}, None, r"one structure \(it has superelements"),
    "repeated fields": ({"a.bdf": BULK + "=,*1,==\n"}, None, r"repeat fields of the one before"),
    "lacking node": ({"a.bdf": BULK.replace("5,9\n", "5\n")}, None, r"CBAR 1 must have 2 nodes"),
    # others
    "unknown suffix": ({"a.stl": ""}, None, r"must end in"),
    "a folder": ({"a.inp/x": ""}, None, r"is a directory"),
}  # fmt: skip


@pytest.mark.parametrize("case", BROKEN)
def test_it_is_refused_with_a_reason(tmp_path, case):
    files, options, message = BROKEN[case]
    for name, content in files.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    first = tmp_path / Path(next(iter(files))).parts[0]
    paths = {key: tmp_path / value if isinstance(value, str) else value for key, value in (options or {}).items()}
    read = fmu.read_mesh if options is None else fmu.read_model
    with pytest.raises(ValueError, match=message) as caught:
        read(first, **paths)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 600


OF_NASTRAN = ("little.op4", "strings.op4", "bigmat.op4", "sparse.op4", "small.pch", "turned.bdf")


@pytest.mark.parametrize(
    ("name", "times"),
    [
        *((name, 50) for name in OF_NASTRAN),
        *(pytest.param(name, 500, marks=pytest.mark.validate) for name in OF_NASTRAN),
    ],
)
def test_random_damage_is_refused_or_harmless(tmp_path, name, times):
    content, rng = (FILES / name).read_bytes(), np.random.default_rng(1)
    shutil.copy(FILES / "portal.bdf", tmp_path)
    for _ in range(times):
        broken = bytearray(content)
        for at in rng.integers(0, len(content), 1 + rng.integers(8)):
            broken[at] = rng.choice([0, 255, 127, 45, 48, 57, rng.integers(256)])
        (tmp_path / name).write_bytes(
            bytes(broken[: rng.integers(1, len(broken))] if rng.random() < 0.2 else broken)
        )
        said = ""
        try:
            if name.endswith(".bdf"):
                fmu.read_mesh(tmp_path / name)
            else:
                fmu.read_model(tmp_path / name, mesh=tmp_path / "portal.bdf")
        except ValueError as error:
            said = str(error)
        assert said.isprintable()


@pytest.mark.skipif(importlib.util.find_spec("mapdl_archive") is not None, reason="the library is installed")
def test_a_library_that_is_not_installed_is_named(tmp_path):
    (tmp_path / "a.cdb").write_text("/PREP7\n")
    with pytest.raises(ValueError, match=r"pip install 'fmu\[ansys\]'"):
        fmu.read_mesh(tmp_path / "a.cdb")
