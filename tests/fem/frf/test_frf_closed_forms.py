"""Computed frequency response functions against closed forms and against a direct solve at every line."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import fmu
from fmu.fem.frf.general import GeneralResponses
from fmu.fem.frf.model import Damping, FRFModel
from fmu.fem.frf.proportional import ModalResponses, Source
from fmu.fem.frf.training import Lines
from fmu.fem.modes.terms import Term
from tests.gradients import assert_gradient

OMEGA = np.linspace(3.0, 280.0, 41)


def responses(structure, damping, theta, values, points, drives, omega=OMEGA):
    """Return the responses at theta (n, p) and damping parameters (n, q), on a basis of all degrees of freedom."""
    lines = Lines(omega, np.ones((len(points), len(omega))))
    box = theta.min(axis=0) * 0.9, theta.max(axis=0) * 1.1
    model = FRFModel(structure, points, drives, damping, theta[0], *box, values[0], lines)
    return model.at(theta, values)


@pytest.fixture(scope="module")
def five():
    """A structure of five degrees of freedom with full matrices, cubed and mass parameters."""
    rng = np.random.default_rng(0)
    definite = [(lambda a: a @ a.T + 5.0 * np.eye(5))(rng.standard_normal((5, 5))) for _ in range(5)]
    K, M = [1e4 * part for part in definite[:3]], definite[3:]
    terms = [Term(K[0], (1, 0, 0, 0)), Term(K[1], (0, 3, 0, 0)), Term(K[2], (0, 0, 1, 0))]
    structure = fmu.SeparableModel(terms, [Term(M[0], (0, 0, 0, 0)), Term(M[1], (0, 0, 0, 1))])
    return structure, rng.uniform(0.7, 1.3, (3, 4)), rng.uniform(0.005, 0.03, (3, 4)), K


POINTS = ((0, "x"), (2, "x"), (4, "x"), (2, "x"))
DRIVES = ((0, "x"), (0, "x"), (2, "x"), (4, "x"))
PROPORTIONAL = Damping(
    4, Source(0.0, 0), Source(1e-4), Source(0.0, 1), (Source(0.0, 2), Source(0.02), Source(0.0, 3))
)


def dashpot():
    row = np.zeros((1, 5))
    row[0, [0, 3]] = 20.0, -20.0
    return row.T @ row / 20.0


@pytest.fixture
def general():
    import scipy.sparse as sp

    matrix = sp.csr_array(dashpot())
    losses = {0: Source(0.0, 0), 1: Source(0.03)}
    return Damping(4, Source(0.0, 3), Source(1e-4), Source(0.0, 1), (), losses, ((matrix, Source(1.0, 2)),))


def inverse_at(stiffness, C, M, points=POINTS, drives=DRIVES):
    """Return the receptances by a direct solve at every line."""
    found = []
    for w in OMEGA:
        inverse = np.linalg.inv(stiffness + 1j * w * C - w**2 * M)
        found.append([inverse[j[0], k[0]] for j, k in zip(points, drives, strict=True)])
    return np.array(found).T


def test_one_mass_has_the_closed_form():
    k, m, zeta = 5.0e5, 20.0, 0.03
    structure = fmu.SeparableModel([Term([[k]], (1,))], [Term([[m]], (0,))])
    damping = Damping(1, ratios=(Source(0.0, 0),))
    own = responses(structure, damping, np.array([[1.2]]), np.array([[zeta]]), ((0, "x"),), ((0, "x"),))
    c = 2 * zeta * np.sqrt(1.2 * k * m)
    assert_allclose(own.frfs(OMEGA)[0, 0], 1 / (1.2 * k - OMEGA**2 * m + 1j * OMEGA * c), rtol=1e-12)


def test_proportional_damping_gives_the_direct_solution(five):
    structure, theta, values, _ = five
    found = responses(structure, PROPORTIONAL, theta, values, POINTS, DRIVES).frfs(OMEGA)
    for i in range(3):
        K, M = structure.K(theta[i]).toarray(), structure.M(theta[i]).toarray()
        import scipy.linalg as sl

        lam, phi = sl.eigh(K, M)
        zeta = np.array([values[i, 2], 0.02, *[values[i, 3]] * 3])
        C = M @ phi @ np.diag(2 * zeta * np.sqrt(lam)) @ phi.T @ M + values[i, 0] * M + 1e-4 * K
        expected = inverse_at(K * (1 + 1j * values[i, 1]), C, M)
        assert_allclose(found[i], expected, rtol=0, atol=1e-10 * np.abs(expected).max())


def test_general_damping_gives_the_direct_solution_to_1e_10(five, general):
    structure, theta, values, K = five
    found = responses(structure, general, theta, values, POINTS, DRIVES).frfs(OMEGA)
    for i in range(3):
        eta = values[i, 0], 0.03, values[i, 1]
        own = sum((1 + 1j * e) * t * k for e, t, k in zip(eta, theta[i, :3] ** [1, 3, 1], K, strict=True))
        M = structure.M(theta[i]).toarray()
        C = values[i, 2] * dashpot() + values[i, 3] * M + 1e-4 * structure.K(theta[i]).toarray()
        expected = inverse_at(own, C, M)
        assert_allclose(found[i], expected, rtol=0, atol=1e-10 * np.abs(expected).max())


@pytest.mark.parametrize("kind", ["proportional", "general"])
def test_slopes_are_those_of_differences_for_all_kinds_of_parameters(five, general, kind):
    structure, theta, values, _ = five
    damping = PROPORTIONAL if kind == "proportional" else general
    x = np.concatenate([theta, values], axis=1)

    def flat(points):
        found = responses(structure, damping, points[:, :4], points[:, 4:], POINTS, DRIVES).frfs(OMEGA)
        return np.concatenate([found.real, found.imag], axis=1).reshape(len(points), -1)

    own = responses(structure, damping, theta, values, POINTS, DRIVES)
    assert isinstance(own, ModalResponses if kind == "proportional" else GeneralResponses)
    J = own.slopes(OMEGA)
    J = np.concatenate([J.real, J.imag], axis=1).reshape(len(x), -1, 8)
    assert_gradient(J, flat, x, 2e-4 * x, order=6, of_largest=1e-7)


@pytest.mark.parametrize("kind", ["proportional", "general"])
def test_the_gradient_of_a_function_of_the_frfs_is_the_product_with_their_slopes(five, general, kind):
    structure, theta, values, _ = five
    damping = PROPORTIONAL if kind == "proportional" else general
    own, rng = responses(structure, damping, theta, values, POINTS, DRIVES), np.random.default_rng(1)
    J = own.slopes(OMEGA)
    w = rng.standard_normal(J.shape[:3]) + 1j * rng.standard_normal(J.shape[:3])
    for some in (slice(0, 17), slice(17, None)):  # in two blocks of lines
        own.frfs(OMEGA[some])
        own.add(w[:, :, some])
    expected = np.einsum("nfl,nflp->np", w, J).real
    found = np.concatenate(own.gradient(), axis=1)
    assert_allclose(found, expected, rtol=0, atol=1e-11 * np.abs(expected).max())


@pytest.mark.parametrize("apart", [0.0, 1e-9, 1e-5, 1e-3])
def test_slopes_stay_exact_where_frequencies_coincide(apart):
    K = [np.diag([1e4, 1e4, 0, 0]), np.diag([0, 0, 1e4, 1e4]), np.full((4, 4), 1e3)]
    terms = [Term(part, tuple(np.eye(3, dtype=int)[i])) for i, part in enumerate(K)]
    structure = fmu.SeparableModel(terms, [Term(np.eye(4), (0, 0, 0))])
    damping, theta, values = (
        Damping(1, ratios=(Source(0.0, 0),)),
        np.array([[1.0, 1.0 + apart, 1.0]]),
        np.array([[0.01]]),
    )
    points, drives = ((0, "x"), (1, "x"), (2, "x")), ((0, "x"), (0, "x"), (1, "x"))

    def flat(x):
        found = responses(structure, damping, x, np.tile(values, (len(x), 1)), points, drives).frfs(OMEGA)
        return np.concatenate([found.real, found.imag], axis=1).reshape(len(x), -1)

    own = responses(structure, damping, theta, values, points, drives)
    J = own.slopes(OMEGA)[..., :3]
    w = np.exp(1j * np.arange(J[..., 0].size)).reshape(J.shape[:3])
    own.frfs(OMEGA)
    own.add(w)
    expected = np.einsum("nfl,nflp->np", w, J).real
    assert_allclose(own.gradient()[0], expected, rtol=0, atol=1e-9 * np.abs(expected).max())
    flat_J = np.concatenate([J.real, J.imag], axis=1).reshape(1, -1, 3)
    assert_gradient(flat_J, flat, theta, 1e-3, order=6, of_largest=1e-6)


def test_poles_are_refused_where_the_stiffness_they_are_checked_at_is_singular():
    """The poles 0 and -10 of a free mass on a dashpot are checked at 0 rad/s."""
    assert GeneralResponses._solve(np.zeros((1, 1)) + 0j, np.full((1, 1), 10.0), np.eye(1)) is None


@pytest.mark.parametrize("massless", [False, True])
def test_a_damped_beam_on_a_reduced_basis_has_the_exact_series(massless):
    """Tip receptance of a cantilever with a loss factor, by the exact solution of Euler and Bernoulli."""
    n, length, EI, rho_A, eta = 60, 1.5, 3e4, 8.0, 0.02
    h = length / n
    k = EI / h**3 * np.array([[12, 6 * h, -12, 6 * h], [6 * h, 4 * h**2, -6 * h, 2 * h**2],
                              [-12, -6 * h, 12, -6 * h], [6 * h, 2 * h**2, -6 * h, 4 * h**2]])  # fmt: skip
    m = rho_A * h / 420 * np.array([
        [156, 22 * h, 54, -13 * h], [22 * h, 4 * h**2, 13 * h, -3 * h**2],
        [54, 13 * h, 156, -22 * h], [-13 * h, -3 * h**2, -22 * h, 4 * h**2],
    ])  # fmt: skip
    if massless:
        m = np.diag([rho_A * h / 2, 0.0, rho_A * h / 2, 0.0])
    K, M = np.zeros((2 * n + 2, 2 * n + 2)), np.zeros((2 * n + 2, 2 * n + 2))
    for e in range(n):
        here = slice(2 * e, 2 * e + 4)
        K[here, here] += k
        M[here, here] += m
    dofs = [(i, d) for i in range(1, n + 1) for d in ("z", "ry")]
    structure = fmu.SeparableModel([Term(K[2:, 2:], (1,))], [Term(M[2:, 2:], (0,))], dofs)
    tip, f = (n, "z"), np.linspace(2.0, 400.0, 200)
    lines = Lines(2 * np.pi * f, np.full((1, len(f)), 1e-9))
    damping = Damping(1, loss=Source(0.0, 0))
    model = FRFModel(
        structure, [tip], [tip], damping, np.ones(1), np.array([0.8]), np.array([1.2]), np.array([eta]), lines
    )
    assert model.block.size < 40
    assert model.is_confirmed
    theta = 1.1
    found = model.at(np.array([[theta]]), np.array([[eta]])).frfs(lines.omega)[0, 0]
    own = theta * EI * (1 + 1j * eta)
    wave = (rho_A * lines.omega**2 / own) ** 0.25
    x = wave * length
    exact = (np.sin(x) * np.cosh(x) - np.cos(x) * np.sinh(x)) / (own * wave**3 * (1 + np.cos(x) * np.cosh(x)))
    # lumped masses have the error of their coarser mass matrix, the consistent ones that of Hermite elements
    assert_allclose(found, exact, rtol=0, atol=(3e-2 if massless else 1e-5) * np.abs(exact).max())
