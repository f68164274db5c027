"""The study of populations: truths are draws from the priors of the problem, and the gates see what is wrong."""

import numpy as np
import pytest

from tests.validation.populations import ETA, SetOfTests, correlation_factor, simulate_design
from tests.validation.populations_page import KINDS, RANKED, Study, page


def test_a_design_has_truths_inside_the_posterior():
    design = next(
        d for d in (simulate_design(1, i) for i in range(20)) if any(" correlation" in n for n in d.truths)
    )
    main = [name for name in design.problem.names if " score " not in name]
    assert set(design.truths) == set(main)
    theta = np.array([design.truths.get(name, 0.0) for name in design.problem.names])
    assert np.isfinite(design.problem.log_prior(theta[None]))[0]


def test_correlations_have_the_density_of_lkj():
    """Each is beta on (-1, 1) with both shapes η − 1 + p/2, of variance 1/(2 η − 1 + p)."""
    rng, p, n = np.random.default_rng(1), 4, 4000
    factors = np.array([correlation_factor(rng, p)[0] for _ in range(n)])
    R = factors @ np.swapaxes(factors, 1, 2)
    np.testing.assert_allclose(np.diagonal(R, axis1=1, axis2=2), 1.0, rtol=1e-12)
    pairs = R[:, *np.triu_indices(p, 1)]
    # the relative standard error of a variance is at most √(2/n)
    np.testing.assert_allclose(pairs.var(axis=0), 1.0 / (2.0 * ETA - 1.0 + p), rtol=5.0 * np.sqrt(2.0 / n))


def study_of(n, missed=0, rank=None, failed=0):
    """Return a study of n sets; `missed` of them miss their truths, ranks are uniform or all the same."""
    sets = []
    for i in range(n):
        inside = {kind: [i >= missed] for kind in KINDS}
        ranks = {kind: [i % (RANKED + 1) if rank is None else rank] for kind in KINDS}
        sets.append(
            SetOfTests(i, 3, 5, True, False, i >= failed, [], {"k1 log sd": 410.0}, 2000, 4000, 1.0, inside, ranks)
        )
    return Study(sets)


@pytest.mark.parametrize(
    ("changes", "failures"),
    [({"missed": 10}, 0), ({"missed": 40}, 4), ({"rank": 3, "missed": 10}, 4), ({"missed": 10, "failed": 10}, 1)],
)
def test_gates(changes, failures):
    study = study_of(100, **changes)
    assert len(study.failures) == failures
    text, of_few = page(study, 100, "settings"), page(study, 300, "settings")
    assert ("All gates pass" in text) == (failures == 0)
    assert "All gates pass" not in of_few
    assert ("100 of the 300 sets of `make validate` decide nothing yet" in of_few) == (failures == 0)
    assert f"{100 - changes.get('failed', 0)} of 100 runs converged" in text
