"""One experiment of the paper, run for a few seconds: too short to mean anything, long enough to write down."""

import pytest

from fmu.analysis.held_out.modes import with_left_out
from fmu.paper.experiment import compute
from fmu.paper.findings import Findings
from fmu.paper.plan import PAPER_SAMPLERS, Length, Plan, Runs
from fmu.paper.studies.wrong_model import study_wrong_model

EXPERIMENT = ("cantilever-section", "shape")


@pytest.fixture(scope="session")
def plan():
    return Plan(
        experiments=(EXPERIMENT,),
        paper=Length(40, 0, 1),
        pace=dict.fromkeys(PAPER_SAMPLERS, Length(40, 0, 2)),
        long={
            "mh": Length(80, 20, 2),
            "slice": Length(40, 10, 2),
            "hmc": Length(30, 20, 2),
            "emcee": Length(20, 5, 2),
            "mixture": Length(40, 20, 2),
        },
        one_start=Length(30, 20, 2),
        wrong=Length(60, 100, 2),
        starts=16,
        box_points=2**8,
    )


@pytest.fixture(scope="session")
def messages():
    return []


@pytest.fixture(scope="session")
def jumps():
    """Whether each run of the `result` was asked to jump between maxima, by its words."""
    return {}


@pytest.fixture(scope="session")
def result(plan, messages, jumps):
    run = Runs.run

    def recorded(self, words, *arguments, **options):
        jumps[words] = options.get("jumps")
        return run(self, words, *arguments, **options)

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(Runs, "run", recorded)
        return compute(*EXPERIMENT, plan, lambda *message: messages.append(message))


@pytest.fixture(scope="session")
def findings(result):
    return Findings.of(result)


@pytest.fixture(scope="session")
def left_out():
    """What the comparison of the `wrong_model` left out: (trace, problem, seconds) and the trace that keeps it."""
    return []


@pytest.fixture(scope="session")
def wrong_model(result, plan, left_out):
    """The trace with scatter, and the comparison with the long run."""

    def record(*given):
        left_out.append((given, with_left_out(*given)))
        return left_out[-1][1]

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("fmu.paper.studies.wrong_model.with_left_out", record)
        return study_wrong_model(result, plan)
