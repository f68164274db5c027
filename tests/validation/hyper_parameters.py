"""Simulation-based calibration of the parameters of a discrepancy: τ, σ and ρ.

    python -m tests.validation.hyper_parameters OUT [--kept DIRECTORY] [--minutes M] [--replicates N] [--seed N]

A building of six equal storeys has one parameter, the stiffness. For each kind of discrepancy, the stiffness and
the parameters of the discrepancy are drawn from their priors, and six frequencies are simulated. Their errors are
scatter of the stiffness over the modes, independent or correlated, or correlated relative errors of the
frequencies. The frequencies have a closed form, and NumPy draws the errors. The posterior is integrated by the
midpoint rule, without a sampler. The posterior probability below the true value is uniform between 0 and 1 if the
posterior is correct (Talts, Betancourt, Simpson, Vehtari & Gelman 2018, arXiv:1804.06788). The page is
hyper-parameters.md. Exit code 1 if a test rejects uniformity.
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
from scipy import stats
from threadpoolctl import threadpool_limits

import fmu
from fmu.tables import markdown_table
from fmu.types import FloatArray
from tests.shear_building import shear_building
from tests.validation.kept import Units, each, study_parser

REPLICATES, SEED = 300, 20_286
STOREYS, NOISE = 6, 0.01
PRIOR_SD, STIFFNESS = 0.05, (1.0, 0.1)
"""Standard deviation of the priors of τ and σ; mean and standard deviation of the prior of the stiffness."""
KINDS = {
    "embedded": fmu.Discrepancy(prior_sd=PRIOR_SD),
    "correlated": fmu.Discrepancy(prior_sd=PRIOR_SD, correlation="inferred"),
    "modes": fmu.Discrepancy("modes", prior_sd=PRIOR_SD),
}
SYMBOLS = {
    "embedded": ("stiffness", "τ"),
    "correlated": ("stiffness", "τ", "ρ"),
    "modes": ("stiffness", "σ", "ρ"),
}
GRID = {"embedded": (80, 60), "correlated": (60, 40, 24), "modes": (60, 40, 24)}
LEVEL = 1e-3
"""Probability of a false alarm in any of the tests."""


def frequencies(k: float) -> FloatArray:
    """Return the frequencies of the building, Hz: ω_j = 2 √k sin((2j − 1)π/(4n + 2)) with floors of 1 kg."""
    j = np.arange(1, STOREYS + 1)
    return np.asarray(np.sqrt(k) * np.sin((2 * j - 1) * np.pi / (4 * STOREYS + 2)) / np.pi)


def simulate(rng: np.random.Generator, kind: str) -> tuple[FloatArray, FloatArray]:
    """Return the true values in the order of theta, and the measured frequencies, Hz."""
    k = STIFFNESS[0] + STIFFNESS[1] * rng.standard_normal()
    size = PRIOR_SD * abs(rng.standard_normal())
    f, z = frequencies(k), rng.standard_normal(STOREYS)
    noise = NOISE * frequencies(STIFFNESS[0]) * rng.standard_normal(STOREYS)
    if kind == "embedded":  # ∂f/∂k = f/(2k)
        return np.array([k, size]), f + 0.5 * f * size * z + noise
    rho = rng.uniform()
    error = size * (np.sqrt(rho) * rng.standard_normal() + np.sqrt(1.0 - rho) * z)
    if kind == "correlated":
        return np.array([k, size, rho]), f + 0.5 * f * error + noise
    return np.array([k, size, rho]), f * (1.0 + error) + noise


def probabilities_below(kind: str, truth: FloatArray, measured: FloatArray) -> FloatArray:
    """Return the posterior probability below the true value of each parameter, by the midpoint rule."""
    reference = frequencies(STIFFNESS[0])
    mean, sd = STIFFNESS
    problem = fmu.UpdatingProblem(
        shear_building(["k"] * STOREYS),
        fmu.ModalData(measured, sd_hz=NOISE * reference),
        [fmu.Parameter("k", mean, mean - 6.0 * sd, mean + 6.0 * sd, prior=fmu.Normal(sd, mean=mean))],
        pairing="index",
        discrepancy=KINDS[kind],
    )
    ends = [(mean - 4.5 * sd, mean + 4.5 * sd), (0.0, 5.0 * PRIOR_SD), (0.0, float(problem.upper[-1]))]
    sides = [
        low + (high - low) * (np.arange(n) + 0.5) / n for (low, high), n in zip(ends, GRID[kind], strict=False)
    ]
    grid = np.stack([x.ravel() for x in np.meshgrid(*sides, indexing="ij")], axis=1)
    log_p = problem.log_prob(grid).reshape(GRID[kind])
    p = np.exp(log_p - log_p.max())
    found = []
    for axis, (x, true) in enumerate(zip(sides, truth, strict=True)):
        of_cell = p.sum(axis=tuple(i for i in range(p.ndim) if i != axis))
        edges = np.concatenate([x - 0.5 * (x[1] - x[0]), [x[-1] + 0.5 * (x[1] - x[0])]])
        found.append(np.interp(true, edges, np.concatenate([[0.0], np.cumsum(of_cell)]) / of_cell.sum()))
    return np.array(found)


def main() -> int:
    """Write the page and return the exit code."""
    parser = study_parser(__doc__)
    parser.add_argument("--replicates", type=int, default=REPLICATES)
    parser.add_argument("--seed", type=int, default=SEED)
    asked = parser.parse_args()
    units, rows, rejected, n_tests = Units(asked.kept, asked.minutes), [], [], sum(map(len, SYMBOLS.values()))
    simulated = {}
    for stream, kind in enumerate(KINDS):
        rng = np.random.default_rng(np.random.SeedSequence(asked.seed, spawn_key=(stream,)))
        simulated[kind] = [simulate(rng, kind) for _ in range(asked.replicates)]
    keys = [(kind, i) for i in range(asked.replicates) for kind in KINDS]

    def of_set(key: tuple[str, int]) -> dict[str, Any]:
        kind, i = key
        return {"kind": kind, "below": probabilities_below(kind, *simulated[kind][i])}

    with threadpool_limits(1):
        found = units.completed("sets", each(keys), of_set, least=len(KINDS))
    for kind in KINDS:
        u = np.array([one["below"] for one in found if one["kind"] == kind])
        for symbol, one in zip(SYMBOLS[kind], u.T, strict=True):
            counts, p = np.histogram(one, 10, (0.0, 1.0))[0], float(stats.kstest(one, "uniform").pvalue)
            rows.append([kind, symbol, " ".join(map(str, counts)), f"{one.mean():.3f}", f"{p:.3f}"])
            if p < LEVEL / n_tests:
                rejected.append(f"{kind}, {symbol} (p = {p:.1g})")
    verdict = "**Yes: no test rejects uniformity.**"
    if rejected:
        verdict = f"**No: not uniform are {'; '.join(rejected)}.**"
    header = ["kind", "parameter", "data sets in each tenth of 0 to 1", "mean", "p (Kolmogorov–Smirnov)"]
    text = PAGE.format(
        verdict=verdict,
        n=sum(one["kind"] == kind for one in found),
        level=LEVEL,
        tests=n_tests,
        table=markdown_table(header, rows, (0, 1, 2)),
    )
    (asked.out / "hyper-parameters.md").write_text(text, encoding="utf-8")
    return 1 if rejected else 0


PAGE = """# Calibration of τ, σ and ρ

Are the posteriors of the size of a discrepancy (τ or σ) and of its correlation (ρ) calibrated? {verdict}

For {n} data sets of each kind, the stiffness of a building of six equal storeys and the parameters of the
discrepancy are drawn from their priors, and six frequencies are simulated. The posterior is integrated on a grid,
without a sampler. The posterior probability below the true value is uniform if the posterior is correct
(simulation-based calibration, Talts et al. 2018). The table counts these probabilities. All {tests} tests
together reject correct posteriors with a probability of at most {level}.

- **embedded**: independent scatter of the stiffness over the modes, with the standard deviation τ.
- **correlated**: the same scatter with the correlation ρ over the modes.
- **modes**: relative errors of the frequencies, with the standard deviation σ and the correlation ρ. They are
  simulated relative to the true frequency, but the density has them relative to the measured one. A small p of
  the stiffness may come from this difference; no run has tested it.

{table}"""

if __name__ == "__main__":
    sys.exit(main())
