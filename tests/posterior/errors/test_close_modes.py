"""Gradients of every error model as two modes come close: exact down to where rounding allows.

K = 1000 N/m · Q [[θ₂ + θ₁, −c, 0], [−c, θ₂ − θ₁, 0], [0, 0, top]] Qᵀ and M = Q diag(1, θ₃, 1) Qᵀ kg with a fixed
orthogonal Q: at θ = (0.6 δ, 1, 1) with c = 0.8 δ the lower two frequencies are δ apart, relatively. Their closed
form in extended precision is the reference: five-point differences of it, with steps of 0.003 δ, are good to eight
digits even at δ = 10⁻⁸, where differences of the model itself drown in rounding.

Eigenvectors of a matrix rounded to ε are good to ε (λ_max/λ)/δ, and so is what is computed from them. Closer than
`REPEATED` (of the eigenvalues) a reduced block leaves out the rotation of the two shapes into each other.
"""

from functools import cache

import numpy as np
import pytest
from numpy.testing import assert_allclose

import fmu
from fmu.fem.pairing.paired_structure import PairedStructure
from fmu.fem.pairing.prediction import ModalPrediction
from fmu.fem.reduced.reduced_structure import train
from fmu.posterior.errors.frequency import BetaFrequencyErrors
from fmu.posterior.errors.likelihood import ModalLikelihood
from fmu.posterior.errors.residual import ModalResidual
from tests.gradients import differences

SENSORS = ((0, "x"), (1, "x"), (2, "x"))
Q = np.eye(3) - 2.0 / 9.0 * np.outer([1, 2, 2], [1, 2, 2])
PATHS = [pytest.param(True, id="reduced"), pytest.param(False, id="full")]
EPS = float(np.finfo(float).eps)
NOISE = fmu.Parameter("sigma", start=0.02, lower=1e-3, upper=1.0)
ERRORS = {
    "absolute": fmu.FrequencyErrors("absolute", sd=0.05),
    "relative": fmu.FrequencyErrors("relative", sd=NOISE),
    "eigenvalue": fmu.FrequencyErrors("eigenvalue", sd=0.02, weights=[1.0, 2.0]),
    "shapes": fmu.ShapeErrors(sd=[[0.1, 0.1], [0.2, 0.1], [0.1, 0.3]]),
    "shapes, inferred": fmu.ShapeErrors(sd=0.05, model_sd=NOISE),
    "MAC": fmu.MACErrors(sd=0.1),
}

pytestmark = pytest.mark.skipif(
    np.finfo(np.longdouble).eps > 1e-18, reason="the reference needs extended precision"
)


def point(gap):
    return np.array([0.6 * gap, 1.0, 1.0])


def closed_form(gap, theta):
    """Return frequencies (n, 2) and shapes (n, 3, 2) in extended precision, for theta (n, 3) in it."""
    a, b, m = np.asarray(theta, dtype=np.longdouble).T
    q = -1000 * np.longdouble(0.8 * gap) / np.sqrt(m)
    p = 500 * ((b + a) - (b - a) / m)
    middle, r = 500 * ((b + a) + (b - a) / m), np.hypot(p, q)
    alpha = np.arctan2(q, p) / 2
    above, below = np.stack([np.cos(alpha), np.sin(alpha)], 1), np.stack([-np.sin(alpha), np.cos(alpha)], 1)
    shapes = np.stack([below, above], axis=2) / np.stack([np.ones_like(m), np.sqrt(m)], axis=1)[:, :, None]
    frequencies = np.sqrt(np.stack([middle - r, middle + r], axis=1)) / (2 * np.longdouble(np.pi))
    return ModalPrediction(frequencies, Q[:, :2] @ shapes)


def measured(gap):
    """Both modes a little off: 0.3 % in frequency, and turned by 0.2 rad."""
    seen = closed_form(gap, point(gap)[None])
    turn = np.eye(3)
    turn[:2, :2] = [[np.cos(0.2), -np.sin(0.2)], [np.sin(0.2), np.cos(0.2)]]
    frequencies = seen.frequencies[0].astype(float) * [1.003, 0.997]
    return fmu.ModalData(
        frequencies, sensors=SENSORS, shapes=Q @ turn @ Q @ seen.shapes[0].astype(float), sd_hz=0.05
    )


def system(gap, top):
    c = 0.8 * gap
    link = np.array([[0.0, -c, 0.0], [-c, 0.0, 0.0], [0.0, 0.0, top]])
    K = [
        (np.diag([1.0, -1.0, 0.0]), (1.0, 0.0, 0.0)),
        (np.diag([1.0, 1.0, 0.0]), (0.0, 1.0, 0.0)),
        (link, (0.0,) * 3),
    ]
    M = [(np.diag([1.0, 0.0, 1.0]), (0.0, 0.0, 0.0)), (np.diag([0.0, 1.0, 0.0]), (0.0, 0.0, 1.0))]
    return fmu.SeparableModel(
        [fmu.Term(1e3 * Q @ matrix @ Q, powers) for matrix, powers in K],
        [fmu.Term(Q @ matrix @ Q, powers) for matrix, powers in M],
    )


@cache
def paired(gap, reduced, top=10.0):
    data = measured(gap)
    structure = PairedStructure.of(
        system(gap, top),
        pairing="shape",
        numbers=(1, 2),
        sensors=SENSORS,
        reference=point(gap),
        shapes=np.asarray(data.shapes),
    )
    if reduced:
        return train(structure, point(gap) - 0.3 * gap, point(gap) + 0.3 * gap)[0], data
    return structure, data


def gradients(name, gap, reduced, top=10.0):
    """Return the gradient by the model, and that of the closed form."""
    structure, data = paired(gap, reduced, top)
    theta = point(gap)
    if name == "plain":
        likelihood = ModalLikelihood(structure, data, [BetaFrequencyErrors()])

        def log_likelihood(theta):
            return likelihood.error.log_prob_terms(closed_form(gap, theta).frequencies).sum(axis=1)
    else:
        likelihood = ModalLikelihood(structure, data, [ERRORS[name]])
        theta = np.concatenate([theta, [p.start for p in likelihood.noise]])

        def log_likelihood(theta):
            return likelihood.terms_of_observed(closed_form(gap, theta[:, :3]), theta).sum(axis=1)

    own = likelihood.terms_and_gradient(theta[None])[1][0].sum(axis=0)
    step = np.where(np.arange(len(theta)) < 3, 0.003 * gap, 1e-4)
    theta, step = (one.astype(np.longdouble) for one in (theta, step))
    return own, differences(log_likelihood, theta[None], step, order=4)[0].astype(float)


def misfit(own, reference):
    """Return the largest error of a component, relative to the largest component."""
    return np.max(np.abs(own - reference)) / np.max(np.abs(reference))


@pytest.mark.parametrize("name", ["plain", *ERRORS])
@pytest.mark.parametrize("reduced", PATHS)
@pytest.mark.parametrize("gap", [1e-1, 1e-2, 1e-3, 1e-4])
def test_gradient_where_modes_are_apart(name, reduced, gap):
    own, reference = gradients(name, gap, reduced)
    assert_allclose(own, reference, rtol=1e-6, atol=1e-9 * np.max(np.abs(reference)))


@pytest.mark.parametrize("name", ["plain", *ERRORS])
@pytest.mark.parametrize("reduced", PATHS)
def test_gradient_where_modes_are_closer(name, reduced):
    """No worse than the shapes themselves: rounding over the gap."""
    for gap in (1e-5, 1e-6, 1e-7, 1e-8):
        own, reference = gradients(name, gap, reduced)
        assert misfit(own, reference) < max(1e-8, 3.0 * EPS * 10.0 / gap), gap


@pytest.mark.parametrize("name", ["plain", "relative", "shapes", "MAC"])
@pytest.mark.parametrize("reduced", PATHS)
def test_what_a_stiff_structure_costs(name, reduced):
    """Its highest eigenvalue, 10⁶ times those of the close modes, is what rounding is relative to."""
    for gap in (1e-1, 1e-3, 1e-4, 1e-6, 1e-8):
        own, reference = gradients(name, gap, reduced, top=1e6)
        assert misfit(own, reference) < max(1e-6, 3.0 * EPS * 1e6 / gap), gap


@pytest.mark.parametrize("reduced", PATHS)
def test_slopes_of_shapes_grow_as_the_gap_closes(reduced):
    """By the inverse of the gap: modes truly turn into each other the faster the closer they are."""
    slope = [np.abs(paired(gap, reduced)[0].observed(point(gap)[None], True).shape_slopes[0]).max() * gap
             for gap in (1e-2, 1e-4, 1e-6, 1e-8)]  # fmt: skip
    assert_allclose(slope, slope[0], rtol=0.02)


def test_a_reduced_block_leaves_out_the_rotation_of_modes_as_good_as_repeated():
    structure, _ = paired(1e-10, reduced=True)
    seen = structure.observed(point(1e-10)[None], True)
    h = 1e-12
    f = closed_form(1e-10, point(1e-10) + h * np.array([[1.0, 0, 0], [-1.0, 0, 0]])).frequencies
    assert_allclose(seen.frequency_slopes[0, :, 0], (f[0] - f[1]) / (2 * h), rtol=1e-3)
    assert np.abs(seen.shape_slopes).max() < 1.0  # with the rotation, 10¹⁰


def test_modes_repeated_to_the_last_bit():
    """Their shapes are any two of their plane: a reduced block gives small slopes, the full model useless ones."""
    model = system(0.0, 10.0)
    structure = PairedStructure.of(
        model, pairing="shape", numbers=(1, 2), sensors=SENSORS, reference=point(0.0), shapes=Q[:, :2]
    )
    full = structure.observed(point(0.0)[None], True)
    assert not np.all(np.abs(full.shape_slopes) < 1e6)  # or NaN
    trained, _ = train(structure, point(0.0) - 1e-3, point(0.0) + 1e-3)
    reduced = trained.observed(point(0.0)[None], True)
    assert np.abs(reduced.shape_slopes).max() < 1.0
    assert_allclose(reduced.frequencies, full.frequencies, rtol=1e-9)
    # the sum of both is what does not depend on the choice
    assert_allclose(reduced.frequency_slopes[0].sum(axis=0), [0.0, 5.0329, -2.5165], atol=2e-4)


def test_the_modal_residual_knows_no_modes_of_the_model():
    """It solves no eigenproblem: close modes are nothing special to it, nor are repeated ones."""
    for gap in (1e-1, 1e-4, 1e-8, 0.0):
        residual = ModalResidual(system(gap, 10.0), measured(gap), point(gap))
        own = residual.terms_and_gradient(point(gap)[None])[1][0].sum(axis=0)
        terms = lambda theta, of=residual: of.terms(theta).sum(axis=1)  # noqa: E731
        (reference,) = differences(terms, point(gap)[None], 1e-3, order=4)
        assert misfit(own, reference) < 1e-6, gap
