"""Build the HTML card that shows an updating problem in a notebook."""

from __future__ import annotations

import html
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from fmu.fem.frame.drawing import Sketch, draw_svg, is_drawable, parameter_colours, sketch
from fmu.numbers import change, customary_unit, given, round_by_sd, significant
from fmu.posterior.density import Posterior
from fmu.posterior.joint.model_in_tests import ModelInTests
from fmu.posterior.parameters import prior_in_words

_MOST_DRAWN = 5000


def problem_card(problem: Posterior) -> str:
    """Return a problem's HTML card, with its parameters and its measured and computed modes.

    The card begins with a drawing of the structure if it can be drawn and is not too large.
    """
    parts = [f"<h4>{html.escape(problem.name)}</h4>"]
    colours: list[str | None] = [None] * problem.ndim
    drawing = structure_sketch(problem, _MOST_DRAWN)
    if drawing is not None:
        parts.append(f"<div>{draw_svg(drawing)}</div>")
        colours = colours_in_sketch(problem, drawing)
    parts += [f"<p>{html.escape(_in_words(problem))}</p>", _parameters(problem, colours), _modes(problem)]
    return f'<div class="fmu-problem">{"".join(parts)}</div>'


def structure_sketch(problem: Posterior, most: float = np.inf) -> Sketch | None:
    """Return the sketch of the structure, or None if it cannot be drawn with at most `most` lines.

    With several tests, the sketch shows the structure in the first test, and the elements that each structural
    parameter changes in any test: a parameter that is known in the first test may be unknown in others.
    """
    model, structure = problem.model, problem.model.parts[0].structure
    if structure is None or not is_drawable(structure, most):
        return None
    found = sketch(structure, problem.tests[0].data.sensors)
    if not isinstance(model, ModelInTests):
        return found
    changed, done = np.zeros((len(found.elements), model.n_structural), dtype=bool), set[int]()
    for part in model.configurations:
        if part.model.structure is not None and not done.issuperset(part.parameters):
            changed[:, part.parameters] |= sketch(part.model.structure).changed
            done.update(part.parameters)
    return replace(found, changed=changed)


def colours_in_sketch(problem: Posterior, structure: Sketch) -> list[str | None]:
    """Return, for each parameter of theta, its colour in the sketch of the structure; None if it has none."""
    colours = parameter_colours(structure)
    return [None if role.of is None else colours[role.of] for role in problem.roles]


def _in_words(problem: Posterior) -> str:
    model, structure = problem.model, problem.model.parts[0].structure
    if structure is None:
        return f"Model: {model.name}, {model.n_modes} modes."
    pairing = "shape (MAC)" if model.by_shape else "number in the spectrum"
    blocks = len(structure.blocks)
    sizes = " + ".join(map(str, model.sizes))
    reduced = f" A reduced model with {sizes} unknowns is used within the bounds." if sizes else ""
    return (
        f"Model: {structure.n_dof} degrees of freedom in {blocks} decoupled "
        f"{'block' if blocks == 1 else 'blocks'}; modes are paired by {pairing}.{reduced}"
    )


def _parameters(problem: Posterior, colours: Sequence[str | None]) -> str:
    rows = []
    for p, colour in zip(problem.parameters, colours, strict=True):
        mark = f'<span style="color:{colour}" aria-hidden="true">&#9632;</span> ' if colour else ""
        factor, unit = customary_unit(p.unit)
        prior = prior_in_words(p.prior.as_dict(), p.unit)
        values = (given(value / factor) for value in (p.start, p.lower, p.upper))
        rows.append([mark + html.escape(p.name), html.escape(unit), *values, html.escape(prior)])
    return _table(("parameter", "unit", "start", "lower", "upper", "prior, cut off at the bounds"), rows)


def _modes(problem: Posterior) -> str:
    measured = np.asarray(problem.data.frequencies_hz)
    initial = problem.frequencies(problem.start)
    error = problem.likelihood.error
    sd = problem.data.sd_hz if error is None else error.sd
    sd = np.full(len(measured), np.nan) if sd is None else np.asarray(sd)
    rows = [
        [
            html.escape(str(label)) + ("" if used else " (not used)"),
            given(m),
            significant(s),
            round_by_sd(f, s),
            change(f / m - 1),
        ]
        for label, used, m, s, f in zip(problem.data.labels, problem.data.use, measured, sd, initial, strict=True)
    ]
    return _table(("mode", "measured, Hz", "its sd, Hz", "at the start, Hz", "error"), rows)


def _table(header: Iterable[str], rows: Iterable[Sequence[str]]) -> str:
    """Return an HTML table. `header` and `rows` contain HTML, which is not escaped."""
    head = "".join(f"<th>{cell}</th>" for cell in header)
    body = "".join(f"<tr>{''.join(f'<td>{cell}</td>' for cell in row)}</tr>" for row in rows)
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
