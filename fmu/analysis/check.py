"""A problem looked at before a sampler is started: its model, its modes, its gradient, what its data can tell."""

from __future__ import annotations

import html
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from fmu.analysis.data.identifiability import Identifiability, identifiability
from fmu.analysis.data.prediction import measurement_in_words
from fmu.analysis.data.prior_prediction import DRAWS, PriorPrediction, prior_prediction
from fmu.analysis.data.repeatability import repeatability
from fmu.analysis.data.uninformed import doubts as doubts_of_information
from fmu.analysis.gradient_check import GradientCheck, check_gradient
from fmu.analysis.modes.initial_modes import InitialModes, initial_modes
from fmu.analysis.modes.mode_text import modes_as_text
from fmu.analysis.trace.description import model_in_words, parameter_table, structure_drawing
from fmu.analysis.trace.modal_states import START, modal_states
from fmu.numbers import fixed, given, with_sd
from fmu.text_table import text_table, wrapped

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

    from fmu.posterior.problem import UpdatingProblem


@dataclass(frozen=True, eq=False)
class Check:
    """What `check` found.

    Attributes
    ----------
    name : str
        Of the problem.
    model : tuple of str
        What the model is, a sentence each.
    parameters : pandas.DataFrame
        One row a parameter, SI units: ``unit``, ``start``, ``lower``, ``upper``, ``prior``, ``changes``.
    modes : InitialModes
        Computed modes at the start beside the measured ones.
    gradient : GradientCheck
    identifiability : Identifiability or None
        None where errors are not those of modes, or the gradient is not finite.
    prior : PriorPrediction
        Prior prediction for the measurement.
    rounding : str
        What is doubtful of the digits that the matrices have; empty if nothing is.
    drawing : str
        The structure as SVG; empty where there is none to draw.
    colours : tuple of (str or None)
        Of the elements that each parameter changes, in the drawing.
    measurement : str
        What a measured frequency is: ``"a measurement"``, or ``"the mean of 5 tests"``.
    tests : tuple of str
        What is doubtful in the order of repeated tests, a sentence each.
    shapes : xarray.Dataset or None
        The shapes at the start (`fmu.analysis.trace.modal_states.modal_states`), where there is a structure to
        draw.
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

    @property
    def doubts(self) -> tuple[str, ...]:
        """What to look into before sampling, a sentence each; empty if there is nothing."""
        found = [*self.modes.doubts, *self.tests, *filter(None, [self.rounding])]
        if self.identifiability is not None:
            found += doubts_of_information(self.identifiability)
        if not self.gradient.agrees:
            found.append(self.gradient.sentence())
        if self.prior.failed or self.prior.is_far.any():
            found += self.prior.sentences()
        return tuple(found)

    def sentences(self) -> list[str]:
        """Say in words: the model, the pairing, the gradient, what the data tell, what the prior expects."""
        said = [*self.model, *self.modes.notes, *self.modes.doubts, *self.tests, *filter(None, [self.rounding])]
        said.append(self.gradient.sentence())
        if self.identifiability is not None:
            said += self.identifiability.sentences() + doubts_of_information(self.identifiability)
        return said + self.prior.sentences()

    def mode_table(self) -> pd.DataFrame:
        """Return the computed modes as text, ready to print; many in a row that move no sensor are one row."""
        return modes_as_text(self.modes)

    def prior_table(self) -> pd.DataFrame:
        """Return prior predictions beside the measurement as text, ready to print."""
        table = self.prior.table()
        shown = table[["measured"]].map(given)
        shown["prior prediction"] = [with_sd(m, s) for m, s in zip(table["mean"], table["sd"], strict=True)]
        shown["distance, sd"] = [fixed(distance, 2) for distance in table["distance"]]
        return shown

    def parameter_table(self) -> pd.DataFrame:
        """Return the parameters as text, ready to print."""
        numbers = self.parameters.select_dtypes("number").columns
        return self.parameters.assign(**{name: self.parameters[name].map(given) for name in numbers})

    def __str__(self) -> str:
        parts = [
            _lines(self.model),
            f"Parameters\n{_as_text(self.parameter_table().reset_index(names=''))}",
            f"Modes at the start\n{_as_text(self.mode_table())}",
            *map(wrapped, self.modes.notes),
            f"Gradient\n{wrapped(self.gradient.sentence())}",
        ]
        if self.identifiability is not None:
            parts.append(f"Identifiability\n{_lines(self.identifiability.sentences())}")
        predicted = _as_text(self.prior_table().reset_index(names=""))
        parts.append(f"Prior prediction for {self.measurement}, Hz\n{predicted}")
        parts.append(_lines(self.prior.sentences()))
        return "\n\n".join([*parts, self.verdict()])

    def verdict(self) -> str:
        """Return what is doubtful as a list, or that nothing is."""
        if not self.doubts:
            return "No warnings."
        return "Warnings\n" + "\n".join(wrapped(doubt, "  - ", "    ") for doubt in self.doubts)

    def _repr_html_(self) -> str:
        def words(title: str, *sentences: str) -> str:
            return f"<h4>{title}</h4>" + "".join(f"<p>{html.escape(sentence)}</p>" for sentence in sentences)

        parts = [
            words(html.escape(self.name), *self.model),
            self.drawing,
            self.parameter_table().to_html(),
            words("Modes at the start", *self.modes.notes),
            self.mode_table().to_html(index=False),
            words("Gradient", self.gradient.sentence()),
        ]
        if self.identifiability is not None:
            parts.append(words("Identifiability", *self.identifiability.sentences()))
        parts += [
            words(f"Prior prediction for {self.measurement}, Hz", *self.prior.sentences()),
            self.prior_table().to_html(),
        ]
        doubts = "".join(f"<li>{html.escape(doubt)}</li>" for doubt in self.doubts)
        parts.append(words("Warnings") + f"<ul>{doubts}</ul>" if doubts else words("No warnings."))
        return f'<div class="fmu-check">{"".join(parts)}</div>'


_WORDS = ("", "unit", "prior", "changes", "measured mode", "moves")
"""Columns that hold words."""


def _lines(sentences: Iterable[str]) -> str:
    return "\n".join(map(wrapped, sentences))


def _as_text(table: pd.DataFrame) -> str:
    header = [str(name) for name in table.columns]
    words = [i for i, name in enumerate(header) if name in _WORDS]
    return text_table(header, [list(map(str, row)) for row in table.to_numpy()], words)


def check(problem: UpdatingProblem, draws: int = DRAWS, seed: int = 1) -> Check:
    """Look at a problem before a sampler is started.

    Parameters
    ----------
    problem : UpdatingProblem
    draws : int
        Draws from the prior at which the model is solved, at least 2; fewer where a solve is slow.
    seed : int
        Chooses them, and the points at which the gradient is checked.

    Returns
    -------
    Check
        Prints itself as text, and shows itself in a notebook.

    Raises
    ------
    ValueError
        If `problem` is no updating problem, `draws` is less than 2, or the model has no frequencies at the start.
    """
    import numpy as np

    if not (hasattr(problem, "parameters") and hasattr(problem, "likelihood")):
        raise ValueError(f"problem: must be an UpdatingProblem (got {type(problem).__name__})")
    if not np.all(np.isfinite(problem.frequencies(problem.start))):
        raise ValueError(f"start: the model must have frequencies there (got {problem.start.tolist()})")
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
        tests=() if tests is None else tuple(repeatability(tests.frequencies_hz, labels).doubts()),
        shapes=modal_states(problem, {START: problem.start}) if drawing else None,
    )


def _digits(problem: UpdatingProblem) -> str:
    from fmu.posterior.rounding import WARN, rounding

    found = rounding(problem)
    return "" if found is None or found.of_sd.max() <= WARN else found.sentence()
