"""Build the parameter layout for several tests. It depends on how each structural parameter varies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from fmu.posterior.joint.correlation import Correlation, correlations
from fmu.posterior.joint.layout import Layout
from fmu.posterior.joint.modal_test import Test
from fmu.posterior.joint.outliers import ContaminatedScores, Outliers
from fmu.posterior.joint.varies.autocorrelation import ScoresInTime
from fmu.posterior.joint.varies.base import Theta, Varies
from fmu.posterior.joint.varies.taken import Held
from fmu.posterior.joint.varies.trend import Slopes, Trends, as_dicts
from fmu.posterior.parameters import Parameter


def build_layout(
    structural: Sequence[Parameter],
    tests: Sequence[Test],
    varies: Mapping[str, Varies],
    slopes: Slopes,
    reference: str,
    eta: float | None,
    outliers: Outliers | None,
) -> Layout:
    """Return the parameter layout for several tests; `fmu.JointProblem` describes and checks the arguments.

    `varies` has an entry for every structural parameter, and `eta` is the argument `correlation`. Raise ValueError
    if a parameter cannot vary as requested.
    """
    theta, values_of = Theta(tests, reference), []
    trends = Trends(structural, slopes, theta)
    for j, p in enumerate(structural):
        here = [t for t, test in enumerate(tests) if p.name not in test.known]
        value_of = varies[p.name].in_tests(p, j, theta, here) if p.updated else Held(p, len(tests))
        values_of.append(trends.add_to(value_of, p.name))
    populations = {p.name: one for p in structural if (one := varies[p.name].population) is not None}
    columns: tuple[int, ...] = ()
    if eta is not None:
        of_both = correlations(list(populations), eta)
        columns = tuple(theta.add(parameter, "correlation", None) for parameter in of_both)
    share = None if outliers is None else outliers.parameter
    of_share = None if share is None else theta.add(share, "share", None)
    layout = Layout(
        tuple(structural),
        (*theta.main, *theta.scores),
        tuple(tests),
        tuple(value_of.after(len(theta.main)) for value_of in values_of),
        populations,
        tuple(p.name for p in structural if varies[p.name].by_group),
        None,
        None,
        None,
        (*theta.roles, *theta.roles_of_scores),
        reference,
        as_dicts(slopes),
        {p.name: by for p in structural if (by := varies[p.name].by_date) is not None},
    )
    if any(one.in_time for one in layout.drawn):
        return replace(layout, in_time=ScoresInTime(tuple(one.in_time for one in layout.drawn), len(tests)))
    if eta is None and outliers is None:
        return layout
    scored = np.stack([one.scored for one in layout.drawn], axis=1)
    correlation = None if eta is None else Correlation(columns, scored)
    contaminated = None if outliers is None else ContaminatedScores(outliers, of_share, scored, correlation)
    return replace(layout, correlation=correlation, outliers=contaminated)
