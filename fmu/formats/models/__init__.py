"""Readers for models from other programs: matrices with named degrees of freedom, nodes and elements.

Reading order: exported, read, assembly, constrained, ties, edges; then one file per mesh format (bulk with
coordinate_systems). The matrices are read by `fmu.formats.matrices`.
"""

from fmu.formats.models import ansys, bulk, inp

FORMATS = (inp.FORMAT, ansys.CDB, ansys.RST, bulk.FORMAT)
"""File formats with nodes and elements."""
