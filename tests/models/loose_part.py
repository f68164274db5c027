"""The clamped tower with a beam beside it that nothing holds: the one kind of model that is to be refused."""

import numpy as np
import scipy.sparse as sp

from fmu.fem.frame.components import ElementGroup
from fmu.fem.frame.frame import Frame
from tests.models import tower
from tests.models.written import write_problem

FIRST = 5001
"""Number of the first node of the loose beam."""


def write(folder, top='pairing = "index"'):
    """Write the problem and return its path."""
    of_group, M, dofs = tower.matrices()
    nodes = np.stack([np.linspace(0.0, 4.0, 7), np.full(7, -3.0), np.full(7, 1.0)], axis=1)
    elements = np.stack([np.arange(6), np.arange(1, 7)], axis=1)
    beam = Frame(
        nodes, [ElementGroup("loose", elements, tower.BEAM, tower.CONCRETE, (0.0, 0.0, 1.0))], {}
    ).separable({})
    zero = sp.csr_array((beam.n_dof, beam.n_dof))
    terms = [(sp.block_diag([K, zero]), {name: 1}) for name, K in of_group.items()]
    alone = sp.csr_array((len(dofs), len(dofs)))
    terms.append((sp.block_diag([alone, beam.K([])]), {}))
    dofs = [*dofs, *((FIRST + node, direction) for node, direction in beam.dofs)]
    mass = [(sp.block_diag([M, beam.M([])]), {})]
    measured = np.array([1.0, 1.1, 1.5])
    return write_problem(
        folder,
        "loose-part",
        {"stiffness": terms, "mass": mass},
        dofs,
        tower.TRUTH,
        dict.fromkeys(tower.TRUTH, (0.3, 2.0)),
        measured,
        0.01 * measured,
        top=top,
    )
