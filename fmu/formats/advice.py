"""Instructions for exporting stiffness and mass matrices from finite-element programs, keyed by file suffix."""

from __future__ import annotations

NASTRAN = (
    "PARAM,EXTOUT,DMIGPCH in the bulk data writes K and M of the a-set (all free nodes in ASET1 entries, where it "
    "writes none) to job.pch; MYSTRAN does with OUTPUT4 KGG,MGG,,,//-1/21 in the executive control, to job.OU1"
)
ABAQUS = (
    "*MATRIX GENERATE, STIFFNESS, MASS and *MATRIX OUTPUT, STIFFNESS, MASS, FORMAT=MATRIX INPUT in a step of "
    "their own write job_STIF1.mtx and job_MASS1.mtx"
)
CALCULIX = "*FREQUENCY, SOLVER=MATRIXSTORAGE writes job.sti, job.mas and job.dof"
ANSYS = "a modal analysis leaves job.full (WRFULL,1 stops after writing it)"
OPTISTRUCT = "PARAM,EXTOUT,DMIGPCH in the bulk data, with the nodes in ASET1 entries, writes K and M to job.pch"
_HOW = {"Nastran": NASTRAN, "OptiStruct": OPTISTRUCT, "Abaqus": ABAQUS, "CalculiX": CALCULIX, "Ansys": ANSYS}
_PROGRAMS = {
    **dict.fromkeys((".op2", ".f06", ".f04", ".xdb", ".bdf", ".nas", ".pch"), ("Nastran",)),
    **dict.fromkeys((".fem", ".h3d"), ("OptiStruct",)),
    **dict.fromkeys((".odb", ".sim", ".cae"), ("Abaqus",)),
    **dict.fromkeys((".rst", ".cdb", ".db"), ("Ansys",)),
    ".frd": ("CalculiX",),
    ".inp": ("CalculiX", "Abaqus"),
    ".dat": ("Nastran", "CalculiX", "Ansys"),
}
"""Programs that may use each file suffix."""


def how_to_export(suffix: str) -> str:
    """Return text to append to a message: how to export matrices from the programs that use this file suffix.

    Return "" if no such program is known.

    Parameters
    ----------
    suffix : str
        Lower-case suffix of the file name, such as ``".op2"``.
    """
    said = "; ".join(f"{program}: {_HOW[program]}" for program in _PROGRAMS.get(suffix, ()))
    return said and f". How to get K and M out of {said}. The template of fmu init exports reads them"
