"""Models of a generator: none costs more than its budget of counted work, none is wrong, no library warns.

A small sample of `tests.validation.random_models`, which examines forty.
"""

import numpy as np
import pytest
import scipy.sparse as sp

from fmu.fem.reduced import training
from fmu.fem.reduced.anchors import SingularAnchorError
from fmu.posterior.reduction import train_reduced
from tests.models.extended_precision import HAS_DIGITS, LONG, elastic_modes
from tests.models.random_models import random_model
from tests.validation import random_models
from tests.validation.random_models import Found, examined, page, refused_wrongly
from tests.work import Work

pytestmark = pytest.mark.skipif(not HAS_DIGITS, reason="numpy.longdouble has no more digits than float here")


SMALL = random_model(102, 700)
START = np.ones(len(SMALL.parameters))


@pytest.fixture(autouse=True)
def _one_point(monkeypatch):
    """Compare frequencies at one point of two: extended precision takes most of the time."""
    monkeypatch.setattr(random_models, "POINTS", 1)


def test_modes_at_draws_that_span_too_little_leave_the_full_model(monkeypatch):
    """Those of a mechanism are so alike that no basis can be made of them: no model may be refused for that."""
    monkeypatch.setenv("FMU_CACHE_DIR", "")
    monkeypatch.setattr(training, "BUDGET", 30)  # with 400 no basis for the box pays either
    spoilt, whole = [], train_reduced.train_at

    def noticed(*given):
        try:
            return whole(*given)
        except SingularAnchorError as error:
            spoilt.append(error)
            raise

    monkeypatch.setattr(train_reduced, "train_at", noticed)
    found = examined(15)
    assert spoilt
    assert (found.refused, found.faults) == (None, [])


@pytest.mark.parametrize(
    "seed", [108, 110, 112, *(pytest.param(seed, marks=pytest.mark.validate) for seed in (102, 103, 107, 111))]
)
def test_some_small_models(seed, monkeypatch):
    monkeypatch.setenv("FMU_CACHE_DIR", "")
    found = examined(seed, 700 if seed == 110 else 300)  # one that is solved as a sparse one
    assert found.faults == []
    assert found.refused is None
    assert found.work.eigenproblems > 0
    assert 0.0 < found.error < 1e-4


def test_a_frequency_that_is_not_the_exact_one_and_work_beyond_the_budget_are_found(monkeypatch):
    monkeypatch.setenv("FMU_CACHE_DIR", "")
    whole = random_models.exact

    def another(*given):
        frequencies, rounding = whole(*given)
        return 1.0001 * frequencies, rounding

    monkeypatch.setattr(random_models, "exact", another)
    monkeypatch.setattr(random_models, "MOST", Work(4, 4, 4))
    faults = examined(112, 300).faults
    assert any(fault.startswith("full model: ") for fault in faults)
    assert any("eigenproblems, at most 4" in fault for fault in faults)


def test_a_refusal_is_a_fault_where_digits_are_left(monkeypatch):
    assert refused_wrongly(SMALL, START, "rounding: no") != []
    assert refused_wrongly(SMALL, START, "no") == ["refused: no"]
    monkeypatch.setattr(random_models, "SD", 1e-16)
    assert refused_wrongly(SMALL, START, "rounding: no") == []


def test_the_reference_has_the_digits_of_a_chain():
    """Fixed at one end, n equal springs and masses: λ = 4 k/m sin²((2 j − 1) π/(4 n + 2))."""
    n = 200
    K = sp.diags_array([-np.ones(n - 1), np.r_[np.full(n - 1, 2.0), 1.0], -np.ones(n - 1)], offsets=[-1, 0, 1])
    lam, phi = elastic_modes(K.tocsr().astype(LONG), sp.eye_array(n, format="csr").astype(LONG), 3)
    exact = 4.0 * np.sin((2.0 * np.arange(1, 4) - 1.0) * np.pi / (4 * n + 2)) ** 2
    np.testing.assert_allclose(lam.astype(float), exact, rtol=2e-15)
    np.testing.assert_allclose((phi.T @ phi).astype(float), np.eye(3), atol=1e-9)


def test_the_page_names_faults_and_refusals():
    good, bad = Found(1, SMALL, error=1e-9), Found(2, SMALL, refused="rounding: no", faults=["refused, but"])
    text = page([good, bad])
    assert "**1 fault; 1 of 2 models refused.**" in text
    assert f"- seed 2, {SMALL}: refused, but\n" in text
    assert "**No faults; 0 of 1 models refused.**" in page([good])


@pytest.mark.parametrize(("faults", "refused", "code"), [([], 1, 0), ([], 2, 1), (["wrong"], 0, 1)])
def test_faults_and_more_than_one_refusal_fail(tmp_path, monkeypatch, faults, refused, code):
    monkeypatch.setattr(
        random_models,
        "examined",
        lambda seed: Found(seed, SMALL, refused="rounding: no" if seed < refused else None, faults=faults),
    )
    monkeypatch.setattr(random_models, "random_model", lambda seed, most_dofs: SMALL)  # a model of up to 5000 DOF
    monkeypatch.setattr("sys.argv", ["random_models", str(tmp_path)])
    assert random_models.main() == code
    assert f"{refused} of 40 models refused." in (tmp_path / "random-models.md").read_text(encoding="utf-8")
