"""Real and expected accuracy of updating with simulated tests, and the reasons for differences."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, NamedTuple, Self

import numpy as np
import scipy.stats

from fmu.analysis.convergence.diagnosis import diagnose
from fmu.analysis.plan.result import PLANNED
from fmu.analysis.trace.reading import array_of, parameter_draws
from fmu.numbers import fixed, share
from fmu.posterior.problem import UpdatingProblem
from fmu.tables import data_frame, text_table, wrap_text
from fmu.types import BoolArray, FloatArray

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

AGREES = (0.7, 1.4)
"""Range of the ratio of real to expected standard deviation that counts as agreement."""
TRUTH, NOISE = "true values", "noise"
BOUNDS, CROSSING, BENT, SHORT = "bounds", "modes cross", "bent posterior", "not converged"
REASONS = {
    TRUTH: "the accuracy depends on the true values, and the expected one is a mean over the draws",
    NOISE: "the errors of the test moved the estimate to where the modes are more, or less, sensitive",
    BOUNDS: "the posterior reaches the bounds",
    CROSSING: "modes cross within the posterior",
    BENT: "the posterior is not Gaussian",
    SHORT: "the chains did not converge",
}
_NEAR = 0.02  # share of the range between two bounds that counts as close to a bound
_OFTEN = 0.05  # share of draws near a bound, or with modes in another order, that counts


class Update(NamedTuple):
    """Accuracy of updating with one simulated test.

    Attributes
    ----------
    real : ndarray, shape (p,)
        Posterior standard deviations, SI units.
    at_truth, at_mean : ndarray, shape (p,)
        Standard deviations of the posterior linearised at the true parameters, and at its own mean.
    at_bounds : ndarray, shape (p,)
        Fraction of the draws that are close to a bound; 0 for a parameter without two finite bounds.
    skewness : ndarray, shape (p,)
    crossed : float
        Fraction of the draws at which the measured modes are in a different order than at the true parameters.
    converged : bool
    """

    real: FloatArray
    at_truth: FloatArray
    at_mean: FloatArray
    at_bounds: FloatArray
    skewness: FloatArray
    crossed: float
    converged: bool


def summarise_update(problem: UpdatingProblem, trace: xr.DataTree, truth: FloatArray, scale: FloatArray) -> Update:
    """Return the accuracy of updating with one simulated test.

    Parameters
    ----------
    problem : UpdatingProblem
    trace : DataTree
        Draws from its posterior.
    truth : ndarray, shape (p,)
        True parameters of the simulated test.
    scale : ndarray, shape (p, p)
        Factor L of the parameter covariance LLᵀ before the test.
    """
    draws = parameter_draws(trace).reshape(-1, problem.ndim)
    information = problem.quadratic(np.stack([truth, draws.mean(axis=0)]))[2] + np.linalg.inv(scale @ scale.T)
    with np.errstate(invalid="ignore"):
        at_truth, at_mean = np.sqrt(np.diagonal(np.linalg.inv(information), axis1=1, axis2=2))
        place = (draws - problem.lower) / (problem.upper - problem.lower)
    near = np.isfinite(problem.upper - problem.lower) & ((place < _NEAR) | (place > 1.0 - _NEAR))
    computed = array_of(trace, "posterior_predictive", "model_frequency")
    computed = computed.reshape(-1, computed.shape[-1])[:, np.argsort(problem.frequencies(truth))]
    return Update(
        real=np.std(draws, axis=0),
        at_truth=at_truth,
        at_mean=at_mean,
        at_bounds=np.mean(near, axis=0),
        skewness=np.asarray(scipy.stats.skew(draws, axis=0)),
        crossed=float(np.mean(np.any(np.diff(computed, axis=1) < 0.0, axis=1))),
        converged=diagnose(trace).converged,
    )


@dataclass(frozen=True, eq=False)
class Updates:
    """Updates with all simulated tests for one choice of sensors.

    Each attribute stacks the values that the attribute of `Update` with the same name has in the tests.

    Attributes
    ----------
    real, at_truth, at_mean, at_bounds, skewness : ndarray, shape (n_tests, p)
    crossed : ndarray, shape (n_tests,)
    converged : ndarray of bool, shape (n_tests,)
    """

    real: FloatArray
    at_truth: FloatArray
    at_mean: FloatArray
    at_bounds: FloatArray
    skewness: FloatArray
    crossed: FloatArray
    converged: BoolArray

    @classmethod
    def of(cls, updates: Sequence[Update]) -> Self:
        """Stack the updates of all tests."""
        return cls(**{one.name: np.array([getattr(u, one.name) for u in updates]) for one in fields(cls)})

    def explain(self, test: int, k: int, expected: float) -> dict[str, object]:
        """Return the row of `SimulatedTests.cases` for one test and parameter, without the columns that name them.

        `test` and `k` are the indices of the test and the parameter, and `expected` is the parameter's expected
        standard deviation. The ratio to explain is real/expected = (at_truth/expected) (at_mean/at_truth)
        (real/at_mean). The factor that is furthest from 1 gives the reason. If this is the last factor, the reason
        is bounds, crossing modes, or another departure from a Gaussian. For an update that has not converged, the
        reason is ``"not converged"``.
        """
        truth, mean, real = self.at_truth[test, k], self.at_mean[test, k], self.real[test, k]
        factors = np.array([truth / expected, mean / truth, real / mean])
        near, crossed = self.at_bounds[test, k], self.crossed[test]
        form = BOUNDS if near > _OFTEN else CROSSING if crossed > _OFTEN else BENT
        reason = (TRUTH, NOISE, form)[int(np.argmax(np.abs(np.log(factors))))]
        return {
            "ratio": real / expected,
            **dict(zip((TRUTH, NOISE, "shape"), factors.tolist(), strict=True)),
            "at_bounds": near,
            "skewness": self.skewness[test, k],
            "crossed": crossed,
            "reason": reason if self.converged[test] else SHORT,
        }


@dataclass(frozen=True, eq=False)
class SimulatedTests:
    """Expected and real accuracy of updating with simulated tests.

    Attributes
    ----------
    names : tuple of str
        Parameter names.
    expected : dict of str to ndarray, shape (p,)
        Expected standard deviations for each choice of sensors, SI units.
    updates : dict of str to Updates
        Updates with the simulated tests for each choice.
    """

    names: tuple[str, ...]
    expected: Mapping[str, FloatArray]
    updates: Mapping[str, Updates]

    def ratios(self, choice: str = PLANNED) -> FloatArray:
        """Return the ratios of real to expected standard deviation for a choice of sensors, shape (n_tests, p)."""
        return self.updates[choice].real / self.expected[choice]

    def table(self) -> pd.DataFrame:
        """Return a table with the median and 90 % band of the ratios real/expected, one row per choice.

        The last column, ``real_sd_to_plan``, is the median ratio of the real standard deviation to the one
        expected from the plan.
        """
        rows = []
        for name, one in self.updates.items():
            low, middle, high = np.quantile(self.ratios(name), [0.05, 0.5, 0.95])
            real = float(np.median(one.real / self.expected[PLANNED]))
            rows.append({"median": middle, "5 %": low, "95 %": high, "real_sd_to_plan": real})
        return data_frame(rows, "choice", list(self.updates))

    def cases(self) -> pd.DataFrame:
        """Return a table of the plan's tests and parameters with a ratio outside 0.7 to 1.4, worst first.

        The ratio is the real standard deviation divided by the expected one, and is the product of the columns
        ``true values``, ``noise`` and ``shape``. Rows with a ratio of NaN come first. The columns are:

        - ``test`` (from 1), ``parameter`` and ``ratio``;
        - ``true values``: standard deviation of the posterior linearised at the true parameters, divided by the
          expected one;
        - ``noise``: standard deviation of the posterior linearised at its mean, divided by that of the posterior
          linearised at the true parameters;
        - ``shape``: real standard deviation, divided by that of the posterior linearised at its mean;
        - ``at_bounds``: fraction of draws close to a bound; 0 without two finite bounds;
        - ``skewness``: skewness of the draws;
        - ``crossed``: fraction of draws with modes in another order;
        - ``reason``: ``"not converged"`` if the chains did not converge. Otherwise the reason names the factor
          that is furthest from 1: ``"true values"``, ``"noise"`` or, if this factor is ``shape``, its probable
          cause ``"bounds"``, ``"modes cross"`` or ``"bent posterior"``.
        """
        ratios, updates = self.ratios(), self.updates[PLANNED]
        off = np.argwhere((ratios < AGREES[0]) | (ratios > AGREES[1]) | np.isnan(ratios))
        worst = np.argsort(-np.nan_to_num(np.abs(np.log(ratios[*off.T])), nan=np.inf), kind="stable")
        rows = [
            {"test": t + 1, "parameter": self.names[k], **updates.explain(t, k, self.expected[PLANNED][k])}
            for t, k in off[worst].tolist()
        ]
        columns = ("test", "parameter", "ratio", TRUTH, NOISE, "shape", "at_bounds", "skewness", "crossed")
        return data_frame(
            {key: [row[key] for row in rows] for key in (*columns, "reason")}, "case", range(1, len(rows) + 1)
        )

    def sentences(self) -> list[str]:
        """Return sentences that say whether expected and real accuracy of the plan agree and, if not, why."""
        ratios, cases = self.ratios(), self.cases()
        low, middle, high = np.quantile(ratios, [0.05, 0.5, 0.95])
        said = [
            f"In {len(ratios)} simulated tests of the plan the real standard deviation is {fixed(middle, 2)} "
            f"times the expected one, in 90 % of the cases {fixed(low, 2)} to {fixed(high, 2)} times."
        ]
        if len(cases):
            few, many = (fixed(end, 1) for end in AGREES)
            said.append(f"In {len(cases)} of {ratios.size} cases it is less than {few} or more than {many} times.")
        said += [f"In {n} of them {REASONS[str(reason)]}." for reason, n in cases["reason"].value_counts().items()]
        short = np.concatenate([~one.converged for one in self.updates.values()])
        if short.any():
            said.append(f"{share(float(np.mean(short)))} of the updates did not converge.")
        return said

    def __str__(self) -> str:
        table = self.table()
        rows = [
            [str(i), *(fixed(x, 2) for x in row)] for i, row in zip(table.index, table.to_numpy(), strict=True)
        ]
        said = [wrap_text(one) for one in self.sentences()]
        return "\n".join([*said, "", text_table(["real / expected sd", *map(str, table.columns)], rows)])
