"""A problem looked at before a sampler is started: its model, its modes, its gradient, what its data can tell."""

from __future__ import annotations

import html
from dataclasses import dataclass
from typing import TYPE_CHECKING

from fmu.analysis.description import model_in_words, parameter_table, structure_drawing
from fmu.analysis.gradient_check import GradientCheck, check_gradient
from fmu.analysis.identifiability import Identifiability, identifiability
from fmu.analysis.initial_modes import InitialModes, initial_modes
from fmu.analysis.modal_states import START, modal_states
from fmu.analysis.mode_text import modes_as_text
from fmu.analysis.prior_prediction import DRAWS, PriorPrediction, prior_prediction

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
        What the prior predicts for the measurement.
    rounding : str
        What is doubtful of the digits that the matrices have; empty if nothing is.
    drawing : str
        The structure as SVG; empty where there is none to draw.
    colours : tuple of (str or None)
        Of the elements that each parameter changes, in the drawing.
    shapes : xarray.Dataset or None
        The shapes at the start (`fmu.analysis.modal_states.modal_states`), where there is a structure to draw.
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
    shapes: xr.Dataset | None = None

    @property
    def doubts(self) -> tuple[str, ...]:
        """What to look into before sampling, a sentence each; empty if there is nothing."""
        found = [*self.modes.doubts, *filter(None, [self.rounding])]
        if not self.gradient.agrees:
            found.append(self.gradient.sentence())
        if self.prior.failed or self.prior.is_far.any():
            found += self.prior.sentences()
        return tuple(found)

    def sentences(self) -> list[str]:
        """Say in words: the model, the pairing, the gradient, what the data tell, what the prior expects."""
        said = [*self.model, *self.modes.notes, *self.modes.doubts, *filter(None, [self.rounding])]
        said.append(self.gradient.sentence())
        if self.identifiability is not None:
            said += self.identifiability.sentences()
        return said + self.prior.sentences()

    def mode_table(self) -> pd.DataFrame:
        """Return the computed modes as text, ready to print; many in a row that move no sensor are one row."""
        return modes_as_text(self.modes)

    def prior_table(self) -> pd.DataFrame:
        """Return prior predictions beside the measurement as text, ready to print."""
        table = self.prior.table()
        shown = table[["measured"]].map("{:.6g}".format)
        shown["prior predicts"] = [f"{m:.4g} ± {s:.2g}" for m, s in zip(table["mean"], table["sd"], strict=True)]
        shown["distance, sd"] = table["distance"].map("{:+.2f}".format)
        return shown

    def __str__(self) -> str:
        parts = [
            "\n".join(self.model),
            f"Parameters\n{self.parameters.rename_axis(None).to_string(float_format=lambda x: f'{x:.4g}')}",
            f"Modes at the start\n{self.mode_table().to_string(index=False)}",
            *self.modes.notes,
            f"Gradient\n{self.gradient.sentence()}",
        ]
        if self.identifiability is not None:
            parts.append("What the data can tell\n" + "\n".join(self.identifiability.sentences()))
        parts.append(f"What the prior predicts, Hz\n{self.prior_table().rename_axis(None).to_string()}")
        parts.append("\n".join(self.prior.sentences()))
        return "\n\n".join([*parts, self.verdict()])

    def verdict(self) -> str:
        """Return what is doubtful as a list, or that nothing is."""
        if not self.doubts:
            return "Nothing doubtful was found."
        return "Doubtful\n" + "\n".join(f"  - {doubt}" for doubt in self.doubts)

    def _repr_html_(self) -> str:
        def words(title: str, *sentences: str) -> str:
            return f"<h4>{title}</h4>" + "".join(f"<p>{html.escape(sentence)}</p>" for sentence in sentences)

        parts = [
            words(html.escape(self.name), *self.model),
            self.drawing,
            self.parameters.to_html(float_format=lambda x: f"{x:.4g}"),
            words("Modes at the start", *self.modes.notes),
            self.mode_table().to_html(index=False),
            words("Gradient", self.gradient.sentence()),
        ]
        if self.identifiability is not None:
            parts.append(words("What the data can tell", *self.identifiability.sentences()))
        parts += [words("What the prior predicts, Hz", *self.prior.sentences()), self.prior_table().to_html()]
        doubts = "".join(f"<li>{html.escape(doubt)}</li>" for doubt in self.doubts)
        parts.append(words("Doubtful") + f"<ul>{doubts}</ul>" if doubts else words("Nothing doubtful was found."))
        return f'<div class="fmu-check">{"".join(parts)}</div>'


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
    informed = hasattr(problem.likelihood, "sensitivity") and bool(np.all(np.isfinite(gradient.exact[0])))
    drawing, colours = structure_drawing(problem)
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
        shapes=modal_states(problem, {START: problem.start}) if drawing else None,
    )


def _digits(problem: UpdatingProblem) -> str:
    from fmu.posterior.rounding import WARN, rounding

    found = rounding(problem)
    return "" if found is None or found.of_sd.max() <= WARN else found.sentence()
