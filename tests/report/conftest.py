"""One experiment of the paper, run for a few seconds: too short to mean anything, long enough to write "
"down."""

import pytest

from fmu.report.paper.experiment import compute
from fmu.report.paper.findings import Findings
from fmu.report.paper.plan import Length, Plan

EXPERIMENT = ("cantilever-section", "shape")


@pytest.fixture(scope="session")
def plan():
    return Plan(
        experiments=(EXPERIMENT,),
        paper=Length(40, 0, 1),
        long={
            "mh": Length(80, 20, 2),
            "slice": Length(40, 10, 2),
            "hmc": Length(30, 20, 2),
            "emcee": Length(20, 5, 2),
        },
        starts=16,
        box_points=2**8,
    )


@pytest.fixture(scope="session")
def messages():
    return []


@pytest.fixture(scope="session")
def result(plan, messages):
    return compute(*EXPERIMENT, plan, lambda *message: messages.append(message))


@pytest.fixture(scope="session")
def findings(result):
    return Findings.of(result)
