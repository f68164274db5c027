"""The layout of the parameters of several tests, from what varies between them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from fmu.posterior.joint.correlation import Correlation, correlations
from fmu.posterior.joint.damage import Damage
from fmu.posterior.joint.layout import SHARED, Layout, Role
from fmu.posterior.joint.modal_test import Test
from fmu.posterior.joint.population import Population
from fmu.posterior.joint.values import Drawn, Lost, Taken, Trend
from fmu.posterior.parameters import Parameter
from fmu.posterior.priors.base import Normal, Prior

BY_TEST, BY_GROUP = "test", "group"
VARIES = (SHARED, BY_TEST, BY_GROUP)


def build_layout(
    structural: Sequence[Parameter],
    tests: Sequence[Test],
    varies: Mapping[str, str | Population | Damage],
    slopes: Mapping[str, Mapping[str, Prior]],
    reference: str,
    eta: float | None,
) -> Layout:
    """Return the layout of several tests; `fmu.JointProblem` explains the arguments, and has checked them."""
    main: list[Parameter] = []
    scores: list[Parameter] = []
    pending: list[Any] = []
    roles: list[Role] = []
    of_scores: list[Role] = []

    def add(parameter: Parameter, kind: str, of: int | None, where: str = "") -> int:
        main.append(parameter)
        roles.append(Role(kind, of, where))
        return len(main) - 1

    for j, p in enumerate(structural):
        how = varies.get(p.name, SHARED)
        here = [t for t, test in enumerate(tests) if p.name not in test.known]
        columns = np.zeros(len(tests), dtype=np.int64)
        base: Any
        if isinstance(how, Population):
            mean, sd = how.parameters(p)
            centre, width = add(mean, "mean", j), add(sd, "sd", j)
            columns[here] = len(scores) + np.arange(len(here))
            for t in here:
                scores.append(Parameter(f"{p.name} score [{tests[t].name}]", 0.0, prior=Normal(1.0)))
                of_scores.append(Role("score", j, tests[t].name))
            scored, start = np.isin(range(len(tests)), here), (main[centre].start, main[width].start)
            base = Drawn(how, centre, width, columns, scored, p.lower, p.upper, np.zeros(len(tests)), start)
        elif isinstance(how, Damage):
            base = _lose(p, how, tests, reference, partial(add, of=j))
        else:
            places = [_place_of(how, test) for test in tests]
            number = {
                place: add(_rename(p, f"{p.name} [{place}]" if how != SHARED else p.name), how, j, place)
                for place in dict.fromkeys(places[t] for t in here)
            }
            columns[here] = [number[places[t]] for t in here]
            base = Taken(columns, p if how == BY_TEST else None)
        of_slopes, away, means = [], [], []
        for covariate, prior in slopes.get(p.name, {}).items():
            x = np.array([test.covariates[covariate] for test in tests])
            away.append(x - x.mean())
            means.append(float(x.mean()))
            at = float(np.clip(0.0, *prior.support))
            of_slope = Parameter(f"{p.name} per {covariate}", at, prior=prior)
            of_slopes.append(add(of_slope, "slope", j, covariate))
        trend = (tuple(of_slopes), np.array(away), tuple(slopes.get(p.name, {})), tuple(means))
        pending.append((base, trend))

    correlation = None
    if eta is not None:
        of_both = correlations([name for name, _ in find_populations(structural, varies)], eta)
        correlation = Correlation(
            tuple(add(parameter, "correlation", None) for parameter in of_both),
            np.stack([base.scored for base, _ in pending if isinstance(base, Drawn)], axis=1),
        )
    values_of = []
    for base, trend in pending:
        if isinstance(base, Drawn):  # the scores follow all others
            base = replace(base, columns=base.columns + len(main))
        values_of.append(Trend(base, *trend) if trend[0] else base)
    return Layout(
        tuple(structural),
        (*main, *scores),
        tuple(tests),
        tuple(values_of),
        dict(find_populations(structural, varies)),
        tuple(name for name, how in varies.items() if how == BY_TEST),
        tuple(
            p.name for p in structural if varies.get(p.name) == BY_GROUP or isinstance(varies.get(p.name), Damage)
        ),
        correlation,
        (*roles, *of_scores),
        reference,
    )


def find_populations(structural: Sequence[Parameter], varies: Mapping[str, Any]) -> list[tuple[str, Population]]:
    """Return the parameters that scatter over the tests, in the order of theta, with their populations."""
    every = ((p.name, varies.get(p.name)) for p in structural)
    return [(name, how) for name, how in every if isinstance(how, Population)]


def _lose(
    p: Parameter,
    how: Damage,
    tests: Sequence[Test],
    reference: str,
    add: Callable[..., int],
) -> Lost:
    """Return a parameter with losses, and add its parameters to the parameters of all tests."""
    column = add(p, "group", where=reference)
    states = dict.fromkeys(test.group for test in tests if test.group != reference)
    numbers = {reference: column} | {state: add(how.loss(p, state), "loss", where=state) for state in states}
    is_lost = np.array([test.group != reference for test in tests])
    return Lost(column, np.array([numbers[test.group] for test in tests]), is_lost)


def _place_of(how: str, test: Test) -> str:
    """Return the test or group that has a value of its own; empty where all share it."""
    return {SHARED: "", BY_TEST: test.name, BY_GROUP: test.group}[how]


def _rename(p: Parameter, name: str) -> Parameter:
    return p if name == p.name else Parameter(name, p.start, p.lower, p.upper, p.prior, p.unit, p.group)
