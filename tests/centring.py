"""A centring of scores that takes no search, for tests of what does not depend on it."""

from dataclasses import replace

import numpy as np
import pytest

from fmu.posterior.joint import joint_problem


def centre_in_part(problem):
    """Return a layout whose scores are centred by about a half, by more in each test than in the one before."""
    layout, start = problem.layout, problem.start
    of = {}
    for one in layout.drawn:
        shares = np.linspace(0.4, 0.6, len(one.scored))
        of[one.centre] = (np.where(one.scored, shares, 0.0), (start[one.centre], start[one.widths]))
    return replace(layout, values_of=tuple(one.refer_to(of) for one in layout.values_of))


@pytest.fixture
def half_centred(monkeypatch):
    """Centre all scores by about a half, without the search for the best centring: most of the time."""
    monkeypatch.setattr(joint_problem, "centre_scores", centre_in_part)


@pytest.fixture(scope="module")
def all_half_centred():
    """Do the same in all tests of a file."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(joint_problem, "centre_scores", centre_in_part)
        yield
