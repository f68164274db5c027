"""Warnings about discrepancies that have no effect, or that the data cannot tell apart."""

from __future__ import annotations

import numpy as np

from fmu.analysis.trace.densities import discrepant_likelihood
from fmu.numbers import names_in_words
from fmu.posterior.discrepancy.likelihood import DiscrepantLikelihood
from fmu.posterior.problem import UpdatingProblem

_NO_EFFECT = 1e-9
"""A parameter has no effect if its changes of all residuals are below this fraction of the largest change."""
_ALIKE = 0.999
"""Correlation between the information on two standard deviations above which the data cannot tell them apart."""


def discrepancy_doubts(problem: UpdatingProblem) -> list[str]:
    """Return warnings about a problem's discrepancies at its starting point, one sentence each.

    A warning concerns a parameter that should scatter but changes no mode, a length without effect, or two
    inferred standard deviations that the data cannot tell apart because their errors have the same pattern. Their
    Fisher information is then nearly singular. The list is empty without a discrepancy.
    """
    likelihood = discrepant_likelihood(problem)
    if likelihood is None:
        return []
    lengths = _lengths_without_effect(likelihood)
    return [*_without_effect(problem, likelihood), *lengths, *_alike(problem, likelihood)]


def _lengths_without_effect(likelihood: DiscrepantLikelihood) -> list[str]:
    found = []
    for one in likelihood.errors.modes:
        if one.length is None:
            continue
        if one.shape_sd is None:
            found.append("length has no effect, as no mode shapes are compared: leave it out of the discrepancy")
        elif np.count_nonzero(one.root) == len(one.root):
            found.append(
                "length has no effect, as the model has no coordinates of two sensors with the same direction: "
                "their errors are independent; give the model coordinates, or leave length out of the discrepancy"
            )
    return found


def _without_effect(problem: UpdatingProblem, likelihood: DiscrepantLikelihood) -> list[str]:
    theta = problem.layout.of_model(problem.start[None])
    J = likelihood.errors.linearise(
        likelihood.terms_of,
        likelihood.observed(theta, True),
        theta[:, likelihood.model.n_parameters :],
        likelihood.of_used,
    ).slopes
    parameters, n_tests = problem.layout.structural, len(problem.tests)
    values = theta[0, : likelihood.model.n_parameters].reshape(n_tests, -1)
    change = np.max(np.abs(J[0]), axis=(0, 1)) * np.max(likelihood.errors.scale(values), axis=0)
    scattered = likelihood.errors.scattered
    names = [parameters[k].name for k in scattered if change[k] <= _NO_EFFECT * change.max()]
    if not names:
        return []
    verb = "changes" if len(names) == 1 else "change"
    return [
        f"{names_in_words(names)} {verb} no mode: a scatter has no effect, and an inferred one keeps its prior; "
        "name other groups in the discrepancy"
    ]


def _alike(problem: UpdatingProblem, likelihood: DiscrepantLikelihood) -> list[str]:
    names = problem.names[problem.n_structural :]
    information = problem.quadratic(problem.start[None])[2][0][problem.n_structural :, problem.n_structural :]
    size = np.sqrt(np.diag(information))
    found = []
    for i, name in enumerate(names):
        for k in range(i):
            if size[i] > 0.0 and size[k] > 0.0 and information[i, k] > _ALIKE * size[i] * size[k]:
                found.append(
                    f"{names[k]} and {name} cannot be told apart, as both give the data the same errors: leave "
                    "one out, or give its value"
                )
    return found
