"""Who gives a deck or a results file without matrices is told how the program writes them."""

import pytest

import fmu
from fmu.formats.matrices.read import read_matrix
from fmu.formats.modes.f06 import read_f06
from fmu.formats.modes.measured_modes import ModesError

BULK = "BEGIN BULK\nGRID,1,,0.,0.,0.\nENDDATA\n"


@pytest.mark.parametrize(
    ("name", "advice"),
    [
        ("a.op2", "out of Nastran: PARAM,EXTOUT,DMIGPCH in the bulk data writes K and M of the a-set"),
        ("a.bdf", r"out of Nastran: .* OUTPUT4 KGG,MGG,,,//-1/21 in the executive control, to job\.OU1"),
        ("a.dat", r"out of Nastran: .*; CalculiX: .*; Ansys: a modal analysis leaves job\.full"),
        ("a.fem", "out of OptiStruct: PARAM,EXTOUT,DMIGPCH in the bulk data, with the nodes in ASET1"),
        (
            "a.inp",
            r"out of CalculiX: \*FREQUENCY, SOLVER=MATRIXSTORAGE .*; Abaqus: \*MATRIX GENERATE, STIFF",
        ),
        ("a.RST", r"out of Ansys: a modal analysis leaves job\.full"),
    ],
)
def test_a_file_without_matrices(tmp_path, name, advice):
    (tmp_path / name).write_text(BULK)
    for read in (read_matrix, fmu.read_model):
        with pytest.raises(ValueError, match=f"must hold a matrix .*{advice}.*fmu init exports reads them"):
            read(tmp_path / name)


def test_modes_in_an_op2(tmp_path):
    (tmp_path / "a.op2").write_bytes(b"\0\1\2")
    with pytest.raises(ModesError, match=r"must be the printed output, \.f06: DISP\(PRINT\) = ALL"):
        read_f06(tmp_path / "a.op2", [(1, "x")])
