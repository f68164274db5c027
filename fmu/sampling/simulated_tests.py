"""Simulated tests of a plan that are really updated, which show what its linearised accuracy is worth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from fmu.analysis.convergence.diagnosis import diagnose
from fmu.analysis.plan.result import PLANNED, Plan
from fmu.analysis.trace.reading import parameter_draws
from fmu.arguments import ArgumentError, Count, Draws, Seed, check_arguments
from fmu.fem.pairing.modal_model import ModalModel
from fmu.fem.pairing.paired_structure import PairedStructure
from fmu.fem.pairing.partial_model import PartialModel
from fmu.fem.reduced.anchors import SingularAnchorError
from fmu.fem.reduced.reduced_structure import ReducedStructure, train
from fmu.numbers import fixed, names_in_words, share
from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.errors.base import ErrorModel
from fmu.posterior.errors.frequency import FrequencyErrors
from fmu.posterior.errors.shape import ShapeErrors
from fmu.posterior.problem import UpdatingProblem
from fmu.posterior.reduction.region import training_box
from fmu.progress.phases import phase
from fmu.sampling import sample
from fmu.tables import data_frame, text_table, wrap_text
from fmu.types import FloatArray

if TYPE_CHECKING:
    import pandas as pd

AGREES = (0.8, 1.25)
"""Ratios of the real to the expected standard deviation that count as agreement."""
_NEAR = 0.02  # share of the range between two bounds that counts as close to a bound
_OFTEN = 0.05  # share of draws there that is worth a sentence


@dataclass(frozen=True, eq=False)
class SimulatedTests:
    """Expected and real accuracy of simulated tests.

    Attributes
    ----------
    names : tuple of str
        Names of the parameters.
    expected : dict of str to ndarray, shape (p,)
        Expected standard deviations of each choice of sensors, SI units.
    real : dict of str to ndarray, shape (n_tests, p)
        Posterior standard deviations of each simulated test, SI units.
    at_bounds : dict of str to ndarray, shape (n_tests, p)
        Share of the draws of each posterior that are close to a bound.
    n_not_converged : int
        Number of updates whose chains did not converge.
    """

    names: tuple[str, ...]
    expected: Mapping[str, FloatArray]
    real: Mapping[str, FloatArray]
    at_bounds: Mapping[str, FloatArray]
    n_not_converged: int
    spread: FloatArray
    """Expected standard deviations of the plan of which 5 % and 95 % of the draws have less, shape (2, p)."""

    def _varies(self, k: int) -> bool:
        """Return True if the median real sd of a parameter is within the spread of the expected one."""
        low, high = self.spread[:, k]
        return bool(low <= np.median(self.real[PLANNED][:, k]) <= high and high > 2.0 * low)

    def ratios(self, choice: str = PLANNED) -> FloatArray:
        """Return the real divided by the expected standard deviations of a choice, shape (n_tests, p)."""
        return self.real[choice] / self.expected[choice]

    def table(self) -> pd.DataFrame:
        """Return a table of the ratios real/expected: their median and 90 % band, a row per choice."""
        rows = []
        for name in self.real:
            low, middle, high = np.quantile(self.ratios(name), [0.05, 0.5, 0.95])
            real = float(np.median(self.real[name] / self.expected[PLANNED]))
            rows.append({"median": middle, "5 %": low, "95 %": high, "real_sd_to_plan": real})
        return data_frame(rows, "choice", list(self.real))

    def sentences(self) -> list[str]:
        """Return sentences on where expected and real accuracy agree, and why they do not."""
        ratios = self.ratios()
        low, middle, high = np.quantile(ratios, [0.05, 0.5, 0.95])
        n = len(ratios)
        said = [
            f"In {n} simulated tests of the plan the real standard deviation is {fixed(middle, 2)} times the "
            f"expected one, in 90 % of the cases {fixed(low, 2)} to {fixed(high, 2)} times."
        ]
        middles = np.median(ratios, axis=0)
        off = [k for k in range(len(self.names)) if not AGREES[0] <= middles[k] <= AGREES[1]]
        bounded = [k for k in off if np.median(self.at_bounds[PLANNED][:, k]) > _OFTEN]
        varied = [k for k in off if k not in bounded and self._varies(k)]
        bent = [k for k in off if k not in (*bounded, *varied)]
        if bounded:
            said.append(
                f"Expected and real differ at {names_in_words([self.names[k] for k in bounded])}, because "
                "the posterior reaches the bounds."
            )
        if varied:
            said.append(
                f"The accuracy of {names_in_words([self.names[k] for k in varied])} depends much on the true "
                "values: the expected one is a mean over the prior."
            )
        if bent:
            said.append(
                f"Expected and real differ at {names_in_words([self.names[k] for k in bent])}, although "
                "the posterior stays off the bounds: it is not Gaussian there, or modes swap."
            )
        if self.n_not_converged:
            total = n * len(self.real)
            said.append(f"{share(self.n_not_converged / total)} of the updates did not converge.")
        return said

    def __str__(self) -> str:
        table = self.table()
        rows = [
            [str(i), *(fixed(x, 2) for x in row)] for i, row in zip(table.index, table.to_numpy(), strict=True)
        ]
        said = [wrap_text(one) for one in self.sentences()]
        return "\n".join([*said, "", text_table(["real / expected sd", *map(str, table.columns)], rows)])


@check_arguments
def simulate_plan(
    plan: Plan,
    tests: Count = 20,
    *,
    choices: Sequence[str] | None = None,
    draws: Draws = 200,
    seed: Seed = 1,
) -> SimulatedTests:
    """Simulate tests as planned, update the parameters with each, and compare real with expected accuracy.

    A test has frequencies and shapes of the model at a draw from the prior, with random errors. The update pairs
    modes as the plan does and uses the same reduced model, so that it takes seconds.

    Parameters
    ----------
    plan : Plan
        Of `fmu.plan`, without a trace.
    tests : int
        Number of simulated tests of each choice of sensors. The same parameters and random numbers are used for
        all choices.
    choices : sequence of str, optional
        Rows of ``plan.choices`` to compare with the plan; effective independence and the smallest AutoMAC by
        default.
    draws : int
        Draws of each of four chains.
    seed : int

    Returns
    -------
    SimulatedTests

    Raises
    ------
    ValueError
        If a choice is unknown.
    """
    known = {PLANNED: plan.chosen, **plan.usual}
    names = list(known)[:3] if choices is None else list(dict.fromkeys((PLANNED, *choices)))
    unknown = next((name for name in names if name not in known), None)
    if unknown is not None:
        raise ArgumentError("choices", f"must be of {', '.join(known)}", repr(unknown))
    expected, real, near, failed = {}, {}, {}, 0
    readings = plan.design.readings(frequency_sd=plan.frequency_sd)
    with phase("simulated tests", len(names) * tests) as under_way:
        for name in names:
            every = [*plan.limits.mounted, *known[name]]
            expected[name] = plan.design.sd_of(readings.with_sensors(every))
            model = model_of(plan, every)
            sds, shares = [], []
            for k in range(tests):
                rng = np.random.default_rng([seed, k])
                problem = simulated_problem(plan, model, every, rng)
                trace = sample(problem, draws=draws, warmup=draws, seed=seed, progress=False)
                found = parameter_draws(trace).reshape(-1, problem.ndim)
                failed += not diagnose(trace).converged
                sds.append(np.std(found, axis=0))
                shares.append(_share_at_bounds(problem, found))
                under_way.advance()
            real[name], near[name] = np.array(sds), np.array(shares)
    at_draws = plan.design.sd_at_draws(readings.with_sensors(plan.every))
    spread = np.quantile(at_draws, [0.05, 0.95], axis=0)
    return SimulatedTests(plan.design.names, expected, real, near, failed, spread)


def model_of(plan: Plan, every: Sequence[int]) -> ModalModel:
    """Return the plan's model with the measured modes at the sensors of a choice only, for an update."""
    there, whole = plan.design.candidates, plan.design.found.model
    rows = there.rows(every)
    if isinstance(whole, ReducedStructure | PairedStructure):
        whole = _reduce(plan, whole)
        whole = whole.seen_by(tuple(there.sensors[row] for row in rows))
        return PartialModel(whole, plan.design.modes, range(len(rows)))
    own = [plan.problem.data.sensors.index(there.sensors[row]) for row in rows]
    return PartialModel(whole, plan.design.modes, own)


def _reduce(plan: Plan, whole: ReducedStructure | PairedStructure) -> ReducedStructure | PairedStructure:
    """Return the plan's reduced model, used everywhere within the bounds, or one that is trained there."""
    lower, upper = training_box(plan.problem.parameters[: whole.n_parameters])
    if isinstance(whole, ReducedStructure):
        return whole.extend(lower, upper)
    try:
        return train(whole, lower, upper)[0]
    except SingularAnchorError:  # a displacement has neither stiffness nor mass at a bound
        return whole


def simulated_problem(
    plan: Plan, model: ModalModel, every: Sequence[int], rng: np.random.Generator, theta: FloatArray | None = None
) -> UpdatingProblem:
    """Return the problem of updating with one simulated test.

    Parameters
    ----------
    plan : Plan
    model : ModalModel
        Of `model_of` for the same choice.
    every : sequence of int
        The candidates of the test, mounted ones included.
    rng : Generator
    theta : ndarray, shape (p,), optional
        True parameters; a draw from the prior by default.
    """
    problem, design, sd = plan.problem, plan.design, plan.frequency_sd
    p = problem.n_structural
    theta = problem.sample_prior(rng, 1)[:, :p] if theta is None else np.asarray(theta)[None]
    seen = model.observed(theta)
    f = seen.frequencies[0] * (1.0 + sd * rng.standard_normal(len(sd)))
    # a component's error is a share of the shape's largest component at all candidates
    largest = np.median(design.largest[:, 0, list(design.modes)], axis=0)
    off = design.shape_sd * largest * rng.standard_normal((len(design.candidates.sensors), len(sd)))
    shapes = seen.shapes[0] + off[design.candidates.rows(every)]
    shapes_sd = design.shape_sd * largest / np.linalg.norm(shapes, axis=0)
    data = ModalData(
        f,
        sensors=tuple(design.candidates.sensors[row] for row in design.candidates.rows(every)),
        shapes=shapes,
        sd_hz=sd * f,
        shapes_sd=np.broadcast_to(shapes_sd, shapes.shape),
    )
    errors: list[ErrorModel] = [FrequencyErrors("absolute"), ShapeErrors()]
    return UpdatingProblem(model, data, problem.parameters[:p], error=errors, name=f"{problem.name}, simulated")


def _share_at_bounds(problem: UpdatingProblem, draws: FloatArray) -> FloatArray:
    """Return the share of draws (n, p) close to a bound, for each parameter."""
    with np.errstate(invalid="ignore"):
        place = (draws - problem.lower) / (problem.upper - problem.lower)
    return np.mean((place < _NEAR) | (place > 1.0 - _NEAR), axis=0)
