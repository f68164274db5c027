"""Plans for a decision about damage: expected probabilities of damage, and probabilities after updates."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

import fmu
from fmu.types import Dof, FloatArray
from tests.shear_building import frequencies_hz, shear_building
from tests.validation.kept import Units, each, fields_of

BEYOND, LOSSES = 0.1, {"nothing": 0.0, "20 %": 0.2}
_NAMES, _FREQUENCY_SD, _SHAPE_SD, _UNKNOWN_SHAPE = ("k1", "k2", "k3"), 0.01, 0.03, 10.0
_MODEL = shear_building(["k1"] * 2 + ["k2"] * 2 + ["k3"] * 2, 3e6, 1000.0)
_PARAMETERS = [fmu.Parameter(name, 1.0, 0.6, 1.4, fmu.Normal(0.1, mean=1.0)) for name in _NAMES]


@dataclass
class Decided:
    """One structure with its tests, and the probability that k1 has lost more than 10 %.

    Attributes
    ----------
    loss : str
        The true loss, one of `LOSSES`.
    seed : int
    before, expected, real : float
        The probability before the planned test, the expected one after it, and the one after the update.
    converged : bool
    seconds : float
        Processor time.
    """

    loss: str
    seed: int
    before: float
    expected: float
    real: float
    converged: bool
    seconds: float


def _measure(
    theta: FloatArray, modes: int, rng: np.random.Generator, sensors: tuple[Dof, ...], shape_sd: float
) -> fmu.ModalData:
    """Return a simulated test; errors of shapes are relative to the largest component of each mode."""
    f, phi = (part[..., :modes] for part in frequencies_hz(_MODEL, theta))
    rows = [_MODEL.dof(*sensor) for sensor in sensors]
    sd = shape_sd * np.abs(phi).max(axis=0)
    shapes = phi[rows] + min(shape_sd, 1.0) * np.abs(phi).max(axis=0) * rng.standard_normal((len(rows), modes))
    return fmu.ModalData(
        f * (1.0 + _FREQUENCY_SD * rng.standard_normal(modes)),
        sd_hz=_FREQUENCY_SD * f,
        sensors=sensors,
        shapes=shapes,
        shapes_sd=np.tile(sd / np.linalg.norm(shapes, axis=0), (len(rows), 1)),
    )


def decide(job: tuple[str, int]) -> Decided:
    """Plan the third test of a structure, simulate it, and update with all three tests."""
    loss, seed = job
    began, rng = time.process_time(), np.random.default_rng(seed)
    undamaged = 1.0 + 0.1 * rng.standard_normal(3)
    damaged = undamaged * (1.0 - np.array([LOSSES[loss], 0.0, 0.0]))
    everywhere = tuple(_MODEL.dofs)
    first = [
        fmu.Test("May", _measure(undamaged, 4, rng, everywhere, _UNKNOWN_SHAPE), "before"),
        fmu.Test("June", _measure(damaged, 1, rng, everywhere, _UNKNOWN_SHAPE), "after"),
    ]
    varies = {"k1": fmu.Damage(), "k2": fmu.Damage()}
    error = [fmu.FrequencyErrors("absolute")]
    known = fmu.JointProblem(_MODEL, first, _PARAMETERS, varies=varies, pairing="index", error=error)
    target = fmu.DamageTarget("k1", BEYOND)
    plan = fmu.plan(known, 3, modes=2, frequency_sd=_FREQUENCY_SD, shape_sd=_SHAPE_SD, target=target)
    told = plan.losses()
    assert told is not None
    row = told.loc["k1"]
    rows = [everywhere.index(sensor) for sensor in plan.sensors]
    tests = [replace(test, data=_at(test.data, plan.sensors, rows)) for test in first]
    tests.append(fmu.Test("July", _measure(damaged, 2, rng, plan.sensors, _SHAPE_SD), "after"))
    both = [*error, fmu.ShapeErrors()]
    joint = fmu.JointProblem(_MODEL, tests, _PARAMETERS, varies=varies, pairing="index", error=both)
    trace = fmu.sample(joint, draws=300, warmup=300, until_ess=400, max_draws=6000, progress=False)
    draws = trace["posterior"]["k1 loss [after]"].to_numpy()
    return Decided(
        loss,
        seed,
        float(row["before"]),
        float(row["if_twice" if LOSSES[loss] else "if_none"]),
        float(np.mean(draws > BEYOND)),
        fmu.diagnose(trace).converged,
        time.process_time() - began,
    )


def _at(data: fmu.ModalData, sensors: tuple[Dof, ...], rows: list[int]) -> fmu.ModalData:
    """Return data with the shapes at some of the sensors."""
    shapes, sd = np.asarray(data.shapes)[rows], np.asarray(data.shapes_sd)[rows]
    return replace(data, sensors=sensors, shapes=shapes, shapes_sd=sd)


def decided(replicates: int, units: Units) -> list[Decided]:
    """Return the decisions that are done."""
    jobs = [(loss, seed) for seed in range(replicates) for loss in LOSSES]
    return units.completed("decisions", each(jobs), decide, fields_of(Decided), least=4 * len(LOSSES))


def means(found: Sequence[Decided], loss: str) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the probabilities before the planned test, expected after it, and after the update."""
    mine = [one for one in found if one.loss == loss]
    before, expected, real = np.array([(one.before, one.expected, one.real) for one in mine]).T
    return before, expected, real


def decision_page(found: Sequence[Decided], replicates: int) -> str:
    """Return the section on decisions about damage."""
    rows = []
    for loss, true in LOSSES.items():
        before, expected, real = means(found, loss)
        error = float(np.std(real - expected, ddof=1) / np.sqrt(len(real)))
        shares = f"{100 * before.mean():.0f} % | {100 * expected.mean():.1f} % | {100 * real.mean():.1f} %"
        rows.append(f"| {100 * true:.0f} % | {shares} | {100 * error:.1f} % |")
    converged = sum(one.converged for one in found)
    return f"""## A decision about damage

Has the stiffness k1 of a building of six storeys lost more than 10 %? Four frequencies before the damage and one
after it are known to 1 %. The test for this decision is planned with three sensors and two modes, with errors of
1 % in the frequencies and of 3 % in the shapes. It is simulated {replicates} times for each true loss, with
stiffnesses from the prior (standard deviation 10 %). Each update uses all three tests; {converged} of
{len(found)} converged. The table has mean probabilities of a loss of more than 10 %, and the standard error of
the difference between the expected probability and the probability after the update.

| true loss of k1 | before the planned test | expected after it | after the update | standard error |
| :-- | --: | --: | --: | --: |
{chr(10).join(rows)}

The section took {sum(one.seconds for one in found) / 60:.1f} minutes of processor time.
"""
