"""Damage from frequency response functions of a sound and a damaged test: losses of simulated pairs of tests.

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
from fmu.types import FloatArray
from tests import measured_frfs as storeys
from tests.validation.kept import Units, each, fields_of

PAIRS = 40
_LOSS = 0.08
_NOISE = 0.05
_BEYOND = 0.05


@dataclass
class Pair:
    """A simulated pair of tests of three storeys, of which one storey lost 8 % of its stiffness.

    Attributes
    ----------
    storey : int
        The storey that lost.
    mean, sd : list of float
        Posterior of the loss of each storey.
    inside : list of bool
        Whether the 90 % interval of each loss holds the true one.
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
    """Return the joint problem of simulated tests before and after the losses; the second one has other lines."""
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
    """Return what the posterior says of the losses of a pair of tests of moduli and damping from their priors."""
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
    for what, where in (("that lost 8 %", lost), ("that lost nothing", ~lost)):
        held, of = int(inside[where].sum()), int(where.sum())
        low, high = stats.binom.ppf([0.025, 0.975], of, 0.9)
        found = int((beyond[where] > 0.5).sum())
        rows.append(f"| {what} | {of} | {held} | {low:.0f} to {high:.0f} | {found} |")
    table = "\n".join(rows)
    converged, against = sum(one.converged for one in pairs), sum(one.contradicted for one in pairs)
    return f"""## Damage from the FRFs of two tests

{n} pairs of tests of three storeys: moduli and damping ratios are drawn from their priors, one storey loses 8 % of
its stiffness, and both tests have two accelerances with 5 % noise, of 120 and of 100 lines. All storeys may have
lost (`fmu.Damage`); the damping is common to both tests. Converged: {converged} of {n}; models contradicted:
{against}. The median standard deviation of a loss is {100 * sd:.2f} %. This section alone is printed by
`python -m tests.validation.frf_damage`.

| storeys | number | true loss in its 90 % interval | expected by chance (95 %) | P(loss > 5 %) above 50 % |
| :-- | --: | --: | --: | --: |
{table}
"""


def damage(units: Units) -> str:
    """Return the section on damage, of the pairs that are done."""
    return damage_page(units.completed("damage", each(range(PAIRS)), pair_of, fields_of(Pair, list)))


if __name__ == "__main__":
    print(damage(Units()))
