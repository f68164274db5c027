"""Models that openseespy builds: their matrices, modes and dependence on theta, against fmu's own frame."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import fmu
from fmu.fem.modes.eigensolver import eigen
from fmu.fem.programs.opensees import export_matrices

ops = pytest.importorskip("openseespy.opensees", reason="needs openseespy: pip install 'fmu[opensees]'")

N, SPAN, HEIGHT = 4, 4.0, 3.0
A, IY, IZ, J, NU, RHO = 5e-3, 1e-5, 2e-5, 1e-6, 0.3, 7850.0
START, LOWER, UPPER = np.array([2.1e11, 2.0e11]), np.array([1.5e11, 1.5e11]), np.array([2.7e11, 2.5e11])


def places():
    left = [(0.0, 0.0, HEIGHT * i / N) for i in range(N + 1)]
    beam = [(SPAN * i / N, 0.0, HEIGHT) for i in range(1, N + 1)]
    return left + beam + [(SPAN, 0.0, HEIGHT * (1.0 - i / N)) for i in range(1, N + 1)]


def portal(theta):
    """Make a portal frame of Euler–Bernoulli beams: theta has the moduli of legs and beam."""
    ops.model("basic", "-ndm", 3, "-ndf", 6)
    nodes = places()
    for i, place in enumerate(nodes, 1):
        ops.node(i, *place)
    for foot in (1, len(nodes)):
        ops.fix(foot, 1, 1, 1, 1, 1, 1)
    ops.geomTransf("Linear", 1, 0.0, 1.0, 0.0)
    for i in range(1, len(nodes)):
        E = theta[1] if N < i <= 2 * N else theta[0]
        G = E / (2.0 * (1.0 + NU))
        mass = ("-mass", RHO * A, "-cMass")
        # local y is along z × x = across the frame's plane, where vecxz is the global y axis
        ops.element("elasticBeamColumn", i, i, i + 1, A, E, G, J, IZ, IY, 1, *mass)


def spring(theta):
    """Make a bar on a spring, whose length is the parameter: its stiffness E A / length is a power of it."""
    ops.model("basic", "-ndm", 1, "-ndf", 1)
    ops.node(1, 0.0)
    ops.node(2, 1.0, "-mass", 2.0)
    ops.fix(1, 1)
    ops.uniaxialMaterial("Elastic", 1, float(np.exp(theta[0])))
    ops.element("Truss", 1, 1, 2, 1.0, 1)


def plane(theta):
    """Make the portal in its plane: theta has the moduli of legs and beam."""
    ops.model("basic", "-ndm", 2, "-ndf", 3)
    nodes = places()
    for i, (x, _, z) in enumerate(nodes, 1):
        ops.node(i, x, z)
    for foot in (1, len(nodes)):
        ops.fix(foot, 1, 1, 1)
    ops.geomTransf("Linear", 1)
    for i in range(1, len(nodes)):
        E = theta[1] if N < i <= 2 * N else theta[0]
        ops.element("elasticBeamColumn", i, i, i + 1, A, E, IZ, 1, "-mass", RHO * A, "-cMass")


def own_plane():
    """Return fmu's frame in the x–z plane, without rotary inertia, which OpenSees neglects."""
    nodes = np.array(places())
    line = np.stack([np.arange(3 * N), np.arange(1, 3 * N + 1)], axis=1)
    section = fmu.Section(A=A, Iy=IZ, Iz=IZ, J=J)
    groups = [
        fmu.ElementGroup(name, line[part], section, fmu.Material(E=1.0, nu=NU, rho=RHO), (0.0, 1.0, 0.0))
        for name, part in (("left", slice(0, N)), ("beam", slice(N, 2 * N)), ("right", slice(2 * N, None)))
    ]
    supports = dict.fromkeys(range(1, len(nodes) - 1), ("y", "rx", "rz"))
    supports |= dict.fromkeys((0, len(nodes) - 1), ("x", "y", "z", "rx", "ry", "rz"))
    every = [("A", name) for name in ("left", "beam", "right")]
    targets = {"legs": [("E", "left"), ("E", "right")], "beam": [("E", "beam")], "area": every}
    frame = fmu.Frame(nodes, groups, supports).separable(targets)
    return fmu.SeparableModel(frame.K_terms, [term for term in frame.M_terms if term.powers[2]], frame.dofs)


def hz(model, theta, count=8):
    eigenvalues = np.linalg.eigvals(np.linalg.solve(model.mass.toarray(), model.stiffness.toarray()))
    return np.sort(np.sqrt(eigenvalues.real))[:count] / (2.0 * np.pi)


def parameters(*names):
    return [fmu.Parameter(*row) for row in zip(names, START, LOWER, UPPER, strict=False)]


def test_frequencies_are_those_of_the_same_frame_in_fmu():
    model = fmu.from_opensees(plane, ["a", "b"], START, LOWER, UPPER)
    data = fmu.ModalData(np.ones(8))
    there = fmu.UpdatingProblem(model, data, parameters("a", "b"), beta=1.0, pairing="index")
    own = [*parameters("legs", "beam"), fmu.Parameter("area", A, 0.5 * A, 2.0 * A)]
    here = fmu.UpdatingProblem(own_plane(), data, own, beta=1.0, pairing="index")
    theta = np.random.default_rng(1).uniform(LOWER, UPPER, (5, 2))
    expected = here.frequencies(np.column_stack([theta, np.full(5, A)]))
    assert_allclose(there.frequencies(theta), expected, rtol=1e-10)
    assert [term.powers for term in model.M_terms] == [(0, 0)]
    assert sorted(term.powers for term in model.K_terms) == [(0, 1), (1, 0)]
    assert model.geometry is not None
    assert len(model.geometry.elements) == 3 * N


def test_frequencies_are_those_that_opensees_computes():
    theta = np.array([1.9e11, 2.3e11])
    model = export_matrices(portal, theta)
    ops.wipe()
    portal(theta)
    there = np.sqrt(ops.eigen("-genBandArpack", 6)) / (2.0 * np.pi)
    ops.wipe()
    assert_allclose(hz(model, theta, 6), there, rtol=1e-8)


def test_names_of_degrees_of_freedom_and_the_mesh():
    model = export_matrices(portal, START)
    assert len(model.dofs) == 6 * (3 * N - 1) == model.stiffness.shape[0]
    assert model.dofs[:7] == (*((2, d) for d in ("x", "y", "z", "rx", "ry", "rz")), (3, "x"))
    assert set(model.kinds) == {"line"}
    assert_allclose(model.coordinates[model.nodes.tolist().index(N + 1)], [0.0, 0.0, HEIGHT])
    load = np.zeros(len(model.dofs))
    load[model.dofs.index((N + 1, "y"))] = 1.0
    moved = np.linalg.solve(model.stiffness.toarray(), load)
    assert np.argmax(np.abs(moved)) in [i for i, (_, d) in enumerate(model.dofs) if d in ("y", "rx")]


def test_solved_at_every_theta():
    sensors = tuple((node, d) for node in (3, N + 1, 7, 2 * N + 1, 10) for d in ("x", "-y", "z"))
    terms = fmu.from_opensees(portal, ["a", "b"], START, LOWER, UPPER)
    model = fmu.OpenSeesModel(portal, START, modes=6)
    assert model.sees((N + 1, "x"))
    assert not model.sees((1, "x"))
    answer = model.at_sensors(sensors).at(START)
    assert_allclose(answer.frequencies, hz(export_matrices(portal, START), START, 6), rtol=1e-8)
    observed = fmu.ModalData(np.ones(3), sensors=sensors, shapes=answer.shapes[:, [2, 0, 1]])
    by_terms, anew = (
        fmu.UpdatingProblem(one, observed, parameters("a", "b"), beta=1.0, pairing="shape")
        for one in (terms, model)
    )
    theta = np.random.default_rng(2).uniform(LOWER, UPPER, (3, 2))
    assert_allclose(anew.frequencies(theta), by_terms.frequencies(theta), rtol=1e-8)
    assert_allclose(anew.log_prob_and_grad(theta)[1], by_terms.log_prob_and_grad(theta)[1], rtol=1e-5)


def test_a_model_of_another_kind_of_dependence_is_refused_with_its_entries():
    with pytest.raises(ValueError, match=r"what s changes of the stiffness must be .* node 2 x by"):
        fmu.from_opensees(spring, ["s"], [1.0], [0.5], [3.0])
    model = fmu.OpenSeesModel(spring, [1.0])
    assert_allclose(model.at([1.0]).frequencies, np.sqrt(np.e / 2.0) / (2.0 * np.pi), rtol=1e-12)


def test_no_more_modes_are_asked_for_than_have_mass():
    """The default is 20 modes: of 12 degrees of freedom, four rotations have no mass."""

    def lumped(theta):
        ops.model("basic", "-ndm", 2, "-ndf", 3)
        for i in range(5):
            ops.node(i, float(i), 0.0, "-mass", 3.0, 3.0, 0.0)
        ops.fix(0, 1, 1, 1)
        ops.geomTransf("Linear", 1)
        for i in range(4):
            ops.element("elasticBeamColumn", i + 1, i, i + 1, A, float(theta[0]), IZ, 1)

    found, there = fmu.OpenSeesModel(lumped, START[:1]).at(START[:1]), export_matrices(lumped, START[:1])
    inverse = np.linalg.eigvals(np.linalg.solve(there.stiffness.toarray(), there.mass.toarray())).real
    assert_allclose(found.frequencies, 1.0 / np.sqrt(np.sort(inverse)[:3:-1]) / (2.0 * np.pi), rtol=1e-8)


def tied_portal(theta):
    portal([theta[0], theta[0]])
    ops.equalDOF(N + 1, 2 * N + 1, 1)


CORNERS = {11: (0.0, 0.0), 12: (6.0, 0.0), 13: (6.0, 5.0), 14: (0.0, 5.0)}
DIRECTIONS = ["x", "y", "z", "rx", "ry", "rz"]
CENTRE = np.array([3.5, 2.0])


def tower(theta, fixed=True, centre=CENTRE):
    """Make a storey of four columns under a rigid diaphragm, whose centre of mass is off its middle."""
    ops.model("basic", "-ndm", 3, "-ndf", 6)
    for tag, (x, y) in CORNERS.items():
        ops.node(tag - 10, x, y, 0.0)
        ops.node(tag, x, y, 3.0)
        if fixed:
            ops.fix(tag - 10, 1, 1, 1, 1, 1, 1)
    ops.node(20, *centre.tolist(), 3.0)
    ops.fix(20, 0, 0, 1, 1, 1, 0)
    ops.mass(20, 1e4, 1e4, 0.0, 0.0, 0.0, 2e5)
    ops.geomTransf("Linear", 1, 1.0, 0.0, 0.0)
    ops.geomTransf("Linear", 2, 0.0, 0.0, 1.0)
    lines = [(tag - 10, tag, 1) for tag in CORNERS] + [(11, 12, 2), (12, 13, 2), (13, 14, 2), (14, 11, 2)]
    for k, (i, j, axes) in enumerate(lines, 1):
        section = (0.09, float(theta[0]), 1.2e10, 1e-3, 7e-4, 6e-4)
        ops.element("elasticBeamColumn", k, i, j, *section, axes, "-mass", 200.0, "-cMass")
    ops.rigidDiaphragm(3, 20, *CORNERS)


def test_motions_of_a_rigid_diaphragm():
    model = export_matrices(tower, np.array([3e10]))
    assert not model.notes
    for tag, place in CORNERS.items():
        dx, dy = np.array(place) - CENTRE
        expected = {"x": {"x": 1.0, "rz": -dy}, "y": {"y": 1.0, "rz": dx}, "rz": {"rz": 1.0}}
        for direction, weights in expected.items():
            got = model.motions[tag, direction]
            assert got.keys() == {(20, d) for d in weights}
            assert_allclose([got[20, d] for d in weights], list(weights.values()), rtol=1e-8)


@pytest.mark.parametrize("build", [tower, tied_portal, lambda theta: tower(theta, fixed=False)])
def test_shapes_at_followers_are_those_that_opensees_gives(build):
    theta = np.array([3e10])
    found = export_matrices(build, theta)
    model = fmu.SeparableModel([fmu.Term(found.stiffness, ())], [fmu.Term(found.mass, ())], found.dofs,
                               motions=found.motions)  # fmt: skip
    assert not found.notes
    eigenvalues, phi = eigen(found.stiffness, found.mass, 9)
    ops.wipe()
    build(theta)
    there = np.array(ops.eigen("-fullGenLapack", 9))
    sensors = list(found.motions)
    seen = np.array([[ops.nodeEigenvector(n, k + 1)[DIRECTIONS.index(d)] for k in range(9)]
                     for n, d in sensors])  # fmt: skip
    ops.wipe()
    ours = model.observation(sensors) @ phi
    size = np.linalg.norm(ours, axis=0), np.linalg.norm(seen, axis=0)
    compared = (there > 1e-6 * there.max()) & (size[1] > 1e-6 * size[1].max())
    assert compared.any()
    assert_allclose(eigenvalues[compared], there[compared], rtol=1e-8)
    cosines = np.abs(np.sum(ours * seen, axis=0))
    assert_allclose(cosines[compared], (size[0] * size[1])[compared], rtol=1e-8)


def test_sensors_at_followers():
    modulus = fmu.Parameter("E", 3e10, 1e10, 6e10)
    by_terms = fmu.from_opensees(tower, ["E"], [3e10], [1e10], [6e10])
    anew = fmu.OpenSeesModel(tower, [3e10], modes=3)
    sensors = ((11, "x"), (12, "-y"), (13, "rz"), (20, "x"))
    assert all(anew.sees(sensor) and by_terms.sees(sensor) for sensor in sensors)
    assert not anew.sees((20, "z"))
    answer = anew.at_sensors(sensors).at([3e10])
    observed = fmu.ModalData(answer.frequencies, sensors=sensors, shapes=answer.shapes)
    here, there = (
        fmu.UpdatingProblem(
            model, observed, [modulus], error=[fmu.FrequencyErrors(sd=0.1), fmu.ShapeErrors(sd=0.1)]
        )
        for model in (by_terms, anew)
    )
    theta = np.array([[2e10], [4e10]])
    assert_allclose(here.log_prob(theta), there.log_prob(theta), rtol=1e-7)


def test_a_diaphragm_whose_centre_moves_is_refused():
    def moved(theta):
        tower(theta, centre=CENTRE + 1e-11 * float(theta[0]))

    with pytest.raises(ValueError, match=r"must have the geometry of the first export \(the motion of node"):
        fmu.from_opensees(moved, ["E"], [3e10], [1e10], [6e10])


def nothing(theta):
    pass


def raises(theta):
    raise RuntimeError("no section")


def all_fixed(theta):
    ops.model("basic", "-ndm", 2, "-ndf", 2)
    ops.node(1, 0.0, 0.0)
    ops.fix(1, 1, 1)


def of_fluid(theta):
    ops.model("basic", "-ndm", 3, "-ndf", 4)
    ops.node(1, 0.0, 0.0, 0.0, "-mass", 1.0, 1.0, 1.0, 1.0)
    ops.node(2, 1.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("build", "said"),
    [
        (nothing, r"build: must make nodes in OpenSees \(it made none\)"),
        (raises, r"build: must work at \[1\.0\] \(RuntimeError: no section\)"),
        (all_fixed, r"build: must leave degrees of freedom free \(all are fixed\)"),
        (of_fluid, r"build: must make degrees of freedom of structures \(node 1 has 4 in 3 dimensions\)"),
    ],
)
def test_what_is_wrong_with_a_build_is_told(build, said):
    with pytest.raises(ValueError, match=said):
        export_matrices(build, np.array([1.0]))
    assert not ops.getNodeTags()
