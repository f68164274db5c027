"""Gaussian residuals with errors in common, against dense covariances."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import stats

from fmu.posterior.discrepancy.latent import LatentErrors
from tests.gradients import assert_gradient

GROUPS = {
    "one row each": [0, 1, 2, 3],
    "several tests": [0, 1, 0, 2, 1, 0],
}
SIZES = {"one residual": (1, 3, 0), "shapes": (4, 2, 0), "coupled": (1, 2, 1), "coupled shapes": (3, 5, 2)}
CASES = [(group, sizes) for group in GROUPS for sizes in SIZES]


def errors_of(group, sizes, n=3):
    """Return residuals and loads of very different sizes."""
    (k, P, C), rows = SIZES[sizes], GROUPS[group]
    rng, m = np.random.default_rng(5), len(rows)
    r = rng.normal(size=(n, m, k)) * np.exp(rng.normal(size=(n, m, k)))
    loads = rng.normal(size=(n, m, k, P)) * np.exp(1.5 * rng.normal(size=(n, m, k, P)))
    return LatentErrors(r, loads, rng.normal(size=(n, m, k, C)), np.array(rows))


def covariance(errors, i):
    """Return the covariance of all residuals number `i`, row by row."""
    _, m, k, _ = errors.loads.shape
    same = np.repeat(np.repeat(errors.group[:, None] == errors.group, k, axis=0), k, axis=1)
    A, a = errors.loads[i].reshape(m * k, -1), errors.common[i].reshape(m * k, -1)
    return np.eye(m * k) + same * (A @ A.T) + a @ a.T


def log_density(errors, i, rows):
    """Return the log-density of the first rows, less that of independent residuals."""
    k = errors.residuals.shape[2]
    r, S = errors.residuals[i].ravel()[: rows * k], covariance(errors, i)[: rows * k, : rows * k]
    return stats.multivariate_normal.logpdf(r, cov=S) - np.sum(stats.norm.logpdf(r)) if rows else 0.0


@pytest.mark.parametrize(("group", "sizes"), CASES)
def test_a_term_is_the_density_given_the_rows_before(group, sizes):
    errors = errors_of(group, sizes)
    m = len(errors.group)
    expected = [np.diff([log_density(errors, i, rows) for rows in range(m + 1)]) for i in range(3)]
    assert_allclose(errors.terms(), expected, rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize(("group", "sizes"), CASES)
def test_terms_given_all_other_rows(group, sizes):
    errors = errors_of(group, sizes)
    m, k = len(errors.group), errors.residuals.shape[2]
    for i in range(3):
        r, S = errors.residuals[i].ravel(), covariance(errors, i)
        whole = stats.multivariate_normal.logpdf(r, cov=S)
        for row in range(m):
            here = np.arange(row * k, (row + 1) * k)
            others = np.delete(np.arange(m * k), here)
            rest = stats.multivariate_normal.logpdf(r[others], cov=S[np.ix_(others, others)])
            expected = whole - rest - np.sum(stats.norm.logpdf(r[here]))
            assert_allclose(errors.terms_given_others()[i, row], expected, rtol=1e-7, atol=1e-8)


@pytest.mark.parametrize(("group", "sizes"), CASES)
def test_squares_sum_to_the_quadratic_form(group, sizes):
    errors = errors_of(group, sizes)
    for i in range(3):
        r = errors.residuals[i].ravel()
        assert_allclose(errors.squares()[i].sum(), r @ np.linalg.solve(covariance(errors, i), r), rtol=1e-9)
    assert np.all(errors.squares() > 0.0)


@pytest.mark.parametrize(("group", "sizes"), CASES)
def test_slopes_against_differences(group, sizes):
    errors = errors_of(group, sizes)
    for name, slope in zip(("residuals", "loads", "common"), errors.slopes(), strict=True):
        value = getattr(errors, name)
        if not value.size:
            continue

        def terms(x, name=name, shape=value.shape):
            parts = {key: getattr(errors, key) for key in ("residuals", "loads", "common", "group")}
            moved = [LatentErrors(**parts | {name: one}) for one in x.reshape(-1, *shape)]
            return np.concatenate([one.terms().sum(axis=1) for one in moved])

        flat = value.reshape(3, -1)
        step = 1e-3 * np.maximum(np.abs(flat), 0.1)
        assert_gradient(slope.reshape(3, -1), terms, flat, step, order=6, rtol=1e-6, of_largest=1e-8)


@pytest.mark.parametrize(("group", "sizes"), CASES)
def test_whitened_residuals_have_the_quadratic_form_of_all_rows(group, sizes):
    errors = errors_of(group, sizes)
    slopes = np.random.default_rng(8).normal(size=(*errors.residuals.shape, 4))
    r, J = errors.whiten(slopes)
    for i in range(3):
        both = np.concatenate([errors.residuals[i].reshape(-1, 1), slopes[i].reshape(-1, 4)], axis=1)
        white = np.concatenate([r[i].reshape(-1, 1), J[i].reshape(-1, 4)], axis=1)
        assert_allclose(
            white.T @ white, both.T @ np.linalg.solve(covariance(errors, i), both), rtol=1e-8, atol=1e-9
        )


@pytest.mark.parametrize(("group", "sizes"), CASES)
def test_the_errors_in_common_given_the_residuals(group, sizes):
    errors = errors_of(group, sizes)
    z, w, of_z, of_both, of_w = errors.given_residuals()
    _, m, k, P = errors.loads.shape
    C = errors.common.shape[3]
    for i in range(3):
        F = np.zeros((m, k, m * P + C))
        for row, last in enumerate(errors.last):
            F[row, :, last * P : (last + 1) * P] = errors.loads[i, row]
        F[..., m * P :] = errors.common[i]
        F = F.reshape(m * k, -1)
        cov = np.linalg.inv(np.eye(F.shape[1]) + F.T @ F)
        mean = cov @ F.T @ errors.residuals[i].ravel()
        for last in np.unique(errors.last):
            own = slice(last * P, (last + 1) * P)
            assert_allclose(z[i, last], mean[own], rtol=1e-7, atol=1e-9)
            assert_allclose(of_z[i, last], cov[own, own], rtol=1e-7, atol=1e-9)
            assert_allclose(of_both[i, last], cov[own, m * P :], rtol=1e-7, atol=1e-9)
        assert_allclose(w[i], mean[m * P :], rtol=1e-7, atol=1e-9)
        assert_allclose(of_w[i], cov[m * P :, m * P :], rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize(("group", "sizes"), CASES)
def test_a_point_without_a_solution_leaves_the_others_as_they_are(group, sizes):
    errors = errors_of(group, sizes)
    residuals, loads = errors.residuals.copy(), errors.loads.copy()
    residuals[1, 0], loads[1, 0] = np.nan, np.nan
    broken = LatentErrors(residuals, loads, errors.common, errors.group)
    with np.errstate(all="ignore"):
        terms, slopes, white = broken.terms(), broken.slopes(), broken.whiten(np.ones((*residuals.shape, 1)))
    assert not np.isfinite(terms[1]).all()
    assert terms[[0, 2]].tolist() == errors.terms()[[0, 2]].tolist()
    assert np.isfinite(slopes.by_loads[[0, 2]]).all()
    assert np.isfinite(white[0][[0, 2]]).all()


@pytest.mark.parametrize(("group", "sizes"), CASES)
def test_rows_do_not_depend_on_the_batch(group, sizes):
    errors = errors_of(group, sizes)
    for i in range(3):
        one = LatentErrors(errors.residuals[[i]], errors.loads[[i]], errors.common[[i]], errors.group)
        assert one.terms().tolist() == errors.terms()[[i]].tolist()
        assert all(np.array_equal(a, b[[i]]) for a, b in zip(one.slopes(), errors.slopes(), strict=True))


def test_loads_that_drown_the_unit_matrix_give_no_number_and_no_exception():
    """Rounding makes I + AᵀA singular; the rows of moderate loads keep their terms."""
    loads = np.stack([np.full((2, 2, 3), 1e20), np.full((2, 2, 3), 0.5)])
    errors = LatentErrors(np.ones((2, 2, 2)), loads, np.zeros((2, 2, 2, 0)), np.array([0, 0]))
    with np.errstate(all="ignore"):
        terms, by_residual = errors.terms(), errors.slopes().by_residual
    assert np.all(np.isnan(terms[0]))
    assert np.all(np.isfinite(terms[1]))
    assert np.all(np.isfinite(by_residual[1]))


@pytest.mark.parametrize("common", [0, 1])
def test_no_density_is_told_where_rounding_of_squares_would_drown_it(common):
    """With an inferred standard deviation near 0 the squares that cancel are large."""
    r = np.full((1, 2, 2), 1e8)
    loads, shared = np.repeat(r[..., None], 2, axis=3), np.ones((1, 2, 2, common))
    assert np.all(LatentErrors(r, loads, shared, np.array([0, 1])).terms() == -np.inf)
    assert np.all(np.isfinite(LatentErrors(1e-4 * r, 1e-4 * loads, shared, np.array([0, 1])).terms()))
