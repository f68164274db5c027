"""The paper's remark on its first mode put to the test: β as a vector, a weight for every mode."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from fmu.paper.experiment import PAIRED_BY, Result, directory_of
from fmu.paper.pages.tables import posterior_mean
from fmu.paper.plan import Plan, long_settings
from fmu.paper.published.tables import EXPERIMENTS
from fmu.paper.runs import Runs
from fmu.progress import Report
from fmu.types import FloatArray

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr


SAMPLER = "hmc"
RELATIVE = 0.01
"""Standard deviation of every frequency error, over the measured frequency."""
SCALAR, VECTOR = "scalar", "vector"


def relative_weights(frequencies_hz: FloatArray) -> FloatArray:
    """Return β_i = 1/(2σ_i²) with σ_i = `RELATIVE` · f_i, in 1/Hz²."""
    return 1.0 / (2.0 * (RELATIVE * frequencies_hz) ** 2)


@dataclass(frozen=True)
class VectorBeta:
    """What a vector β gave beside the scalar one, as tables.

    Attributes
    ----------
    case, pairing : str
    modes : DataFrame
        One row a measured mode. Frequencies in Hz (``*_hz``) and errors |f − f_m|/f_m in % (``*_error``):
        ``measured``, ``initial``, ``published`` (the paper's HMC column), and of the model at the posterior mean
        with the ``scalar`` and the ``vector`` β; the standard deviation of the frequency error that each β stands
        for (``*_sigma_hz``).
    parameters : DataFrame
        One row a parameter, SI units: ``unit``, and the posterior mean and sd with either β.
    runs : DataFrame
        One row a β (`SCALAR`, `VECTOR`): ``converged``, ``rhat``, ``ess`` (bulk, the worst parameter's).
    reasons : mapping of str to tuple of str
        By β, why the run has not converged.
    """

    case: str
    pairing: str
    modes: pd.DataFrame
    parameters: pd.DataFrame
    runs: pd.DataFrame
    reasons: Mapping[str, tuple[str, ...]]

    @property
    def name(self) -> str:
        """Name of the experiment, ``"young-shape"`` for example."""
        return directory_of(self.case, self.pairing)

    @property
    def title(self) -> str:
        """The experiment in words."""
        return f"section {EXPERIMENTS[self.case].section}, paired {PAIRED_BY[self.pairing]}"

    @property
    def outcome(self) -> str:
        """``"confirmed"`` if mode 1 is better with the vector, ``"not confirmed"`` or ``"cannot be judged"``."""
        if not self.runs["converged"].all():
            return "cannot be judged"
        first = self.modes.iloc[0]
        return "confirmed" if first["vector_error"] < first["scalar_error"] else "not confirmed"


def sample_weighted(result: Result, plan: Plan, progress: Report | None = None) -> xr.DataTree:
    """Repeat the long HMC run of an experiment, settings and seed the same, with a weight for every mode."""
    from fmu import cases
    from fmu.analysis.maxima.search import find_map

    beta = relative_weights(result.published.measured_hz)
    problem = cases.load(result.published.case, result.pairing, beta=beta)
    maxima, length = find_map(problem, plan.starts, plan.seed), plan.long[SAMPLER]
    runs = Runs(problem, maxima, plan.seed, f"{result.name}, vector β", length.steps, progress)
    trace = runs.run(f"{SAMPLER}, long run", long_settings(SAMPLER), length)
    runs.finish()
    return trace


def side_by_side(result: Result, weighted: xr.DataTree) -> VectorBeta:
    """Return the tables of the long HMC run with the scalar β and of `sample_weighted`."""
    import pandas as pd

    from fmu.analysis.convergence.diagnosis import diagnose
    from fmu.analysis.convergence.diagnostics import summary

    traces = {SCALAR: result.long[SAMPLER], VECTOR: weighted}
    diagnoses = {SCALAR: result.diagnoses[SAMPLER], VECTOR: diagnose(weighted)}
    summaries = {name: summary(trace) for name, trace in traces.items()}
    parameters: dict[str, object] = {"unit": result.problem.units}
    for name, table in summaries.items():
        parameters |= {f"{name}_mean": table["mean"].to_numpy(), f"{name}_sd": table["sd"].to_numpy()}
    runs = {
        name: (diagnoses[name].converged, table["rhat"].max(), table["ess_bulk"].min())
        for name, table in summaries.items()
    }
    return VectorBeta(
        case=result.published.case,
        pairing=result.pairing,
        modes=_modes(result, traces),
        parameters=pd.DataFrame(parameters, index=pd.Index(result.problem.names, name="parameter")),
        runs=pd.DataFrame.from_dict(runs, orient="index", columns=["converged", "rhat", "ess"]),
        reasons={name: diagnosis.reasons for name, diagnosis in diagnoses.items()},
    )


def _modes(result: Result, traces: Mapping[str, xr.DataTree]) -> pd.DataFrame:
    import pandas as pd

    published, problem = result.published, result.problem
    printed, error = published.columns[SAMPLER], published.error_percent
    before = problem.frequencies(problem.start)
    columns = {"measured_hz": published.measured_hz, "initial_hz": before, "initial_error": error(before)}
    columns |= {"published_hz": printed.printed_hz, "published_error": printed.printed_errors}
    beta = {SCALAR: np.ones(len(before)), VECTOR: relative_weights(published.measured_hz)}
    for name, trace in traces.items():
        at_mean = problem.frequencies(posterior_mean(trace))
        columns[f"{name}_sigma_hz"] = 1.0 / np.sqrt(2.0 * beta[name])
        columns |= {f"{name}_hz": at_mean, f"{name}_error": error(at_mean)}
    return pd.DataFrame(columns, index=pd.Index(problem.data.labels, name="mode"))
