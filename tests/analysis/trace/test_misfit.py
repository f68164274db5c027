"""The squared residuals that a trace keeps at its draws."""

import numpy as np
import pytest
import xarray as xr
from scipy.stats import kstest, lognorm

import fmu
from fmu.analysis.trace.conversion import to_trace
from fmu.analysis.trace.misfit import TAILS, has_scores
from fmu.fem.pairing.prediction import ModalPrediction
from fmu.posterior.errors.shape import ShapeTerm
from tests.shear_building import shear_building


def squares_of(trace):
    return trace["misfit"]["squares"].transpose("chain", "draw", "quantity", "mode").to_numpy()


def test_known_errors_of_frequencies(make_result, problem):
    theta = 0.3 * np.random.default_rng(3).standard_normal((2, 50, 2))
    trace = to_trace(make_result(theta), problem)
    f = trace["posterior_predictive"]["model_frequency"].to_numpy()
    sd = 1.0 / np.sqrt(2.0 * trace["constant_data"]["beta"].to_numpy())
    expected = ((f - trace["observed_data"]["frequency"].to_numpy()) / sd) ** 2
    np.testing.assert_allclose(squares_of(trace)[:, :, 0], expected, rtol=1e-12)
    misfit = trace["misfit"].to_dataset()
    assert misfit["quantity"].values.tolist() == ["frequencies"]
    assert misfit["freedom"].values.tolist() == [1]
    assert misfit.attrs == {"n_data": 3, "other": "", "scores": 0}
    assert "noise_isf" not in misfit


@pytest.fixture(scope="module")
def shaped():
    """Two storeys with measured frequencies and shapes, both errors inferred; the full model answers."""
    dofs = [(1, "x"), (2, "x")]
    model = shear_building(["k", "k"], 400.0, dofs=dofs)
    data = fmu.ModalData([1.99, 5.10], sensors=tuple(dofs), shapes=[[0.6, -1.0], [1.0, 0.65]])
    noise = {
        name: fmu.Parameter(name, start, 0.0, np.inf, fmu.LogNormal(start, 0.4))
        for name, start in (("sd_f", 0.01), ("sd_s", 0.03))
    }
    errors = [fmu.FrequencyErrors("relative", sd=noise["sd_f"]), fmu.ShapeErrors(noise["sd_s"])]
    parameters = [fmu.Parameter("k", 1.0, 0.5, 2.0)]
    return fmu.UpdatingProblem(model, data, parameters, error=errors)


def test_inferred_errors_of_frequencies_and_shapes(make_result, shaped):
    theta = np.random.default_rng(5).uniform([0.8, 0.005, 0.01], [1.2, 0.02, 0.06], (2, 20, 3))
    trace = to_trace(make_result(theta), shaped)
    theta = theta.reshape(-1, 3)
    seen = shaped.model.observed(theta[:, :1])
    found = squares_of(trace).reshape(-1, 2, 2)
    r = (seen.frequencies / np.asarray(shaped.data.frequencies_hz) - 1.0) / theta[:, 1:2]
    np.testing.assert_allclose(found[:, 0], r**2, rtol=1e-9)
    shapes = np.asarray(shaped.data.shapes)
    alike = np.einsum("sm,nsm->nm", shapes, seen.shapes) ** 2
    alike /= np.sum(shapes**2, axis=0) * np.sum(seen.shapes**2, axis=1)
    np.testing.assert_allclose(found[:, 1], (1.0 - alike) / theta[:, 2:] ** 2, rtol=1e-7)
    misfit = trace["misfit"].to_dataset()
    assert misfit["freedom"].values.tolist() == [1, 1]
    assert misfit.attrs["n_data"] == 4  # of two components of a shape one is its scale
    for p in shaped.parameters[1:]:
        kept = misfit["noise_isf"].sel(noise=p.name).to_numpy()
        np.testing.assert_allclose(lognorm.sf(kept[:-1], 0.4, scale=p.start), TAILS[:-1], rtol=1e-6)


def test_it_takes_no_further_solves(shaped, monkeypatch):
    """The terms and the squares of a draw come from one solve of the modes at the sensors."""
    asked, observed = [], shaped.model.observed
    monkeypatch.setattr(shaped.model, "observed", lambda x, *rest: asked.append(len(x)) or observed(x, *rest))
    shaped.terms_and_misfit(np.tile(shaped.start, (7, 1)))
    assert asked == [7]


def test_the_modal_residual_is_not_an_error_of_a_measurement(shaped):
    assert shaped.likelihood.chi_square == shaped.likelihood.terms_of
    residual = fmu.UpdatingProblem(
        shaped.model.truth.structure, shaped.data, shaped.parameters[:1], error="modal-residual"
    )
    terms, squares = residual.terms_and_misfit(np.ones((4, 1)))
    assert terms.shape == (4, 2)
    assert squares.shape == (4, 0, 2)
    assert residual.likelihood.terms_of == ()


@pytest.mark.parametrize("sd", [0.01, np.array([[0.02], [0.01], [0.03], [0.015]])])
def test_residuals_of_shapes_are_chi_square(sd):
    """The scale of a shape is no datum: at q sensors there are q − 1 degrees of freedom."""
    rng, phi = np.random.default_rng(8), np.array([0.3, 0.8, -0.5, 0.1])
    measured = phi / np.linalg.norm(phi) + np.ravel(sd) * rng.standard_normal((1000, 4))
    sensors = tuple((i, "x") for i in range(4))
    seen = ModalPrediction(np.ones((1, 1)), phi[None, :, None], None, None)
    found = []
    for shape in measured:
        term = fmu.ShapeErrors(sd).bind(fmu.ModalData([1.0], sensors=sensors, shapes=shape[:, None]), None)
        found.append(float(np.sum(term.residuals(seen, np.empty((1, 0))).values ** 2)))
    assert isinstance(term, ShapeTerm)
    assert term.n_data == 3
    assert kstest(found, "chi2", args=(3,)).pvalue > 1e-3


def test_squares_of_tests_with_another_error_are_no_scores():
    """A trace says it itself; one of an earlier version has tests, and no attribute."""
    tests = xr.Dataset({"tests": ("test", [1.0])})
    for attrs, are in (({"scores": 0}, False), ({"scores": 1}, True), ({}, True)):
        assert (
            has_scores(xr.DataTree.from_dict({"observed_data": tests, "misfit": xr.Dataset(attrs=attrs)})) is are
        )
