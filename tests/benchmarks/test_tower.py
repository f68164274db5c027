"""A structure of 10⁴ degrees of freedom: the cost of training, and of a log-probability after it."""

import os
import resource
import time
from functools import partial

import numpy as np

import fmu
from fmu.fem.frame.components import ElementGroup
from fmu.fem.frame.frame import Frame
from fmu.fem.modes.modal import frequency_hz
from fmu.fem.reduced.basis import ReducedBlock
from fmu.posterior.priors.base import Normal
from fmu.posterior.reduction.region import plausible_points
from tests import cantilever
from tests.benchmarks.tower import tower_problem

OFFLINE_SECONDS, OFFLINE_GIB = 180, 4


def test_tower(monkeypatch, note, within, against):
    """10 080 DOF, eight moduli."""
    monkeypatch.setitem(os.environ, "FMU_CACHE_DIR", "")
    began, busy = time.perf_counter(), time.process_time()
    problem = tower_problem()
    wall, cpu = time.perf_counter() - began, time.process_time() - busy
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    (block,) = (block for block in problem.model.cheap.blocks if isinstance(block, ReducedBlock))
    structure = f"{problem.model.structure.n_dof} DOF, {problem.ndim} parameters, {problem.data.n_modes} modes"
    note("tower", f"basis, {structure}", f"{block.size} vectors")
    note("tower", "offline, processor time", f"{cpu:.0f} s", f"≤ {OFFLINE_SECONDS} s", cpu <= OFFLINE_SECONDS)
    note("tower", "offline, wall time (with other work on the machine)", f"{wall:.0f} s")
    note("tower", "peak memory of the process", f"{peak:.2f} GiB", f"≤ {OFFLINE_GIB} GiB", peak <= OFFLINE_GIB)

    points = plausible_points(problem, 20, np.random.default_rng(6))[:20]
    exact = frequency_hz(problem.model.truth.modes(points).eigenvalues)
    within(
        "tower", "frequency, 20 plausible points", np.max(np.abs(problem.frequencies(points) / exact - 1)), 1e-6
    )
    terms = problem.likelihood.error.log_prob_terms(exact)
    error = np.max(np.abs(problem.log_likelihood(points) - terms.sum(axis=1)))
    within("tower", "log_prob, 20 plausible points", error, 1e-3)

    beam = beam_of_size(block.size)
    theta, beam_theta = (p.sample_prior(np.random.default_rng(3), 64) for p in (problem, beam))
    what = f"log_prob, batch of 64, against the 300-DOF beam at equal basis size ({block.size})"
    against(what, lambda: problem.log_prob(theta), lambda: beam.log_prob(beam_theta), 1.2, section="tower")


def beam_of_size(size):
    """Return the beam of the paper with eight moduli, six modes of one block, and a basis of `size` vectors."""
    whole = cantilever.beam(1)
    group = whole.groups[0]
    parts = np.array_split(np.asarray(group.elements), 8)
    # rotated, so that all degrees of freedom are in one block, which is then large enough for `size` vectors
    nodes = np.asarray(whole.nodes) @ np.linalg.qr(np.random.default_rng(0).standard_normal((3, 3)))[0]
    groups = [
        ElementGroup(str(g), part, group.section, group.material, (0.3, 1.0, 0.2)) for g, part in enumerate(parts)
    ]
    model = Frame(nodes, groups, whole.supports, whole.masses).separable(
        {f"E{g}": [("E", str(g))] for g in range(8)}
    )
    parameters = [
        fmu.Parameter(f"E{g}", start=2.1e11, lower=1.7e11, upper=2.5e11, prior=Normal(2e11)) for g in range(8)
    ]
    data = fmu.ModalData([31.9, 190.0, 197.9, 540.0, 553.0, 1082.2])
    problem = fmu.UpdatingProblem.reduced(model, data, parameters)
    (b,) = (i for i, block in enumerate(problem.model.cheap.blocks) if isinstance(block, ReducedBlock))
    full, trained = problem.model.truth.blocks[b], problem.model.cheap.blocks[b].n_trained
    blown_up = ReducedBlock(full, full.modes(problem.start[None], size)[1][0], trained)
    blocks = tuple(blown_up if i == b else other for i, other in enumerate(problem.model.cheap.blocks))
    problem.model.cheap.solve = partial(problem.model.pairing.solve, blocks)
    return problem
