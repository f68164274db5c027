"""Readers for stiffness and mass matrices written by other programs.

Reading order: read, limits; then one file per format.
"""

from fmu.formats.matrices import (
    ansys,
    calculix,
    harwell_boeing,
    hdf5,
    matlab,
    matlab_text,
    matrix_market,
    numpy_files,
)
from fmu.formats.matrices.nastran import dmig, op4

FORMATS = (
    matrix_market.FORMAT,
    numpy_files.NPZ,
    numpy_files.NPY,
    matlab.FORMAT,
    matlab_text.FORMAT,
    hdf5.FORMAT,
    harwell_boeing.FORMAT,
    numpy_files.CSV,
    calculix.FORMAT,
    ansys.FORMAT,
    op4.FORMAT,
    dmig.FORMAT,
)
