"""The synthetic ten storeys: written by its script, and the posterior that its file says."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import stats
from scipy.linalg import eigh

import fmu
from fmu.fem.modes.modal import mac
from fmu.fem.pairing.rules import RankPairing
from fmu.fem.reduced.basis import ReducedBlock
from fmu.formats.matrices.read import read_matrix
from tests.validation import ten_storeys

FOLDER = fmu.cases.path("shear-10dof").parent / ten_storeys.FOLDER


@pytest.fixture(scope="module")
def problem():
    return fmu.load(fmu.cases.path("shear-10dof"), pairing="index")


@pytest.fixture(scope="module")
def by_shape():
    return fmu.cases.load("shear-10dof")


@pytest.fixture(scope="module")
def theta():
    """Points about as far from the truth as the posterior reaches."""
    truth, _ = ten_storeys.drawn(np.random.default_rng(ten_storeys.SEED), ten_storeys.structure())
    return truth * np.exp(0.08 * np.random.default_rng(3).standard_normal((40, 12)))


def test_the_file_is_what_its_script_writes():
    assert fmu.cases.path("shear-10dof").read_text(encoding="utf-8") == ten_storeys.text()
    for j in range(1, 11):
        np.testing.assert_array_equal(read_matrix(FOLDER / f"storey-{j}.mtx").toarray(), ten_storeys.storey(j))
    np.testing.assert_array_equal(read_matrix(FOLDER / "mass.mtx").toarray(), 100e3 * np.eye(10))


def test_the_posterior_from_scratch(problem, theta):
    measured, shapes = problem.data.frequencies_hz, np.asarray(problem.data.shapes)
    unit = shapes / np.linalg.norm(shapes, axis=0)
    for point, value in zip(theta, problem.log_prob(theta), strict=True):
        factors, (sd_frequency, sd_shape) = point[:10], point[10:]
        K = np.diag(factors + np.append(factors[1:], 0)) - np.diag(factors[1:], 1) - np.diag(factors[1:], -1)
        lam, phi = eigh(176.729e6 * K, 100e3 * np.eye(10))
        f = np.sqrt(lam[:5]) / (2 * np.pi)
        seen = phi[[2, 5, 8, 9], :5]
        sine2 = 1 - np.sum(unit * seen, axis=0) ** 2 / np.sum(seen**2, axis=0)
        expected = stats.norm.logpdf(measured, f, sd_frequency * measured).sum()
        expected -= np.sum(sine2) / (2 * sd_shape**2) + 5 * 1.5 * np.log(2 * np.pi * sd_shape**2)
        expected += stats.lognorm.logpdf(factors, 0.15).sum()
        expected += stats.lognorm.logpdf([sd_frequency, sd_shape], 0.4, scale=[0.01, 0.03]).sum()
        assert value == pytest.approx(expected, rel=1e-9)


def test_floors_tell_the_modes_apart(problem, by_shape, theta):
    """Eight modes are candidates for the five measured ones; by shape and by number are the same."""
    nominal = np.linalg.eigh(problem.model.structure.K(np.ones(10)).toarray())[1][[2, 5, 8, 9]]
    between = mac(nominal[:, :8], nominal[:, :5]) - np.eye(5, 8)
    assert between.max() < 0.4
    assert not isinstance(by_shape.model.pairing, RankPairing)
    assert_allclose(by_shape.log_prob(theta), problem.log_prob(theta), rtol=1e-12)


def test_by_shape_takes_one_solve_and_no_bit_depends_on_the_batch(problem, by_shape, theta, monkeypatch):
    value, gradient = by_shape.log_prob_and_grad(theta)
    assert_allclose(gradient, problem.log_prob_and_grad(theta)[1], rtol=1e-8, atol=1e-8)
    for i in range(3):
        assert by_shape.log_prob(theta[i]) == by_shape.log_prob(theta)[i]
        alone = by_shape.log_prob_and_grad(theta[i])
        assert alone[0] == value[i]
        np.testing.assert_array_equal(alone[1], gradient[i])
    solved, solve = [], ReducedBlock.modes
    monkeypatch.setattr(ReducedBlock, "modes", lambda *at: solved.append(len(at[1])) or solve(*at))
    by_shape.log_prob(theta)
    by_shape.log_prob_and_grad(theta)
    assert solved == [len(theta)] * 2


def test_the_model_that_serves_all_measurements_is_the_case(problem, theta):
    again = ten_storeys.problem(ten_storeys.structure(), problem.data)
    assert again.names == problem.names
    assert_allclose(again.log_prob(theta), problem.log_prob(theta), rtol=1e-12)
    assert_allclose(again.log_prob_and_grad(theta)[1], problem.log_prob_and_grad(theta)[1], rtol=1e-8, atol=1e-8)
