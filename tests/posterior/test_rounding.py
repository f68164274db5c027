"""Rounding in the matrices: no word, a warning and a refusal, against frequencies with sixty digits."""

import warnings
from decimal import Decimal, localcontext
from functools import partial

import numpy as np
import pytest
from numpy.testing import assert_allclose

import fmu
from fmu.fem.frame.components import DIRECTIONS, ElementGroup, JointSpring, Material, Section
from fmu.fem.frame.frame import Frame
from fmu.fem.modes.eigensolver import eigen
from fmu.fem.modes.separable import SeparableModel
from fmu.posterior import rounding as module
from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.parameters import Parameter
from fmu.posterior.problem import UpdatingProblem
from fmu.posterior.reduction.train_reduced import ReductionWarning
from fmu.posterior.rounding import RoundingWarning, rounding
from tests.models.extended_precision import HAS_DIGITS, elastic_modes, long_sum

LONG_DOUBLE = pytest.mark.skipif(not HAS_DIGITS, reason="numpy.longdouble has no more digits than float here")
N, SOFT, MASS = 6, 1e5, 10.0


def springs(stiff, theta):
    """Return the springs of a chain from the ground, N/m: the first is uncertain, the third is all but rigid."""
    return [theta, SOFT, stiff, SOFT, SOFT, SOFT]


def chain(stiff):
    K = np.zeros((N, N))
    for i, k in enumerate(springs(stiff, 0.0)[1:]):
        K[i : i + 2, i : i + 2] += np.array([[k, -k], [-k, k]])
    first = np.zeros((N, N))
    first[0, 0] = 1.0
    return SeparableModel.from_terms(["k"], [K, (first, "k")], [MASS * np.eye(N)])


def exact_hz(stiff, theta, number):
    """Return a frequency of the chain by bisection with Sturm's sequence of its tridiagonal matrix, 60 digits."""
    with localcontext() as context:
        context.prec = 60
        k = [Decimal(x) for x in springs(stiff, theta)]

        def below(lam):
            count, pivot = 0, None
            for i in range(N):
                diagonal = k[i] + (k[i + 1] if i + 1 < N else 0) - lam * Decimal(MASS)
                pivot = diagonal if pivot is None else diagonal - k[i] ** 2 / pivot
                count += pivot < 0
            return count

        low, high = Decimal(0), Decimal(4.0123 * SOFT / MASS)  # no pivot is ever zero
        for _ in range(80):
            middle = (low + high) / 2
            low, high = (low, middle) if below(middle) >= number else (middle, high)
        return float(low.sqrt()) / (2 * np.pi)


def posed(stiff, error, reduction=False):
    measured = np.array([exact_hz(stiff, SOFT, number) for number in (1, 2)])
    return UpdatingProblem.reduced(
        chain(stiff),
        ModalData(measured),
        [Parameter("k", SOFT, 0.5 * SOFT, 2 * SOFT)],
        beta=0.5 / (error * measured) ** 2,
        pairing="index",
        reduction=reduction,
    )


def sd_ratio(problem, stiff, error):
    """Return the posterior's sd over that of the exact model, both by quadrature on one grid."""
    slopes = [
        (exact_hz(stiff, SOFT * 1.001, j) - exact_hz(stiff, SOFT * 0.999, j)) / (0.002 * SOFT) for j in (1, 2)
    ]
    measured = np.array([exact_hz(stiff, SOFT, j) for j in (1, 2)])
    sd = 1.0 / np.sqrt(np.sum((np.array(slopes) / (error * measured)) ** 2))
    theta = SOFT + sd * np.linspace(-5, 5, 61)
    exact = np.array([[exact_hz(stiff, x, j) for j in (1, 2)] for x in theta])
    true = -0.5 * np.sum(((exact - measured) / (error * measured)) ** 2, axis=1)

    def spread(log_prob):
        weight = np.exp(log_prob - log_prob.max())
        weight /= weight.sum()
        mean = weight @ theta
        return mean, np.sqrt(weight @ (theta - mean) ** 2)

    (mean, found), (true_mean, expected) = spread(problem.log_prob(theta[:, None])), spread(true)
    return found / expected, (mean - true_mean) / expected


@pytest.mark.parametrize("reduction", [False, True])
def test_a_spring_that_grows_no_word_then_a_warning_then_a_refusal(tmp_path, monkeypatch, reduction):
    monkeypatch.setenv("FMU_CACHE_DIR", str(tmp_path))
    said = {}
    for exponent in (8, 15, 16, 18) if reduction else range(8, 19):  # training takes its time
        stiff = 10.0**exponent
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            try:
                problem = posed(stiff, 1e-3, reduction)
            except ValueError as error:
                said[exponent] = "refused" if str(error).startswith("rounding: the frequency of mode ") else error
                continue
        kinds = {w.category for w in caught}
        assert len(caught) == len(kinds)  # each is said once
        # a reduced model promises more than the errors need, and says first that it cannot keep it
        assert kinds <= ({RoundingWarning, ReductionWarning} if reduction else {RoundingWarning})
        said[exponent] = "warned" if RoundingWarning in kinds else "silent"
        if said[exponent] == "silent" and exponent in (8, 12, 15):
            ratio, shift = sd_ratio(problem, stiff, 1e-3)
            assert ratio == pytest.approx(1.0, abs=0.02)
            assert abs(shift) < 0.05
    words = [said[exponent] for exponent in sorted(said)]
    assert words == sorted(words, key=["silent", "warned", "refused"].index)
    assert (said[15], said[16], said[18]) == ("silent", "warned", "refused")


def test_what_is_expected_bounds_the_error_and_is_of_its_size(monkeypatch):
    """Over ten decades; the error itself is a matter of luck, so that it is taken over a few values of theta."""
    monkeypatch.setattr(module, "REFUSE", np.inf)
    monkeypatch.setattr(module, "WARN", np.inf)
    for exponent in (9, 12, 15, 18):
        stiff = 10.0**exponent
        problem = posed(stiff, 1e-2)
        theta = SOFT * (1.0 + 1e-3 * np.random.default_rng(1).standard_normal(8))
        exact = np.array([[exact_hz(stiff, x, j) for j in (1, 2)] for x in theta])
        error = np.max(np.abs(problem.frequencies(theta[:, None]) / exact - 1.0))
        expected = rounding(problem).relative.max()
        assert 1e-3 * expected < error < 2.0 * expected


def test_a_larger_error_of_measurement_needs_fewer_digits():
    with pytest.warns(RoundingWarning, match=r"stiffness at node [12] x is 1e16"):
        posed(1e16, 1e-3)
    posed(1e16, 1e-1)  # a warning would be an error
    with pytest.raises(ValueError, match=r"^rounding: "):
        posed(1e16, 1e-6)


def test_inferred_errors_count_as_they_start():
    errors = [fmu.FrequencyErrors("relative", Parameter("s", 1e-3, 1e-6, 1.0))]
    measured = [exact_hz(1e16, SOFT, number) for number in (1, 2)]
    parameters = [Parameter("k", SOFT, 0.5 * SOFT, 2 * SOFT)]
    with pytest.warns(RoundingWarning):
        problem = UpdatingProblem(chain(1e16), ModalData(measured), parameters, error=errors, pairing="index")
    with pytest.warns(RoundingWarning):
        same = posed(1e16, 1e-3)
    assert_allclose(rounding(problem).of_sd, rounding(same).of_sd, rtol=1e-3)


def test_check_says_it_too():
    with pytest.warns(RoundingWarning):
        problem = posed(1e16, 1e-3)
    found = fmu.check(problem, draws=4)
    assert any(doubt.startswith("rounding: ") for doubt in found.doubts)
    assert not any(doubt.startswith("rounding: ") for doubt in fmu.check(posed(1e10, 1e-3), draws=4).doubts)


@pytest.mark.parametrize("modulus", [1e11, 1e17, 1e19, 1e25, 1e40, 1e59])
def test_a_rod_on_a_rotational_spring(modulus):
    """It swings, ω² = 3 k/(ρA L³), however stiff it is: until nothing is left of the spring in the matrix."""
    n, length, area, rho, k = 4, 2.0, 1e-3, 7850.0, 1e5
    elements = np.stack([np.arange(n), np.arange(1, n + 1)], axis=1)
    section, material = Section(area, 1e-6, 1e-6, 1e-6), Material(modulus, 0.3, rho)
    nodes = np.linspace(0.0, length, n + 1)[:, None] * [1.0, 0.0, 0.0]
    spring = JointSpring("root", (0, None), {"ry": 1.0})
    frame = Frame(
        nodes,
        [ElementGroup("rod", elements, section, material)],
        {0: ("x", "y", "z", "rx", "rz")},
        springs=[spring],
    )
    swing = np.sqrt(3.0 * k / (rho * area * length**3)) / (2.0 * np.pi)
    posed = partial(
        UpdatingProblem,
        frame.separable({"k": [("stiffness", "root")]}),
        ModalData([swing], sensors=((n, "z"),)),
        [Parameter("k", k, 0.5 * k, 2.0 * k)],
        beta=0.5 / (0.01 * swing) ** 2,
    )
    if modulus <= 1e17:
        assert posed().frequencies([k])[0] == pytest.approx(swing, rel=0.2 if modulus < 1e12 else 1e-3)
        return
    with pytest.raises(ValueError, match=r"^rounding: "):
        posed()


def halves(decades, n, supports, along=(1.0, 0.0, 0.0)):
    """Return a beam of n elements whose first half is softer, and its moduli."""
    elements = np.stack([np.arange(n), np.arange(1, n + 1)], axis=1)
    moduli = {"root": 2.1e11 * 10.0**-decades, "rest": 2.1e11}
    section = Section(A=3e-3, Iy=4e-6, Iz=9e-6, J=7e-6)
    groups = [
        ElementGroup(name, part, section, Material(E, 0.3, 7850.0))
        for (name, E), part in zip(moduli.items(), np.split(elements, 2), strict=True)
    ]
    frame = Frame(np.linspace(0.0, 1.0, n + 1)[:, None] * along, groups, supports)
    return frame.separable({name: [("E", name)] for name in moduli}), np.array(list(moduli.values()))


def soft_root(decades, n):
    """Return a cantilever of n elements with a softer half at its root, its moduli, and λ of three modes."""
    model, theta = halves(decades, n, {0: DIRECTIONS})
    K, M = (long_sum(terms, theta) for terms in (model.K_terms, model.M_terms))
    return model, theta, elastic_modes(K, M, 3)[0].astype(float)


@LONG_DOUBLE
@pytest.mark.parametrize("decades", [8.0, 8.5, 9.0])
def test_a_soft_root_is_no_hinge_while_digits_are_left(decades):
    """At a unit diagonal the lowest eigenvalue of K is 4e-14 to 4e-15, some of it rounding."""
    model, theta, exact = soft_root(decades, 20)
    found, _ = eigen(model.K(theta), model.M(theta), 3)
    assert_allclose(found, exact, rtol=0.1)


@pytest.mark.parametrize("decades", [12, 14])
def test_a_term_that_is_negative_by_rounding_alone_is_not_called_negative(decades):
    """Free in space, so that rigid-body motions are taken out; of the soft half nothing is left."""
    model, theta = halves(decades, 60, {}, (1.0, 0.3, 0.2))
    parameters = [Parameter(name, E, 0.5 * E, 2.0 * E) for name, E in zip(("root", "rest"), theta, strict=True)]
    with pytest.raises(ValueError, match=r"^rounding: .*soft part is lost in rounding"):
        UpdatingProblem(model, ModalData([1e-4, 2e-4, 3e-4], sd_hz=1e-6), parameters, pairing="index")


@LONG_DOUBLE
@pytest.mark.parametrize("decades", [4, 6, 8, 10])
def test_a_soft_root_is_computed_or_refused_never_taken_for_a_hinge(decades):
    """The rest of the cantilever moves on it nearly as a rigid body; its modes are soft, not without strain."""
    model, theta, lam = soft_root(decades, 60)
    exact = np.sqrt(lam) / (2 * np.pi)
    parameters = [Parameter(name, E, 0.5 * E, 2.0 * E) for name, E in zip(("root", "rest"), theta, strict=True)]
    data = ModalData(exact, sd_hz=5e-3 * exact)
    if decades > 6:
        with pytest.raises(ValueError, match=r"^rounding: .*soft part is lost in rounding"):
            UpdatingProblem(model, data, parameters, pairing="index")
        return
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        problem = UpdatingProblem(model, data, parameters, pairing="index")
    assert [w.category for w in caught] == ([RoundingWarning] if decades == 6 else [])
    error = np.abs(problem.frequencies(theta[None])[0] / exact - 1.0)
    assert np.all(error <= 4.0 * rounding(problem).relative)
