"""A start at which nothing can be solved is refused with the reason, with a reduced model and without."""

import numpy as np
import pytest
import scipy.sparse as sp

import fmu
from fmu.formats.models.exported import ExportedModel

N = 30


def chain(factor, lacks=None):
    """Return the matrices of a fixed chain, half of its springs times `factor`, without the mass of a node."""
    springs, masses = 1e5 * (1 + np.linspace(0.1, 0.9, N) ** 2), 1 + np.linspace(0.3, 0.8, N) ** 3
    springs[: N // 2] *= factor
    if lacks is not None:
        masses[lacks] = 0.0
    K = np.diag(springs + np.append(springs[1:], 0.0)) - np.diag(springs[1:], 1) - np.diag(springs[1:], -1)
    nothing = np.zeros(0, dtype=np.int64)
    dofs = tuple((i + 1, "x") for i in range(N))
    return ExportedModel(sp.csr_array(K), sp.csr_array(np.diag(masses)), dofs, nothing, np.zeros((0, 3)), (), ())


def problem(factors, lacks, reduction, lower=0.5):
    """Return the problem of exports of which one lacks a mass; what is recovered is negative between others."""
    exports = [fmu.Export({"E": f}, chain(f, lacks.get(i))) for i, f in enumerate(factors)]
    return fmu.UpdatingProblem.reduced(
        fmu.from_exports(exports),
        fmu.ModalData([10.0], numbers=(1,)),
        [fmu.Parameter("E", 1.0, lower, 2.0)],
        pairing="index",
        error=[fmu.FrequencyErrors(sd=0.02)],
        reduction=reduction,
    )


@pytest.mark.parametrize("reduction", [True, False])
def test_the_first_export_lacks_a_mass(reduction):
    rule = r"start: must have a finite log-probability \(got -inf: M is not positive semidefinite.* at node 1 x\)"
    with pytest.raises(ValueError, match=rule):
        problem((1.0, 1.2, 0.7), {0: 0}, reduction)


def test_another_export_lacks_a_mass():
    """In the middle of the bounds, where training begins, there is a motion with a negative mass."""
    with pytest.raises(ValueError, match=r"reduction: the eigenproblem .* has no solution, in the middle"):
        problem((1.0, 1.2, 0.7), {1: N - 1}, True, lower=0.9)
    with pytest.raises(ValueError, match="reduction: M is not positive for every motion, in the middle"):
        problem((1.0, 1.2, 0.7), {1: 0}, True)


def test_a_density_that_overflows_at_the_start():
    with pytest.raises(ValueError, match=r"start: must have a finite log-probability .* overflows"):
        fmu.UpdatingProblem(
            fmu.from_exports([fmu.Export({"E": f}, chain(f)) for f in (1.0, 1.2)]),
            fmu.ModalData([10.0], numbers=(1,)),
            [fmu.Parameter("E", 1.0, 0.5, 2.0)],
            pairing="index",
            error=[fmu.FrequencyErrors(kind="absolute", sd=1e-154)],
        )
