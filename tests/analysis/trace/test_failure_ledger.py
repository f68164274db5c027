"""The ledger of failed solves, and the rule that stops a run."""

import csv
import io

import numpy as np
import pandas as pd
import pytest

from fmu.analysis.trace.failure_ledger import FailedSolves, failure_rate_exceeded, failures_csv
from fmu.posterior.failures import Failure

NAMES, UNITS = ("E", "k"), ("Pa", "")
MASS, RAISED = "M is not positive definite", 'RuntimeError: "no", it said'
PARTS = [
    FailedSolves(0, "warmup", 100, [Failure(np.array([2.1e11 / 3, 0.1]), MASS)], 1),
    FailedSolves(1, "warmup", 100, [], 0),
    FailedSolves(1, "draws", 50, [Failure(np.array([1.0, 2.0]), RAISED), Failure(np.array([3.0, 4.0]), MASS)], 7),
]


def failures_table(parts):
    return pd.read_csv(io.StringIO(failures_csv(NAMES, UNITS, parts)))


def test_a_row_a_theta():
    table = failures_table(PARTS)
    assert list(table.columns) == ["task", "phase", "step", "E [Pa]", "k", "reason"]
    assert table["task"].tolist() == [0, 1, 1, 1]
    assert table["step"].tolist() == [100, 50, 50, 50]
    assert table["phase"].tolist() == ["warmup", "draws", "draws", "draws"]
    assert table["E [Pa]"].tolist()[:3] == [2.1e11 / 3, 1.0, 3.0]
    assert table["reason"].tolist() == [
        MASS,
        RAISED,
        MASS,
        "5 more failed solves, at a theta above or not recorded",
    ]
    assert np.isnan(table["E [Pa]"][3])


def test_csv_has_all_digits():
    text = failures_csv(NAMES, UNITS, PARTS)
    assert float(next(csv.DictReader(io.StringIO(text)))["E [Pa]"]) == 2.1e11 / 3


def test_csv_can_be_appended_to():
    text = failures_csv(NAMES, UNITS, PARTS[:1]) + failures_csv(NAMES, UNITS, PARTS[1:], header=False)
    assert text == failures_csv(NAMES, UNITS, PARTS)
    assert failures_csv(NAMES, UNITS, []) == "task,phase,step,E [Pa],k,reason\n"
    assert failures_csv(NAMES, UNITS, [], header=False) == ""
    assert failures_table([]).empty


@pytest.mark.parametrize(
    ("failed", "solves", "limit", "at_least", "stops"),
    [
        (199, 199, 0.1, 200, False),
        (200, 200, 0.1, 200, True),
        (20, 200, 0.1, 200, False),
        (21, 200, 0.1, 200, True),
        (1, 200, 0.0, 200, True),
        (0, 200, 0.0, 200, False),
        (500, 500, 1.0, 200, False),
        (6, 10, 0.5, 10, True),
        (0, 0, 0.5, 0, False),
    ],
)
def test_the_limit(failed, solves, limit, at_least, stops):
    message = failure_rate_exceeded(failed, solves, limit, at_least)
    assert (message is not None) is stops


def test_what_it_says():
    assert failure_rate_exceeded(310, 1240, 0.2) == "310 of 1240 solves failed (25 %), more than the limit of 20 %"
    failures = [Failure(np.zeros(1), reason) for reason in (RAISED, MASS, MASS)]
    message = failure_rate_exceeded(310, 1240, 0.2, failures=failures)
    assert message.endswith(f"20 %; most often: {MASS}")


@pytest.mark.parametrize("limit", [-0.1, 1.1, np.nan])
def test_a_limit_is_a_share(limit):
    with pytest.raises(ValueError, match=r"^limit: must lie between 0 and 1, a share of the solves \(got "):
        failure_rate_exceeded(1, 300, limit)
