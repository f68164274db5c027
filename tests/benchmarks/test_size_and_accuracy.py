"""Size and accuracy of the reduced model, over its box and in the posterior, and of classical reductions."""

import numpy as np
import pytest

from fmu.fem.condensation import craig_bampton, guyan
from fmu.fem.modes.eigensolver import eigen
from fmu.fem.modes.modal import frequency_gradient, frequency_hz
from fmu.fem.reduced.basis import ReducedBlock
from fmu.posterior.reduction.region import plausible_points

CASES = [(case, pairing) for case in ("cantilever-young", "cantilever-section") for pairing in ("shape", "index")]


def reduced_blocks(problem):
    return [block for block in problem.model.cheap.blocks if isinstance(block, ReducedBlock)]


def relative_slopes(problem, modes):
    """Return ∂ log f over the width of the box, shape (n, n_modes, ndim)."""
    frequencies = frequency_hz(modes.eigenvalues)
    return frequency_gradient(frequencies, modes.gradient) * problem.scale / frequencies[..., None]


def posterior_draws(problem, n, steps=200, seed=4):
    """Return the ends of `n` random walks in the posterior that start at plausible points."""
    rng = np.random.default_rng(seed)
    theta = plausible_points(problem, n, rng)[:n]
    value = problem.log_prob(theta)
    for _ in range(steps):
        proposal = theta + 0.02 * problem.scale * rng.standard_normal(theta.shape)
        proposed = problem.log_prob(proposal)
        accepted = np.log(rng.uniform(size=n)) < proposed - value
        theta, value = np.where(accepted[:, None], proposal, theta), np.where(accepted, proposed, value)
    return theta


@pytest.mark.parametrize(("case", "pairing"), CASES)
def test_accuracy(load, benchmark, note, within, case, pairing):
    problem = load(case, pairing)
    structure = problem.model
    corners = np.array(np.meshgrid(*zip(problem.lower, problem.upper, strict=True), indexing="ij"))
    inside = problem.lower + problem.scale * np.random.default_rng(2).uniform(size=(1000, problem.ndim))
    theta = np.concatenate([inside, corners.reshape(problem.ndim, -1).T])
    reduced = benchmark.pedantic(structure.modes, (theta, True), rounds=3)
    exact = structure.truth.solve(theta, gradient=True)

    sizes = " + ".join(str(block.size) for block in reduced_blocks(problem))
    name = f"{case} by {pairing} (basis {sizes} of 300)"
    box = "1000 random points and all corners"
    f, f_exact = frequency_hz(reduced.eigenvalues), frequency_hz(exact.eigenvalues)
    within("accuracy", f"frequency, {name}, {box}", np.max(np.abs(f / f_exact - 1)), 1e-6)
    slopes, exact_slopes = relative_slopes(problem, reduced), relative_slopes(problem, exact)
    error = np.max(np.abs(slopes - exact_slopes), axis=(1, 2)) / np.max(np.abs(exact_slopes), axis=(1, 2))
    within("accuracy", f"gradient, {name}, {box}", np.max(error), 1e-5)
    other = np.sum(np.any((reduced.block != exact.block) | (reduced.rank != exact.rank), axis=1))
    note("accuracy", f"points with a different pairing, {name}, {box}", int(other), "0", bool(other == 0))

    draws = posterior_draws(problem, 1000)
    full = problem.likelihood.error.log_prob_terms(frequency_hz(structure.truth.modes(draws).eigenvalues))
    error = np.max(np.abs(problem.log_likelihood(draws) - full.sum(axis=1)))
    within("accuracy", f"log_prob, {name}, 1000 posterior draws", error, 1e-3)


def test_classical_reductions(load, benchmark):
    """Largest relative error of W1 … W5 at the maximum of the posterior, for several sizes of reduced matrices."""
    problem = load("cantilever-young")
    model = problem.model.structure
    theta = np.array([1.733e11, 1.937e11, 2.392e11, 2.5e11, 1.7e11])
    plane = next(dofs for dofs in model.blocks if model.dof(49, "z") in dofs)
    K, M = (matrix(theta)[plane][:, plane] for matrix in (model.K, model.M))
    exact = frequency_hz(eigen(K, M, 5)[0])

    def local(nodes, directions):
        return [int(np.flatnonzero(plane == model.dof(n, d))[0]) for n in nodes for d in directions]

    def error(lam):
        return f"{np.max(np.abs(frequency_hz(lam[:5]) / exact - 1)):.1e}"

    rows = []
    for n in (5, 10, 20, 25, 50):
        masters = local(np.round(np.linspace(50 / n, 50, n)).astype(int), "z")
        rows.append(["Guyan, deflections as masters", n, error(guyan(K, M, masters).eigen(5)[0])])
    boundary = local((10, 20, 30, 40), ("z", "ry"))
    for n in (1, 2, 3, 4, 6):
        reduction = craig_bampton(K, M, boundary, n)
        rows.append([f"Craig–Bampton, five parts, {n} modes each", len(reduction.K), error(reduction.eigen(5)[0])])
    block = reduced_blocks(problem)[0]
    for size in range(8, block.size + 1, 2):
        lam = block.truncate(size).eigenvalues(theta[None], 5)[0]
        rows.append(["parametric reduced basis", size, error(lam)])
    benchmark.pedantic(lambda: guyan(K, M, boundary), rounds=3)
    benchmark.extra_info["tables"] = [
        {"section": "reductions", "head": ["reduction", "size", "largest relative error"], "rows": rows}
    ]
