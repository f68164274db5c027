"""Check a problem before sampling: model, modes, gradient, identifiability and prior prediction."""

from __future__ import annotations

import html
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import numpy as np
from annotated_types import Interval

from fmu.analysis.identifiability import Identifiability, identifiability
from fmu.analysis.prediction import measurement_in_words
from fmu.analysis.repeatability import repeatability
from fmu.analysis.start.discrepancy_doubts import discrepancy_doubts
from fmu.analysis.start.doubts_of_tests import doubts_of_tests
from fmu.analysis.start.gradient_check import GradientCheck, check_gradient
from fmu.analysis.start.initial_modes import InitialModes, initial_modes, modes_as_text
from fmu.analysis.start.measured_frfs import MeasuredFRFs, measured_frfs
from fmu.analysis.start.model_words import model_in_words, parameter_table, structure_drawing
from fmu.analysis.start.prior_prediction import DRAWS, PriorPrediction, prior_prediction
from fmu.analysis.trace.densities import discrepant_likelihood, is_updating
from fmu.analysis.trace.modal_states import START, modal_states
from fmu.analysis.uninformed import doubts as doubts_of_information
from fmu.arguments import ArgumentError, Seed, check_arguments
from fmu.fem.pairing.correlation import LOOK_AT_SENSORS
from fmu.fem.reduced.reduced_structure import largest_tolerance_elsewhere
from fmu.numbers import fixed, given, names_in_words, significant, with_sd
from fmu.posterior.assumptions import ERRORS_HEADER, Assumptions, assumptions
from fmu.posterior.prior_doubts import prior_doubts
from fmu.tables import text_table, wrap_text

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

    from fmu.fem.pairing.matching import Matching
    from fmu.posterior.problem import UpdatingProblem


_MOST_SENSORS = 8


_MOST_ROWS = 40
type Block = tuple[str, Iterable[str], pd.DataFrame | None]
"""Title, sentences and table of a section."""


@dataclass(frozen=True, eq=False)
class Check:
    """The findings of `check`.

    Attributes
    ----------
    name : str
        Name of the problem.
    model : tuple of str
        Sentences that describe the model.
    parameters : pandas.DataFrame
        One row per parameter: ``unit``; ``start``, ``lower`` and ``upper`` in this unit; ``prior`` in words and,
        if known, ``changes``, the quantities that the parameter changes.
    modes : InitialModes
        Computed modes at the starting point, paired with the measured ones.
    gradient : GradientCheck
    identifiability : Identifiability or None
        None with the modal residual, or if the gradient at the starting point is not finite.
    prior : PriorPrediction
        Prior prediction of the measured frequencies.
    rounding : str
        A warning if the matrices have too few digits, otherwise empty.
    drawing : str
        The structure as SVG; empty if it has no geometry or too many elements.
    colours : tuple of (str or None)
        For each row of `parameters`, the colour of the changed elements in the drawing; None if there are none.
    measurement : str
        Description of a measured frequency: ``"a measurement"``, or ``"the mean of 5 tests"``.
    tests : tuple of str
        Warnings about repeated tests, or about several tests of the structure, one sentence each.
    shapes : xarray.Dataset or None
        Mode shapes at the starting point (`fmu.analysis.trace.modal_states.modal_states`); None without a drawing.
    assumptions : Assumptions or None
        Assumptions of the posterior (`fmu.posterior.assumptions`).
    priors : tuple of str
        Warnings about priors that hardly fit within their bounds, and about parameters that serve no purpose, one
        sentence each.
    discrepancy : tuple of str
        Warnings about discrepancies that have no effect or that the data cannot tell apart, one sentence each.
    points : Matching or None
        Test points matched to nodes of the model; None if no coordinates were given.
    frfs : MeasuredFRFs or None
        Measured FRFs, with the model's FRFs at the starting point; None if there are none.
    """

    name: str
    model: tuple[str, ...]
    parameters: pd.DataFrame
    modes: InitialModes
    gradient: GradientCheck
    identifiability: Identifiability | None
    prior: PriorPrediction
    rounding: str = ""
    drawing: str = ""
    colours: tuple[str | None, ...] = ()
    measurement: str = "a measurement"
    tests: tuple[str, ...] = ()
    shapes: xr.Dataset | None = None
    assumptions: Assumptions | None = None
    priors: tuple[str, ...] = ()
    discrepancy: tuple[str, ...] = ()
    points: Matching | None = None
    frfs: MeasuredFRFs | None = None

    @property
    def doubts(self) -> tuple[str, ...]:
        """Warnings about problems to resolve before sampling, one sentence each."""
        found = [
            *self.priors,
            *self.discrepancy,
            *self._doubts_of_data,
        ]
        if self.identifiability is not None:
            found += doubts_of_information(self.identifiability)
        if not self.gradient.agrees:
            found.append(self.gradient.sentence())
        return (*found, *self.prior.doubts)

    @property
    def _doubts_of_data(self) -> tuple[str, ...]:
        """Warnings about modes, sensors, tests and FRFs, and about rounding."""
        of_frfs = () if self.frfs is None else self.frfs.doubts
        rounding = filter(None, [self.rounding])
        return (*self.modes.doubts, *self.sensor_doubts, *self.tests, *of_frfs, *rounding)

    @property
    def sensor_doubts(self) -> tuple[str, ...]:
        """Warnings about test points far from the mesh, and sensors that disagree, look swapped or turned."""
        found, placed = self.modes.correlation, () if self.points is None else self.points.doubts
        turned = filter(None, [self.modes.turned])
        return placed if found is None else (*placed, *turned, *found.doubts_of_sensors())

    def sentences(self) -> list[str]:
        """Return the findings as sentences: model, assumptions, warnings, gradient, identifiability and prior."""
        assumed = () if self.assumptions is None else self.assumptions.sentences
        said = [*self.model, *assumed, *self.priors, *self.discrepancy, *self.modes.notes, *self._doubts_of_data]
        said.append(self.gradient.sentence())
        if self.identifiability is not None:
            said += self.identifiability.sentences() + doubts_of_information(self.identifiability)
        return said + self.prior.sentences()

    def mode_table(self) -> pd.DataFrame:
        """Return a text table of the computed modes, one row per mode.

        Three or more successive modes share a row if they are rigid-body modes, or if they move no sensor.
        """
        return modes_as_text(self.modes)

    def sensor_table(self) -> pd.DataFrame:
        """Return a text table with the CoMAC and ECoMAC of each sensor, in descending order of ECoMAC.

        It requires measured mode shapes (`modes.correlation`).
        """
        assert self.modes.correlation is not None  # there are measured shapes
        return self.modes.correlation.table().map(fixed, places=2).reset_index()

    def prior_table(self) -> pd.DataFrame:
        """Return a text table of the measured frequencies and their prior predictions, in Hz, and the distances.

        Each distance is the measured frequency minus its prior prediction, in standard deviations of the
        prediction.
        """
        table = self.prior.table()
        shown = table[["measured"]].map(given)
        shown["prior prediction"] = [with_sd(m, s) for m, s in zip(table["mean"], table["sd"], strict=True)]
        shown["distance, sd"] = [fixed(distance, 2) for distance in table["distance"]]
        return shown

    def parameter_table(self) -> pd.DataFrame:
        """Return a text table of the parameters."""
        numbers = self.parameters.select_dtypes("number").columns
        return self.parameters.assign(**{name: self.parameters[name].map(given) for name in numbers})

    def _blocks(self) -> list[Block]:
        """Return all sections of the report except the model's description: titles, sentences and text tables."""
        blocks: list[Block] = [
            ("Parameters", (), self.parameter_table().reset_index(names="")),
            *self._assumption_block(),
            *self._points(),
            ("Modes at the start", self.modes.notes, self.mode_table()),
            *self._sensors(),
            *self._responses(),
            ("Gradient", (self.gradient.sentence(),), None),
        ]
        if self.identifiability is not None:
            blocks.append(("Identifiability", self.identifiability.sentences(), None))
        title = f"Prior prediction for {self.measurement}, Hz"
        return [*blocks, (title, self.prior.sentences(), self.prior_table().reset_index(names=""))]

    def point_table(self) -> pd.DataFrame:
        """Return a text table with one row per test point, in descending order of distance.

        The columns are the point, its node, its distance from the node, and the node spacing there. The table
        requires test points (`points`).
        """
        assert self.points is not None  # there are coordinates
        table = self.points.table().sort_values("distance", ascending=False, kind="stable").reset_index()
        lengths = {f"{key}, m": table[key].map(significant) for key in ("distance", "spacing")}
        return table[["point", "node"]].assign(**lengths)

    def _points(self) -> list[Block]:
        if self.points is None:
            return []
        return [
            (
                "Points of the test, the farthest from its node first",
                self.points.notes,
                self.point_table()[:_MOST_SENSORS],
            )
        ]

    def _sensors(self) -> list[Block]:
        if self.modes.correlation is None:
            return []
        worst = self.sensor_table()[:_MOST_SENSORS]
        every = len(worst) == len(self.modes.correlation.sensors)
        title = "Sensors" if every else f"The {len(worst)} sensors with the largest ECoMAC"
        return [(title, (LOOK_AT_SENSORS,), worst)]

    def _responses(self) -> list[Block]:
        if self.frfs is None:
            return []
        return [("Frequency response functions", self.frfs.notes, self.frfs.table().reset_index())]

    def _assumption_block(self) -> list[Block]:
        import pandas as pd

        if self.assumptions is None:
            return []
        rows = self.assumptions.errors
        table = pd.DataFrame(rows, columns=list(ERRORS_HEADER), dtype=object) if rows else None
        return [("Assumptions", self.assumptions.sentences, table)]

    def __str__(self) -> str:
        parts = [_lines(self.model)]
        for title, sentences, table in map(_shorten, self._blocks()):
            if table is None:
                parts.append(f"{title}\n{_lines(sentences)}")
            else:
                parts += [f"{title}\n{_as_text(table)}", *filter(None, [_lines(sentences)])]
        return "\n\n".join([*parts, self.verdict()])

    def verdict(self) -> str:
        """Return all warnings as text, or ``"No warnings."``."""
        if not self.doubts:
            return "No warnings."
        return "Warnings\n" + "\n".join(wrap_text(doubt, "  - ", "    ") for doubt in self.doubts)

    def _repr_html_(self) -> str:
        def words(title: str, sentences: Iterable[str]) -> str:
            return f"<h4>{html.escape(title)}</h4>" + "".join(f"<p>{html.escape(said)}</p>" for said in sentences)

        parts = [words(self.name, self.model), self.drawing]
        for title, sentences, table in map(_shorten, self._blocks()):
            parts.append(words(title, sentences) + ("" if table is None else table.to_html(index=False)))
        doubts = "".join(f"<li>{html.escape(doubt)}</li>" for doubt in self.doubts)
        parts.append(words("Warnings", ()) + f"<ul>{doubts}</ul>" if doubts else words("No warnings.", ()))
        return f'<div class="fmu-check">{"".join(parts)}</div>'


_WORDS = ("", "FRF", "point", "sensor", "unit", "prior", "changes", "measured mode", "moves", "mode")
"""Headings of text columns, which are aligned left."""


def _shorten(block: Block) -> Block:
    """Cut a section's table to its first `_MOST_ROWS` rows, and say so in the title."""
    title, sentences, table = block
    if table is None or len(table) <= _MOST_ROWS:
        return block
    return f"{title}: the first {_MOST_ROWS} of {len(table)} rows", sentences, table[:_MOST_ROWS]


def _lines(sentences: Iterable[str]) -> str:
    return "\n".join(map(wrap_text, sentences))


def _as_text(table: pd.DataFrame) -> str:
    header = [str(name) for name in table.columns]
    words = [i for i, name in enumerate(header) if name in _WORDS]
    return text_table(header, [list(map(str, row)) for row in table.to_numpy()], words)


@check_arguments
def check(
    problem: UpdatingProblem, draws: Annotated[int, Interval(ge=2, le=1_000_000)] = DRAWS, seed: Seed = 1
) -> Check:
    """Check a problem before sampling.

    Parameters
    ----------
    problem : UpdatingProblem
    draws : int
        Number of draws from the prior at which the model is solved, from 2 to 1 000 000.
    seed : int
        Seed of these draws, and of the points at which the gradient is checked.

    Returns
    -------
    Check
        The findings, which can be printed and are shown as HTML in a notebook.

    Raises
    ------
    ValueError
        If `problem` is not an updating problem, `draws` or `seed` is out of range, or the model fails at the
        starting point.
    """
    if not is_updating(problem):
        raise ArgumentError("problem", "must be an UpdatingProblem", type(problem).__name__)
    if not np.all(np.isfinite(problem.frequencies(problem.start))):
        raise ArgumentError("start", "the model must have frequencies there", problem.start.tolist())
    gradient = check_gradient(problem, seed)
    informed = problem.likelihood.of_modes and bool(np.all(np.isfinite(gradient.exact[0])))
    drawing, colours = structure_drawing(problem)
    tests = problem.data.tests
    labels = tuple(map(str, problem.data.labels))
    return Check(
        name=problem.name,
        model=tuple(model_in_words(problem)),
        parameters=parameter_table(problem),
        modes=initial_modes(problem),
        gradient=gradient,
        identifiability=identifiability(problem) if informed else None,
        prior=prior_prediction(problem, draws, seed),
        rounding=_digits(problem),
        drawing=drawing,
        colours=tuple(colours),
        measurement=measurement_in_words(None if tests is None else np.asarray(tests.frequencies_hz)),
        tests=tuple(
            doubts_of_tests(problem.tests)
            if tests is None
            else repeatability(tests.frequencies_hz, labels).doubts()
        ),
        shapes=modal_states(problem, {START: problem.start}) if drawing else None,
        assumptions=assumptions(
            problem.configuration(),
            _tolerance(problem),
            elsewhere=largest_tolerance_elsewhere(problem.model),
            log_prob=None if problem.tolerance is None else problem.tolerance.log_prob,
        ),
        priors=(*prior_doubts(problem.parameters), *_without_purpose(problem)),
        discrepancy=tuple(discrepancy_doubts(problem)) if informed else (),
        points=problem.data.points,
        frfs=measured_frfs(problem),
    )


def _without_purpose(problem: UpdatingProblem) -> list[str]:
    """Return a list with a sentence on parameters that are not updated and do not scatter, if there are any."""
    likelihood = discrepant_likelihood(problem)
    scattered = [] if likelihood is None else likelihood.errors.scattered.tolist()
    idle = [p.name for j, p in enumerate(problem.layout.structural) if not p.updated and j not in scattered]
    if not idle:
        return []
    are, them = ("are", "them") if len(idle) > 1 else ("is", "it")
    without = f"not updated, and no discrepancy lets {them} scatter: leave {them} out of the parameters"
    return [f"{names_in_words(idle)} {are} {without}."]


def _tolerance(problem: UpdatingProblem) -> float | None:
    """Return the reduced model's largest allowed relative frequency error, or None without a reduced model."""
    return None if problem.tolerance is None else problem.tolerance.frequency


def _digits(problem: UpdatingProblem) -> str:
    from fmu.posterior.rounding import WARN, rounding

    found = rounding(problem)
    return "" if found is None or found.of_sd.max() <= WARN else found.sentence()
