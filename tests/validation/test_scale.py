"""The study of scale: its frames, its rows and its page."""

import numpy as np
import pytest

from fmu.fem.modes.solver import PARDISO, SUPERLU
from fmu.posterior.reduction.tolerance import Tolerance
from tests.validation.scale import BEFORE, rows
from tests.validation.scale_model import E, Size, frame, scale_problem
from tests.validation.scale_page import figures, page
from tests.validation.scale_row import Row


@pytest.mark.parametrize("n_parameters", [2, 5, 6])
def test_every_member_belongs_to_one_group_and_the_frame_is_as_large_as_said(n_parameters):
    size = Size(3, 3, 2)
    built = frame(size, n_parameters)
    assert len(built.groups) == n_parameters
    members = np.concatenate([np.asarray(group.elements) for group in built.groups])
    assert len(members) == len(np.unique(np.sort(members, axis=1), axis=0)) == 3 * (6 + 4 + 3)
    model = built.separable({f"E_{group.name}": [("E", group.name)] for group in built.groups})
    assert model.n_dof == size.n_dof == 108
    assert len(model.blocks) == 1


def test_the_problem_is_one_of_ten_frequencies_and_as_many_moduli(monkeypatch):
    problem = scale_problem(Size(3, 3, 2), 5, reduction=False)
    assert problem.ndim == 5
    assert problem.data.n_modes == 10
    np.testing.assert_allclose(problem.upper, 1.21 * E)
    assert np.all(np.abs(problem.frequencies(problem.start) / problem.data.frequencies_hz - 1.0) < 0.1)
    assert Row(3, 3, 2, 5, 1e-4).name == "108-5-0.0001-64"


def test_rows_have_names_of_their_own_and_meet_what_is_demanded():
    wanted = rows()
    asked = [row for table in wanted.values() for row in table]
    assert len({row.name for row in asked}) == len(set(asked))
    demand = wanted["demand"]
    assert all(row.size.n_dof > 10_000 and row.parameters == 50 and row.chains == 64 for row in demand)
    assert [row.reduction for row in demand] == [1e-6, 1e-5, 1e-4, 1e-3]
    assert all(Tolerance.of(row.reduction) is not None for row in demand)
    assert {row.solver for row in asked if row.size.n_dof > 100_000} == {SUPERLU, PARDISO}
    assert all(row in {*wanted["dof"], *demand} for row in BEFORE)


def made_up(row):
    """Return a row as if it had been measured: a hundred vectors, and less time the looser the tolerance."""
    share = 1.0 + np.log10(row.reduction) / 10.0
    names = ("offline_wall_s", "offline_gib", "full_s", "peak_gib", "factorising_s", "solving_s")
    found = dict.fromkeys(names, 2.0) | {
        "offline_s": 10.0,
        "full_solves": 7,
        "factorisations": 12,
        "right_hand_sides": 2840,
        "said": [],
        "basis": 100,
        "value_s": 2e-3,
        "gradient_s": 8e-3 * share,
        "bound_s": 0.25,
        "online_gib": 1.5,
        "checked": 16,
        "frequency_error": 3e-7,
        "frequency_bound": 4e-7,
        "before": None,
    }
    if row.reduction == 1e-6 and row.parameters == 50:
        found["said"] = ["reduction: with a basis of 100 vectors the reduced model is off"]
    if row in BEFORE:
        found["before"] = {"offline_s": 55.0, "offline_solves": 272, "commit": "f867c49"} | {
            "finished": "2026-11-21 19:07"
        }
    return vars(row) | found


def test_the_page_says_what_was_measured():
    found = {name: [made_up(row) for row in table] for name, table in rows().items()}
    text = page(found)
    assert "## 10 080 degrees of freedom, 50 parameters, 64 chains" in text
    assert "- `1e-6`: reduction: with a basis of 100 vectors the reduced model is off" in text
    assert "training by full solves, commit f867c49, measured on 2026-11-21" in text
    assert "| 10 080 | 5 | `1e-6` | SuperLU | 100 | 10.0 | 12 | 20% | 2 840 | 20% | 7 | 55 | 272 | 5.5 |" in text
    assert "| 100 800 | 5 | `1e-6` | PARDISO |" in text
    drawn = figures(found)
    assert set(drawn) == {"tolerance.png", "growth.png"}
    assert all(name in text for name in drawn)
    assert [len(figure.axes) for figure in drawn.values()] == [2, 3]
    some = found | {"demand": [], "superlu": []}
    assert "## Degrees of freedom" in page(some)
    assert "## 10 080" not in page(some)
    assert set(figures(some)) == {"growth.png"}


def test_the_page_says_where_the_full_model_answers():
    table = [row for row in rows()["parameters"] if row.parameters in (2, 50)]
    found = {name: [] for name in rows()} | {
        "parameters": [made_up(row) | ({"basis": 0} if row.parameters == 50 else {}) for row in table]
    }
    lines = [line for line in page(found).splitlines() if line.startswith("| `") and "vectors" not in line]
    assert [line.endswith("full model |") for line in lines] == [row.parameters == 50 for row in table]
    assert all("| 50 | – |" in line for line in lines if line.endswith("full model |"))
