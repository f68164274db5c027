"""Size and accuracy: the reduced model over its box, the classical reductions, and a structure of 10⁴ DOF."""

import os
import resource
import time

import numpy as np
import pytest

from fmu.fem.modal import eigen, frequency_hz
from fmu.fem.reduced_basis import ReducedBlock
from fmu.fem.reduction import craig_bampton, guyan
from tests.benchmarks.ratio import paired_ratio, spd
from tests.benchmarks.tower import tower_problem

CASES = [(case, pairing) for case in ("cantilever-young", "cantilever-section") for pairing in ("shape", "index")]


def reduced_blocks(problem):
    return [block for block in problem.model.reduced.blocks if isinstance(block, ReducedBlock)]


@pytest.mark.parametrize(("case", "pairing"), CASES)
def test_accuracy_over_the_box(load, benchmark, case, pairing):
    problem = load(case, pairing)
    corners = np.array(np.meshgrid(*zip(problem.lower, problem.upper, strict=True), indexing="ij"))
    inside = problem.sample_prior(np.random.default_rng(2), 1000)
    theta = np.concatenate([inside, corners.reshape(problem.ndim, -1).T])
    reduced = benchmark.pedantic(problem.frequencies, (theta,), rounds=3)
    error = np.max(np.abs(reduced / frequency_hz(problem.model.full_modes(theta).eigenvalues) - 1))
    sizes = [block.size for block in reduced_blocks(problem)]
    benchmark.extra_info.update(
        {
            "what": f"largest relative frequency error, {case} by {pairing}, 1000 prior draws and all corners "
            f"(basis {'+'.join(map(str, sizes))} of 300)",
            "measured": f"{error:.2g}",
            "budget": "≤ 1e-06",
            "met": bool(error <= 1e-6),
        }
    )


def test_classical_reductions(load, benchmark):
    """Largest relative error of W1 … W5 at the posterior's maximum, against the size of the reduced matrices."""
    problem = load("cantilever-young")
    model = problem.model.structure
    theta = np.array([1.733e11, 1.937e11, 2.392e11, 2.5e11, 1.7e11])
    plane = next(dofs for dofs in model.blocks if model.dof(49, "z") in dofs)
    K, M = (matrix(theta)[plane][:, plane] for matrix in (model.K, model.M))
    exact = frequency_hz(eigen(K, M, 5)[0])

    def local(nodes, directions):
        return [int(np.flatnonzero(plane == model.dof(n, d))[0]) for n in nodes for d in directions]

    def error(lam):
        return float(np.max(np.abs(frequency_hz(lam[:5]) / exact - 1)))

    rows = []
    for n in (5, 10, 20, 25, 50):
        masters = local(np.round(np.linspace(50 / n, 50, n)).astype(int), "z")
        rows.append(("Guyan, masters w", n, error(guyan(K, M, masters).eigen(5)[0])))
    boundary = local((10, 20, 30, 40), ("z", "ry"))
    for n in (1, 2, 3, 4, 6):
        reduction = craig_bampton(K, M, boundary, n)
        rows.append((f"Craig–Bampton, {n} modes a part", len(reduction.K), error(reduction.eigen(5)[0])))
    block = reduced_blocks(problem)[0]
    for size in sorted({8, 10, 12, 14, 16, block.size}):
        if size <= block.size:
            lam = block.truncated(size).eigenvalues(theta[None], 5)[0]
            rows.append(("parametric reduced basis", size, error(lam)))
    benchmark.pedantic(lambda: guyan(K, M, boundary), rounds=3)
    benchmark.extra_info["reductions"] = rows
    benchmark.extra_info.update(
        {"what": "Guyan of the weak plane onto 8 masters", "measured": "see below", "budget": "—", "met": True}
    )


def test_tower(benchmark, against, monkeypatch):
    """10 080 DOF, eight moduli: what the offline stage takes, and that the online one does not notice the size."""
    monkeypatch.setitem(os.environ, "FMU_CACHE_DIR", "")
    began, busy = time.perf_counter(), time.process_time()
    problem = tower_problem()
    wall, cpu = time.perf_counter() - began, time.process_time() - busy
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    block = reduced_blocks(problem)[0]
    # the beam at equal basis size: the same kind of block, solved in the same batches
    theta = problem.sample_prior(np.random.default_rng(3), 64)
    matrices = spd(64, block.size)
    relative = paired_ratio(lambda: problem.log_prob(theta), lambda: np.linalg.eigvalsh(matrices))
    benchmark.extra_info["tower"] = {
        "DOF": problem.model.structure.n_dof,
        "parameters": problem.ndim,
        "modes": problem.data.n_modes,
        "basis": block.size,
        "offline, s of wall time": round(wall, 1),
        "offline, s of CPU": round(cpu, 1),
        "peak memory of the process, GiB": round(peak, 2),
        f"log_prob against eigvalsh {block.size}×{block.size}": round(relative, 2),
    }
    beam = beam_of_size(block.size)
    what = f"log_prob of the 10 080-DOF frame against the 300-DOF beam at equal basis size ({block.size})"
    beam_theta = beam.sample_prior(np.random.default_rng(3), 64)
    against(what, lambda: problem.log_prob(theta), lambda: beam.log_prob(beam_theta), 1.2)


def beam_of_size(size):
    """Return the beam with eight moduli and six modes of one plane, its basis blown up to `size` vectors."""
    import fmu
    from fmu.cases import cantilever
    from fmu.fem.frame import Frame
    from fmu.fem.model import BlockModel

    whole = cantilever.beam(1)
    group = whole.groups[0]
    parts = np.array_split(np.asarray(group.elements), 8)
    groups = [type(group)(str(g), part, group.section, group.material) for g, part in enumerate(parts)]
    # not along an axis of the section: one block, which has more degrees of freedom than vectors are needed
    nodes = np.asarray(whole.nodes) @ np.linalg.qr(np.random.default_rng(0).standard_normal((3, 3)))[0]
    groups = [type(g)(g.name, g.elements, g.section, g.material, (0.3, 1.0, 0.2)) for g in groups]
    frame = Frame(nodes, groups, whole.supports, whole.masses)
    model = frame.separable({f"E{g}": [("E", str(g))] for g in range(8)})
    parameters = [
        fmu.Parameter(
            f"E{g}", start=2.1e11, lower=1.7e11, upper=2.5e11, prior=fmu.posterior.parameters.Normal(2e11)
        )
        for g in range(8)
    ]
    data = fmu.ModalData([31.9, 190.0, 197.9, 540.0, 553.0, 1082.2])
    problem = fmu.UpdatingProblem(model, data, parameters, pairing="shape")
    b = next(i for i, block in enumerate(problem.model.reduced.blocks) if isinstance(block, ReducedBlock))
    full = problem.model.full.blocks[b]
    basis = full.modes(problem.start[None], size)[1][0]
    blocks = list(problem.model.reduced.blocks)
    blocks[b] = ReducedBlock(full, basis, blocks[b].trusted)
    problem.model._solve_reduced = problem.model.pairing.bind(BlockModel(tuple(blocks), 8))
    return problem
