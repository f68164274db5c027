"""Weighed masses, centres of gravity and static displacements in the density, against closed forms."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation
from scipy.stats import norm

import fmu
from fmu.fem.modes.changes import changed_model
from fmu.fem.modes.separable import Geometry, RigidArm
from fmu.fem.modes.static import MassMoments, StaticDisplacement
from tests.gradients import assert_gradient, differences

EI, RHO_A, L, N = 2.0e4, 5.0, 2.0, 8


def chain(*errors, free=False):
    """Return two masses on two springs: frequencies tell k/m alone."""
    first, second = np.array([[1.0, 0], [0, 0]]), np.array([[1.0, -1], [-1, 1]])
    model = fmu.SeparableModel.from_terms(
        ["k1", "k2", "mu"],
        stiffness=[(second if free else first, "k1"), (second, "k2")],
        mass=[(np.eye(2), "mu")],
        dofs=[(0, "x"), (1, "x")],
    )
    data = fmu.ModalData([4.2, 10.8], sd_hz=[0.01, 0.02], numbers=(1, 2))
    parameters = [
        fmu.Parameter("k1", 5.7e7, 1e7, 1e8),
        fmu.Parameter("k2", 1.7e7, 5e6, 5e7),
        fmu.Parameter("mu", 16e3, 1e4, 3e4),
    ]
    return fmu.UpdatingProblem(model, data, parameters, pairing="index", error=list(errors) or "frequency")


def cantilever(errors, parameters=("E", "rho")):
    """Return a clamped beam of one modulus and one density, both as factors."""
    section = fmu.Section(A=1e-3, Iy=1e-6, Iz=1e-6, J=2e-6)
    line = np.stack([np.arange(N), np.arange(1, N + 1)], axis=1)
    nodes = np.column_stack([np.linspace(0.0, L, N + 1), np.zeros(N + 1), np.zeros(N + 1)])
    group = fmu.ElementGroup("beam", line, section, fmu.Material(E=EI / 1e-6, nu=0.3, rho=RHO_A / 1e-3), (0, 1, 0))
    frame = fmu.Frame(nodes, [group], {0: ("x", "y", "z", "rx", "ry", "rz")})
    model = frame.separable({"E": fmu.Factor([("E", "beam")]), "rho": fmu.Factor([("rho", "beam")])})
    data = fmu.ModalData([10.0], sd_hz=[0.1])
    uncertain = [fmu.Parameter(name, 1.0, 0.5, 2.0) for name in parameters]
    return fmu.UpdatingProblem.reduced(model, data, uncertain, pairing="index", error=errors)


STATIC = fmu.StaticErrors(force=(1, "x"), load=1e4, displacement=8e-4, sd=1e-5)
MASS = fmu.MassErrors(mass=32.5e3, sd=300.0)
THETA = np.array([[5e7, 2e7, 1.7e4], [4.2e7, 1.2e7, 1.5e4], [8.1e7, 4.1e7, 2.9e4]])


def test_their_densities_are_added_to_those_of_the_frequencies():
    plain, both = chain(), chain(MASS, STATIC)
    k1, k2, mu = THETA.T
    expected = norm.logpdf(32.5e3, 2.0 * mu, 300.0) + norm.logpdf(8e-4, 1e4 * (1 / k1 + 1 / k2), 1e-5)
    assert_allclose(both.log_prob(THETA) - plain.log_prob(THETA), expected, rtol=1e-9)
    assert_allclose(both.log_likelihood(THETA) - plain.log_likelihood(THETA), expected, rtol=1e-9)
    assert both.log_likelihood_terms(THETA).shape == (3, 4)
    assert [both.log_prob(one) for one in THETA] == both.log_prob(THETA).tolist()


def test_gradients_are_exact():
    problem = chain(MASS, STATIC)
    value, gradient = problem.log_prob_and_grad(THETA)
    assert_allclose(value, problem.log_prob(THETA), rtol=1e-12)
    step = 1e-6 * THETA[0]
    slopes = differences(problem.log_prob, THETA, step)
    assert_allclose(gradient * step, slopes * step, rtol=1e-6, atol=1e-7)
    value, slope, information = problem.likelihood.quadratic(THETA)
    assert_allclose(slope, gradient, rtol=1e-9)  # the priors are flat
    assert_allclose(value, problem.log_likelihood(THETA), rtol=1e-12)
    assert np.all(np.linalg.eigvalsh(information * np.outer(THETA[0], THETA[0])) > 0.0)


def test_a_tip_load_and_the_mass_of_a_beam():
    static = fmu.StaticErrors(force=(N, "z"), load=100.0, displacement=0.012, sd=1e-4, at=(N // 2, "z"))
    mass = fmu.MassErrors(mass=RHO_A * L, sd=0.1, centre=(L / 2, 0.0, 0.0), centre_sd=0.01)
    problem = cantilever([mass, static])
    theta = np.array([[0.9, 1.2], [1.7, 0.6]])
    a = L / 2
    terms = {label: term for term in problem.likelihood.quantities for label in term.labels}
    u = terms[f"displacement of {N // 2} z"].computed(theta)[0][:, 0]
    assert_allclose(u, 100.0 * a**2 * (3 * L - a) / (6.0 * EI * theta[:, 0]), rtol=1e-9)
    found = terms["mass"].computed(theta)[0]
    # a unit translation of all free nodes drags the first element with its shape function 3ξ² − 2ξ³ or ξ
    assert_allclose(found[:, 0] / theta[:, 1], found[0, 0] / theta[0, 1], rtol=1e-12)
    h = RHO_A * L / N
    assert RHO_A * L - h < found[0, 0] / theta[0, 1] < RHO_A * L
    assert_allclose(found[0], found[1] * [theta[0, 1] / theta[1, 1], 1, 1, 1], rtol=1e-12)
    assert L / 2 < found[0, 1] < L / 2 + L / N
    assert_allclose(found[0, 2:], 0.0, atol=1e-12)


def test_slopes_of_a_centre_of_gravity_that_two_densities_move_are_exact():
    section = fmu.Section(A=1e-3, Iy=1e-6, Iz=1e-6, J=2e-6)
    nodes = np.column_stack([np.linspace(0.0, L, N + 1), np.zeros(N + 1), np.zeros(N + 1)])
    line = np.stack([np.arange(N), np.arange(1, N + 1)], axis=1)
    material = fmu.Material(E=EI / 1e-6, nu=0.3, rho=RHO_A / 1e-3)
    groups = {"inner": line[: N // 2], "outer": line[N // 2 :]}
    frame = fmu.Frame(
        nodes,
        [fmu.ElementGroup(name, part, section, material, (0, 1, 0)) for name, part in groups.items()],
        {0: ("x", "y", "z", "rx", "ry", "rz")},
    )
    model = frame.separable({name: fmu.Factor([("rho", name)]) for name in groups})
    moments, theta = MassMoments(model, np.ones(2), with_centre=True), np.array([[0.9, 1.2], [1.7, 0.6]])
    values, slopes = moments(theta, gradient=True)
    assert abs(np.diff(values[:, 1])) > 0.1  # m
    assert_gradient(slopes, lambda x: moments(x)[0], theta, 1e-4, rtol=1e-6, atol=1e-7)


DOFS = ("x", "y", "z", "rx", "ry", "rz")


@pytest.mark.parametrize(
    ("free", "turned"),
    [(DOFS, False), (DOFS[1:], False), (DOFS, True)],
    ids=["free", "held along x", "local axes"],
)
def test_a_mass_on_a_rigid_arm_counts_at_its_place(free, turned):
    """A node at (1, 2, 3) has 3 kg, and 2 kg on an arm (0.5, 0.2, 1)."""
    x, y, z = 0.5, 0.2, 1.0
    arm = np.hstack([np.eye(3), [[0, z, -y], [-z, 0, x], [y, -x, 0]]])
    M = np.diag([3.0, 3.0, 3.0, 0.1, 0.1, 0.1]) + 2.0 * arm.T @ arm
    motions = {}
    if turned:
        Q = Rotation.from_rotvec([0.3, -0.7, 0.4]).as_matrix()
        T = np.kron(np.eye(2), Q)  # global motions are T times the local ones
        M = T.T @ M @ T
        of = {k: [(1, d) for d in DOFS[k : k + 3]] for k in (0, 3)}
        motions = {(1, d): dict(zip(of[i - i % 3], Q[i % 3], strict=True)) for i, d in enumerate(DOFS)}
    kept = [DOFS.index(d) for d in free]
    M = M[np.ix_(kept, kept)]
    model = fmu.SeparableModel.from_terms(
        ["k"],
        stiffness=[(np.eye(len(free)), "k")],
        mass=[M],
        dofs=[(1, d) for d in free],
        geometry=Geometry([[0.0, 0.0, 0.0], [1.0, 2.0, 3.0]], [[0, 1]]),
        motions=motions,
    )
    found = MassMoments(model, np.ones(1), with_centre=True)(np.ones((1, 1)))[0]
    assert_allclose(found, [[5.0, 1.2, 2.08, 3.4]], rtol=1e-14)


def test_a_mass_on_an_arm_of_a_free_frame_counts_at_its_place():
    """Without and with the mass, the total and its centre are sums over elements and points."""
    section = fmu.Section(A=1e-3, Iy=1e-6, Iz=1e-6, J=2e-6)
    nodes = np.array([[0, 0, 0], [1, 1, 0], [2, 2, 0], [3, 2, 1], [4, 2, 2]]) * 1.0
    line = np.array([[0, 1], [1, 2], [2, 3], [3, 4]])
    group = fmu.ElementGroup("beam", line, section, fmu.Material(E=2e11, nu=0.3, rho=7850.0), (0, 0.3, 1))
    frame = fmu.Frame(nodes, [group], {}, arms={"arm": RigidArm(3, (1.0, 0.2, -0.4))})
    model = frame.separable({"rho": fmu.Factor([("rho", "beam")])})
    masses = 7.85 * np.linalg.norm(nodes[line[:, 1]] - nodes[line[:, 0]], axis=1)
    bare = masses @ nodes[line].mean(axis=1)
    for added in (0.0, 5.0):
        given = changed_model(model, masses={"arm": added}) if added else model
        found = MassMoments(given, np.ones(1), with_centre=True)(np.ones((1, 1)))[0][0]
        centre = (bare + added * (nodes[3] + [1.0, 0.2, -0.4])) / (masses.sum() + added)
        assert_allclose(found, [masses.sum() + added, *centre], rtol=1e-12)


def chains():
    """Return two equal chains of 30 masses and 6 stiffnesses, with a spring k6 between their free ends."""
    n = 60
    stiffness = {f"k{j}": np.zeros((n, n)) for j in range(7)}

    springs = [(f"k{i % 6}", i, i - 1 if i % 30 else None) for i in range(n)]
    for name, i, j in [*springs, ("k6", 29, 59)]:
        row = np.zeros(n)
        row[i] = 1.0
        if j is not None:
            row[j] = -1.0
        stiffness[name] += np.outer(row, row)
    return fmu.SeparableModel.from_terms(
        list(stiffness),
        stiffness=[(K, name) for name, K in stiffness.items()],
        mass=[np.eye(n)],
        dofs=[(i, "x") for i in range(n)],
    )


def test_a_displacement_of_zero_at_one_point_is_checked_at_the_others():
    """Where the coupling vanishes, the load on one chain does not move the other."""
    rng, model, sizes = np.random.default_rng(1), chains(), []

    def points(n):
        theta = rng.uniform(0.2, 5.0, (n, 7))
        if not sizes:
            theta[3, 6] = 0.0  # of the points that check
        sizes.append(n)
        return theta

    found = StaticDisplacement(model, (20, "x"), 10.0, (50, "x"), points)
    assert 0.0 < found.error <= 1e-9
    theta = points(4)
    exact = [10.0 * np.linalg.inv(model.K(one).toarray())[50, 20] for one in theta]
    assert_allclose(found(theta)[0][:, 0], exact, rtol=1e-6)


def test_a_displacement_that_is_zero_by_symmetry():
    """Load and displacement are along different principal axes of K; what is left of it is rounding."""
    rng = np.random.default_rng(1)
    Q = np.linalg.qr(rng.standard_normal((24, 24)))[0]
    model = fmu.SeparableModel.from_terms(
        ["k0", "k1"],
        stiffness=[(Q[:, :12] @ Q[:, :12].T, "k0"), (Q[:, 12:] @ Q[:, 12:].T, "k1")],
        mass=[np.eye(24)],
        dofs=[(i, "x") for i in range(24)],
        motions={(f"axis {j}", "x"): {(i, "x"): Q[i, j] for i in range(24)} for j in (0, 23)},
    )
    found = StaticDisplacement(
        model, ("axis 0", "x"), 10.0, ("axis 23", "x"), lambda n: rng.uniform(0.2, 5.0, (n, 2))
    )
    assert found.error <= 1e-9
    assert np.max(np.abs(found(np.ones((1, 2)))[0])) < 1e-12


def test_k_and_m_are_separated_without_another_test():
    sds = []
    for problem in (chain(), chain(MASS, STATIC)):
        maxima = fmu.find_map(problem, starts=4)
        trace = fmu.sample(problem, draws=60, warmup=60, chains=2, seed=1, maxima=maxima)
        sds.append(fmu.summary(trace)["sd"])
    assert np.all(sds[0] / sds[1] > 10.0)


@pytest.mark.parametrize(("mass", "verdict"), [(32.5e3, "not contradicted"), (45e3, "contradicted")])
def test_the_verdict_on_the_model_counts_them(mass, verdict):
    problem = chain(fmu.MassErrors(mass=mass, sd=100.0), STATIC)
    trace = fmu.sample(problem, draws=100, warmup=60, seed=1, maxima=fmu.find_map(problem, starts=4))
    fit = fmu.diagnose(trace, problem).fit
    assert fit.verdict == verdict
    assert fit.n_data == 4
    assert {check.of for check in fit.checks if check.kind == "mass or displacement"} == {
        "mass",
        "displacement of 1 x",
    }


def test_what_cannot_be_is_refused():
    with pytest.raises(ValueError, match="the structure, or a part of it, is free to move"):
        chain(STATIC, free=True)
    with pytest.raises(ValueError, match=r"force: must be a place and a direction that are free to move \(got"):
        chain(fmu.StaticErrors(force=(5, "x"), load=1.0, displacement=1e-3, sd=1e-4))
    with pytest.raises(ValueError, match="centre: needs the coordinates of all nodes"):
        chain(fmu.MassErrors(mass=3e4, sd=1.0, centre=(0.0, 0.0, 0.0), centre_sd=0.1))
    with pytest.raises(ValueError, match=r"at_supports: must be at least 0 and less than the mass"):
        fmu.MassErrors(mass=1.0, sd=0.1, at_supports=2.0)
    with pytest.raises(ValueError, match=r"load: must be a finite number, not 0 \(got 0\.0\)"):
        fmu.StaticErrors(force=(1, "x"), load=0.0, displacement=1e-3, sd=1e-4)
    model = fmu.BlackBoxModel(lambda theta: np.array([1.0]), 1)
    with pytest.raises(ValueError, match="a mass or a displacement needs a SeparableModel"):
        fmu.UpdatingProblem(
            model, fmu.ModalData([1.0]), [fmu.Parameter("k", 1.0, 0.5, 2.0)], pairing="index", error=[MASS]
        )


def test_in_a_problem_file(tmp_path):
    (tmp_path / "chain.toml").write_text("""
name = "chain"

[model]
type = "matrices"
dofs = [["low", "x"], ["top", "x"]]
stiffness = [
  { matrix = [[1, 0], [0, 0]], powers = { k1 = 1 } },
  { matrix = [[1, -1], [-1, 1]], powers = { k2 = 1 } },
]
mass = [{ matrix = [[1, 0], [0, 1]], powers = { mu = 1 } }]

[measurement]
frequencies = [4.2, 10.8]
sd = [0.01, 0.02]

[[error]]
of = "mass"
mass = 32.5e3
sd = 300

[[error]]
of = "static"
force = ["top", "x"]
load = 1e4
displacement = 8e-4
sd = 1e-5

[[parameters]]
name = "k1"
start = 5.7e7
lower = 1e7
upper = 1e8

[[parameters]]
name = "k2"
start = 1.7e7
lower = 5e6
upper = 5e7

[[parameters]]
name = "mu"
start = 16e3
lower = 1e4
upper = 3e4
""")
    problem = fmu.load(tmp_path / "chain.toml", pairing="index")
    assert_allclose(problem.log_prob(THETA), chain(MASS, STATIC).log_prob(THETA), rtol=1e-9)
    assert "Measured besides, with Gaussian errors: mass 32500 ± 300 kg." in " ".join(
        str(fmu.check(problem)).split()
    )
