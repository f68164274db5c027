"""The findings of one experiment: tables alone, small enough to hand from process to process."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from fmu.paper.experiment import Result, directory_of
from fmu.paper.pages.tables import agreement, comparison_table, frequency_table, parameter_table
from fmu.paper.published.tables import EXPERIMENTS
from fmu.paper.vector_beta import VectorBeta

if TYPE_CHECKING:
    import pandas as pd

    from fmu.paper.published.tables import Experiment as Published


_CERTIFICATE = "certificate_"
DEEP = 1e3
"""A maximum further below the highest than this, in log-probability, may trap a chain but deceives nobody."""


@dataclass(frozen=True)
class Findings:
    """What the runs of one experiment gave.

    Attributes
    ----------
    case, pairing : str
    parameters, frequencies, comparison : DataFrame
        See `fmu.paper.pages.tables`.
    maxima : DataFrame
        Local maxima of the posterior, the highest first (`fmu.analysis.maxima.results.Maxima.table`), and beside
        them the physical ``modes`` paired there.
    reasons, warnings : mapping of str to tuple of str
        By sampler, why the long run has not converged, and what speaks against the model.
    places : mapping of str to mapping of str to float
        Share of each long run's draws at which each combination of physical modes is paired.
    agreement : tuple
        See `fmu.paper.pages.tables.agreement`.
    origin : str
        Of the reference.
    settings : mapping of str to str
        Of every run, as JSON, by sampler and kind (``"mh, paper"``, ``"mh, long"``).
    learnt : mapping of str to str
        What each warm-up put in place of settings that were not given, as JSON, by the same keys.
    lengths : mapping of str to tuple of int
        Chains, warm-up and draws of every run, by the same keys.
    certificates : mapping of str to mapping of str to float
        How far the reduced model was from the full one at some draws of every run (`fmu.analysis.certificate`),
        by the same keys.
    weighted : VectorBeta, optional
        What a β for every mode gave, where that was tried.
    """

    case: str
    pairing: str
    parameters: pd.DataFrame
    frequencies: pd.DataFrame
    comparison: pd.DataFrame
    maxima: pd.DataFrame
    reasons: Mapping[str, tuple[str, ...]]
    warnings: Mapping[str, tuple[str, ...]]
    places: Mapping[str, Mapping[str, float]]
    agreement: tuple[float, float, tuple[str, ...]]
    origin: str
    settings: Mapping[str, str]
    learnt: Mapping[str, str]
    lengths: Mapping[str, tuple[int, int, int]]
    certificates: Mapping[str, Mapping[str, float]]
    weighted: VectorBeta | None = None

    @classmethod
    def of(cls, result: Result, weighted: VectorBeta | None = None) -> Findings:
        """Return the findings of the runs of an experiment."""
        traces = {f"{name}, paper": trace for name, trace in result.paper.items()}
        traces |= {f"{name}, long": trace for name, trace in result.long.items()}
        maxima = result.maxima.table()
        maxima["modes"] = result.maxima_modes
        return cls(
            case=result.published.case,
            pairing=result.pairing,
            parameters=parameter_table(result),
            frequencies=frequency_table(result),
            comparison=comparison_table(result),
            maxima=maxima,
            reasons={name: diagnosis.reasons for name, diagnosis in result.diagnoses.items()},
            warnings={name: diagnosis.warnings for name, diagnosis in result.diagnoses.items()},
            places=result.places,
            agreement=agreement(result),
            origin=result.reference.origin,
            settings={key: str(trace.attrs["settings"]) for key, trace in traces.items()},
            learnt={key: str(trace.attrs.get("learnt", "{}")) for key, trace in traces.items()},
            lengths={
                key: (int(trace.attrs["chains"]), int(trace.attrs["warmup"]), int(trace.attrs["draws"]))
                for key, trace in traces.items()
            },
            certificates={
                key: {
                    str(name).removeprefix(_CERTIFICATE): float(value)
                    for name, value in trace.attrs.items()
                    if str(name).startswith(_CERTIFICATE)
                }
                for key, trace in traces.items()
            },
            weighted=weighted,
        )

    @property
    def published(self) -> Published:
        """The paper's tables."""
        return EXPERIMENTS[self.case]

    @property
    def name(self) -> str:
        """Name of the experiment's directory."""
        return directory_of(self.case, self.pairing)

    @property
    def ndim(self) -> int:
        """Number of parameters."""
        return len(self.parameters)

    def is_converged(self, sampler: str) -> bool:
        """Return whether the verdict on the long run of a sampler was good."""
        from fmu.analysis.convergence.comparison import CONVERGED

        return bool(self.comparison.loc[sampler, "verdict"] == CONVERGED)

    def value(self, sampler: str, column: str) -> float:
        """Return a number of the comparison; NaN where there is none."""
        cell: Any = self.comparison.loc[sampler, column]
        return float("nan") if str(cell) == "<NA>" else float(cell)

    def in_paper_units(self, parameter: str, *columns: str) -> list[float]:
        """Return entries of the parameter table in the power of ten that the paper prints."""
        factor, _ = self.unit_of_paper(parameter)
        row: Any = self.parameters.loc[parameter]
        return [float(row[column]) / factor for column in columns]

    @property
    def central_difference_rate(self) -> float:
        """HMC's effective draws per solve if every gradient cost 2·ndim solves, as eq. (15) does."""
        return self.value("hmc", "ess_bulk_min") / (2 * self.ndim * self.value("hmc", "n_gradients"))

    @property
    def never_visited(self) -> list[str]:
        """Samplers whose long run never came near a maximum that matters."""
        return [s for s, reasons in self.reasons.items() if any("never visited" in reason for reason in reasons)]

    @property
    def separate_maxima(self) -> pd.DataFrame:
        """The maxima that a run might take for the whole posterior: those not far below the highest."""
        return self.maxima[self.maxima["log_prob"] > self.maxima["log_prob"].iloc[0] - DEEP]

    def unit_of_paper(self, parameter: str) -> tuple[float, str]:
        """Return the power of ten in which the paper prints a parameter, and its name, ``"1e-9 m⁴"``."""
        position = self.published.parameter_names.index(parameter)
        exponent = self.published.columns["initial"].parameters[position].exponent
        unit: Any = self.parameters.loc[parameter, "unit"]
        return float(f"1e{exponent}"), f"1e{exponent} {unit}"
