"""Damage from the frequency response functions of a test before and a test after it, for simulated pairs of tests.

``python -m tests.validation.frf_damage`` prints this section of ``frfs.md`` alone.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

import fmu
from fmu.analysis.trace.reading import parameter_draws
from fmu.posterior.problem import UpdatingProblem
from fmu.tables import markdown_table
from fmu.types import FloatArray
from tests import measured_frfs as storeys
from tests.validation.kept import Units, each, fields_of

PAIRS = 40
_LOSS = 0.08
_NOISE = 0.05
_BEYOND = 0.05


@dataclass
class Pair:
    """A simulated pair of tests of a building of three storeys; one storey loses 8 % of its stiffness in between.

    Attributes
    ----------
    storey : int
        The damaged storey.
    mean, sd : list of float
        Posterior mean and standard deviation of the loss of each storey.
    inside : list of bool
        Whether the 90 % interval of each loss contains the true loss.
    beyond : list of float
        P(loss > 5 %) of each storey.
    converged, contradicted : bool
    """

    storey: int
    mean: list[float]
    sd: list[float]
    inside: list[bool]
    beyond: list[float]
    converged: bool
    contradicted: bool


def _problem(
    theta: FloatArray, losses: FloatArray, ratios: FloatArray, rng: np.random.Generator
) -> UpdatingProblem:
    """Return the joint problem of simulated tests before and after the losses; the tests have different lines."""
    damping, error, tests = fmu.ModalDamping(storeys.ratios()), [], []
    spectra = {"before": storeys.LINES, "after": np.linspace(1.5, 15.5, 100)}
    for (name, lines), own in zip(spectra.items(), (theta, theta * (1.0 - losses)), strict=True):
        H = storeys.receptances(own, ratios, lines) * (2j * np.pi * lines) ** 2
        sd = _NOISE * np.abs(H)
        noise = rng.standard_normal(H.shape) + 1j * rng.standard_normal(H.shape)
        data = fmu.FRFData(lines, H + sd * noise, ((2, "x"),) * 2, storeys.POINTS, "accelerance", sd)
        error.append(fmu.FRFErrors(data, damping, test=name))
        f = storeys.frequencies(own) * (1.0 + 0.005 * rng.standard_normal(3))
        modes = fmu.ModalData(f, sd_hz=0.01 * f, numbers=(1, 2, 3), sensors=storeys.POINTS)
        tests.append(fmu.Test(name, modes, group=name))
    parameters = [fmu.Parameter(name, 1.0, 0.6, 1.6, fmu.Normal(mean=1.0, sd=0.15)) for name in storeys.NAMES]
    varies = {name: fmu.Damage() for name in storeys.NAMES}
    return fmu.JointProblem(storeys.building(), tests, parameters, varies=varies, error=error)


def pair_of(seed: int) -> Pair:
    """Draw moduli and damping ratios from their priors, simulate both tests, and return the posterior losses."""
    rng = np.random.default_rng([3, seed])
    theta = np.clip(1.0 + 0.15 * rng.standard_normal(3), 0.65, 1.55)
    ratios = np.array([p.prior.draw(rng, 1, p.lower, p.upper)[0] for p in storeys.ratios()])
    storey = seed % 3
    losses = np.where(np.arange(3) == storey, _LOSS, 0.0)
    problem = _problem(theta, losses, ratios, rng)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        trace = fmu.sample(problem, "mixture", draws=500, warmup=200, seed=seed + 1)
    draws = parameter_draws(trace).reshape(-1, problem.ndim)
    found = draws[:, [problem.names.index(f"{name} loss [after]") for name in storeys.NAMES]]
    low, high = np.quantile(found, [0.05, 0.95], axis=0)
    diagnosis = fmu.diagnose(trace)
    return Pair(
        storey,
        found.mean(axis=0).tolist(),
        found.std(axis=0).tolist(),
        ((losses >= low) & (losses <= high)).tolist(),
        np.mean(found > _BEYOND, axis=0).tolist(),
        bool(diagnosis.converged),
        "contradicted by" in str(diagnosis),
    )


def damage_page(pairs: Sequence[Pair]) -> str:
    """Return the section on damage."""
    n = len(pairs)
    inside, beyond = np.array([one.inside for one in pairs]), np.array([one.beyond for one in pairs])
    lost = np.array([np.arange(3) == one.storey for one in pairs])
    sd = np.median(np.array([one.sd for one in pairs]))
    rows = []
    for kind, where in (("damaged (loss of 8 %)", lost), ("undamaged", ~lost)):
        held, of = int(inside[where].sum()), int(where.sum())
        low, high = stats.binom.ppf([0.025, 0.975], of, 0.9)
        found = int((beyond[where] > 0.5).sum())
        rows.append((kind, str(of), str(held), f"{low:.0f} to {high:.0f}", str(found)))
    converged, against = sum(one.converged for one in pairs), sum(one.contradicted for one in pairs)
    header = (
        "storeys", "number", "90 % intervals with the true loss", "expected (95 %)", "P(loss > 5 %) above 50 %",
    )  # fmt: skip
    return f"""## Damage from the FRFs of two tests

{n} pairs of tests of a building of three storeys are simulated. Moduli and damping ratios are drawn from their
priors, and one storey loses 8 % of its stiffness between the tests. Each test has two accelerances with 5 %
noise; the first has 120 lines, the second 100. Every storey may have a loss (`fmu.Damage`), and the damping
ratios are the same in both tests. {converged} of {n} runs converged, and {against} models were contradicted. The
median posterior standard deviation of a loss is {100 * sd:.2f} %. The column *expected* gives the number of
intervals that contain the true loss if all intervals are correct and independent.
`python -m tests.validation.frf_damage` prints this section alone.

{markdown_table(header, rows)}"""


def damaged_pairs(units: Units) -> list[Pair]:
    """Return the pairs that are done."""
    return units.completed("damage", each(range(PAIRS)), pair_of, fields_of(Pair, list))


if __name__ == "__main__":
    print(damage_page(damaged_pairs(Units())))
