"""Constraints of decks without the programs: closed forms, chains, and contradictions that are refused by name."""

import numpy as np
import pytest
import scipy.io
import scipy.sparse as sp
from numpy.testing import assert_allclose

import fmu
from fmu.fem.modes.eigensolver import eigen
from fmu.formats.constraints.equations import Equation
from fmu.formats.constraints.transformation import transformation
from fmu.formats.matrices.limits import RefusedError
from fmu.types import DIRECTIONS

RIGID_BAR = """\
GRID,1,,0.,0.,0.
GRID,2,,3.,0.,0.
GRID,9,,1.,0.,0.
RBE2,5,9,123456,1,2
"""


def equations(folder, text):
    """Return the equations of bulk data, by dependent degree of freedom."""
    (folder / "deck.bdf").write_text(text)
    return {one.dependent: dict(one.weights) for one in fmu.read_mesh(folder / "deck.bdf").equations}


def read(folder, text, stiffness, mass, **more):
    """Return the model of diagonal matrices, given by degree of freedom, under the constraints of a deck."""
    names = sorted({*stiffness, *mass})
    for file, values in (("K", stiffness), ("M", mass)):
        matrix = sp.diags_array([values.get(name, 0.0) for name in names], format="coo")
        scipy.io.mmwrite(folder / f"{file}.mtx", matrix, symmetry="general")
    (folder / "dofs.csv").write_text("\n".join(f"{node},{d}" for node, d in names))
    (folder / "deck.bdf").write_text(text)
    return fmu.read_model(
        folder / "K.mtx", mass=folder / "M.mtx", mesh=folder / "deck.bdf", dofs=folder / "dofs.csv", **more
    )


def test_a_rigid_bar_on_two_springs(tmp_path):
    """Springs k, at -1 and 2 m from the mass m of inertia J: λ of [[2k, -k], [-k, 5k]] and diag(m, J)."""
    k, m, J = 700.0, 3.0, 4.0
    stiff = {(node, "z"): k for node in (1, 2)} | {(9, d): 1e6 for d in ("x", "y", "rx", "rz")}
    model = read(tmp_path, RIGID_BAR, stiff, {(9, "z"): m, (9, "ry"): J, (9, "x"): 1.0})
    assert model.dofs == tuple((9, d) for d in DIRECTIONS)
    lam, phi = eigen(model.stiffness, model.mass, 2)
    expected = np.linalg.eigvals(np.diag([1 / m, 1 / J]) @ np.array([[2 * k, -k], [-k, 5 * k]]))
    assert_allclose(lam, np.sort(expected), rtol=1e-12)
    assert model.motions[1, "z"] == {(9, "z"): 1.0, (9, "ry"): 1.0}
    assert model.motions[2, "z"] == {(9, "z"): 1.0, (9, "ry"): -2.0}
    seen = fmu.SeparableModel(
        [fmu.Term(model.stiffness, ())], [fmu.Term(model.mass, ())], model.dofs, motions=model.motions
    ).observation([(2, "z"), (1, "-z")])
    z, ry = phi[2], phi[4]
    assert_allclose(seen @ phi, [z - 2.0 * ry, -z - ry], rtol=1e-12)


def test_dependents_without_rows_move_as_the_deck_says(tmp_path):
    """The program has eliminated them: matrices and supports stay as they are."""
    stiff = {(9, d): 5.0 for d in DIRECTIONS}
    model = read(tmp_path, RIGID_BAR + "SPC1,1,2,9\n", stiff, stiff)
    assert model.dofs == tuple((9, d) for d in DIRECTIONS)
    assert_allclose(model.stiffness.toarray(), 5.0 * np.eye(6))
    assert model.motions[2, "z"] == {(9, "z"): 1.0, (9, "ry"): -2.0}
    missing = read(tmp_path, RIGID_BAR, {(9, "z"): 1.0}, {(9, "z"): 1.0})
    assert (2, "z") not in missing.motions
    assert "No sensors can be at nodes that follow others without rows: 1, 2." in missing.notes


def test_supports_hold_where_the_matrices_are_of_all_degrees_of_freedom(tmp_path):
    stiff = {(node, d): 5.0 for node in (1, 2, 9) for d in DIRECTIONS}
    model = read(tmp_path, RIGID_BAR + "SPC1,1,1246,9\nGRID,3,,0.,0.,1.,,1\n", stiff, stiff)
    assert model.dofs == ((9, "z"), (9, "ry"))
    assert "supports of the mesh hold them" in " ".join(model.notes)


def test_weights_of_an_rbe3_by_hand(tmp_path):
    """The centre of the weights 1 and 3 on a line is at x = 3 m; the reference at x = 1 m turns about it."""
    text = "GRID,1,,0.,0.,0.\nGRID,2,,4.,0.,0.\nGRID,9,,1.,0.,0.\n"
    found = equations(tmp_path, text + "RBE3,5,,9,35,1.,3,1,3.\n,3,2\n")
    assert_allclose([found[9, "z"][node, "z"] for node in (1, 2)], [0.75, 0.25], rtol=1e-13)
    assert_allclose([found[9, "ry"][node, "z"] for node in (1, 2)], [0.25, -0.25], rtol=1e-13)


def test_unequal_weights_of_four_corners(tmp_path):
    """At the centre of the weights the mean is Σ w u / Σ w, and the slopes are moments over Σ w y² and Σ w x²."""
    places = {1: (-1.0, 2.0), 2: (3.0, 2.0), 3: (3.0, -1.0), 4: (-1.0, -1.0)}
    weights = {1: 1.0, 2: 2.5, 3: 2.5, 4: 1.0}
    centre = sum(w * np.array(places[n]) for n, w in weights.items()) / sum(weights.values())
    text = "".join(f"GRID,{n},,{x},{y},0.\n" for n, (x, y) in places.items())
    text += f"GRID,9,,{centre[0]:.14f},{centre[1]:.14f},0.\nRBE3,5,,9,345,1.,3,1,4\n,2.5,3,2,3\n"
    found = equations(tmp_path, text)
    x, y = (np.array(list(places.values())) - centre).T
    w = np.array(list(weights.values()))
    assert_allclose([found[9, "z"][n, "z"] for n in places], w / w.sum(), rtol=1e-12)
    assert_allclose([found[9, "rx"][n, "z"] for n in places], w * y / (w @ y**2), rtol=1e-12)
    assert_allclose([found[9, "ry"][n, "z"] for n in places], -w * x / (w @ x**2), rtol=1e-12)


def test_rotations_are_weighted_by_the_mean_distance_squared(tmp_path):
    """Nodes at ±2 m, each with its rotation about y: of a unit force couple, L² = 4 gives both the same share."""
    text = "GRID,1,,-2.,0.,0.\nGRID,2,,2.,0.,0.\nGRID,9,,0.,0.,0.\nRBE3,5,,9,35,1.,35,1,2\n"
    found = equations(tmp_path, text)[9, "ry"]
    # minimise Σ (z_i ± 2 θ)² + 4 Σ (θ_i - θ)²: 16 θ = -2 z_2 + 2 z_1 + 4 (θ_1 + θ_2)
    assert_allclose([found[1, "z"], found[2, "z"], found[1, "ry"], found[2, "ry"]], [1 / 8, -1 / 8, 1 / 4, 1 / 4])
    by_mystran = equations(tmp_path, f"OUTPUT4 KLL,MLL,,,//-1/21\nCEND\nBEGIN BULK\n{text}")[9, "ry"]
    assert_allclose([by_mystran[1, "z"], by_mystran[1, "ry"]], [0.2, 0.1])
    dmap = (
        "SOL 103\nCOMPILE SEMODES $\nALTER 'CALL.*SUPER3.*'$\nOUTPUT4 KAA,MAA,,,//0/31///16 $\nCEND\nBEGIN BULK\n"
    )
    assert equations(tmp_path, dmap + text)[9, "ry"] == found


def test_um_makes_others_dependent(tmp_path):
    text = "GRID,1,,-1.,0.,0.\nGRID,2,,1.,0.,0.\nGRID,9,,0.,0.,0.\n"
    found = equations(tmp_path, text + "RBE3,5,,9,3,1.,3,1,2\n,UM,2,3\n")
    assert list(found) == [(2, "z")]
    assert found[2, "z"] == pytest.approx({(9, "z"): 2.0, (1, "z"): -1.0})


def test_an_rbar_with_components_of_both_ends_moves_as_one_body(tmp_path):
    text = "GRID,1,,0.,0.,0.\nGRID,2,,0.,0.,2.\n"
    mixed = equations(tmp_path, text + "RBAR,5,1,2,1236,12\n")
    assert set(mixed) == {(1, "rx"), (1, "ry"), *((2, d) for d in ("z", "rx", "ry", "rz"))}
    x, T = np.array([0.3, -0.2, 0.5, 0.04, -0.03, 0.02]), np.eye(6)
    T[0, 4], T[1, 3] = 2.0, -2.0  # the end moves by rotation × 2 m along z
    u = {(1, d): v for d, v in zip(DIRECTIONS, x, strict=True)} | dict(
        zip([(2, d) for d in DIRECTIONS], T @ x, strict=True)
    )
    for name, weights in mixed.items():
        assert sum(w * u[other] for other, w in weights.items()) == pytest.approx(u[name], abs=1e-14)
    one_end = equations(tmp_path, text + "RBAR,5,1,2,123456\n")
    assert one_end == equations(tmp_path, text + "RBE2,5,1,123456,2\n")


def test_an_rbar1_follows_its_first_node(tmp_path):
    text = "GRID,1,,0.,0.,0.\nGRID,2,,0.,0.,2.\n"
    found = equations(tmp_path, text + "RBAR1,5,1,2,1246,6.5-6\n")
    assert found == equations(tmp_path, text + "RBE2,5,1,1246,2\n")
    assert found[2, "x"] == {(1, "x"): 1.0, (1, "ry"): 2.0}
    assert equations(tmp_path, text + "RBAR1,5,1,2\n") == equations(tmp_path, text + "RBE2,5,1,123456,2\n")


def test_matrices_that_include_no_constraints_are_refused_if_some_are_not_read(tmp_path):
    """Of all degrees of freedom, by their names or since a dependent has a row; SUPORT constrains no mode."""
    every = {(node, d): 1.0 for node in (1, 2, 9) for d in DIRECTIONS}
    grids = RIGID_BAR.split("RBE2")[0]
    for text in (f"{grids}RTRPLT1,7,1,2,9,1\n", f"{RIGID_BAR}RTRPLT1,7,1,2,9,1\n"):
        with pytest.raises(ValueError, match=r"^mesh: must have only constraints .*\(1 RTRPLT1 not read\)"):
            read(tmp_path, text, every, every)
    assert "1 SUPORT entries are not read." in read(tmp_path, f"{grids}SUPORT,1,123\n", every, every).notes
    some = {(9, d): 1.0 for d in DIRECTIONS}
    assert "1 RBE1 entries are not read." in read(tmp_path, f"{RIGID_BAR}RBE1,7,1,123\n", some, some).notes


def test_axes_of_nodes(tmp_path):
    """The dependent's x is the global y; the reference's x is the global z."""
    text = "CORD2R,1,,0.,0.,0.,0.,0.,1.\n,0.,1.,0.\nCORD2R,2,,0.,0.,0.,0.,1.,0.\n,0.,0.,1.\n"
    text += "GRID,1,,0.,0.,0.,2\nGRID,2,,1.,0.,0.,1\nRBE2,5,1,1,2\n"
    # global y of node 2 = global y of node 1 + 1 m × global rz: z and rx of node 1 in its axes
    assert equations(tmp_path, text) == {(2, "x"): pytest.approx({(1, "z"): 1.0, (1, "rx"): 1.0})}


def test_the_case_control_selects_mpc_and_spc(tmp_path):
    bulk = (
        "GRID,1,,0.,0.,0.\nGRID,2,,1.,0.,0.\nMPC,5,1,1,2.,2,1,-1.\n,,2,2,.5\nMPC,6,1,2,1.,2,2,-1.\nMPCADD,7,5,6\n"
    )
    bulk += "SPC1,3,3,1\nSPC,4,2,3,0.\n"
    assert set(equations(tmp_path, bulk)) == {(1, "x"), (1, "y")}
    deck = "CEND\nMPC = {}\nSPC = 4\nBEGIN BULK\n" + bulk
    assert equations(tmp_path, deck.format(5)) == {(1, "x"): {(2, "x"): 0.5, (2, "y"): -0.25}}
    assert fmu.read_mesh(tmp_path / "deck.bdf").held == {(2, "z")}
    assert set(equations(tmp_path, deck.format(7))) == {(1, "x"), (1, "y")}
    assert not equations(tmp_path, deck.replace("MPC = {}\n", ""))
    assert any("No MPC set acts" in note for note in fmu.read_mesh(tmp_path / "deck.bdf").notes)


@pytest.mark.parametrize("blanks", [" ", " " * 4, " " * 8, "\t"])
def test_an_indented_case_control_selects_too(tmp_path, blanks):
    bulk = "GRID,1,,0.,0.,0.\nGRID,2,,1.,0.,0.\nMPC,8,2,1,1.,1,1,-1.\nSPC1,7,3,1\nENDDATA\n"
    lines = ["SOL 103", "CEND", "SUBCASE 1", f"{blanks}mpc = 8", f"{blanks}SPC=7 $ a set", f"{blanks}METHOD = 1"]
    assert equations(tmp_path, "\n".join([*lines, "BEGIN BULK", bulk])) == {(2, "x"): {(1, "x"): 1.0}}
    mesh = fmu.read_mesh(tmp_path / "deck.bdf")
    assert mesh.held == {(1, "z")}
    assert not mesh.notes


def test_a_node_with_permanent_components_0_holds_none(tmp_path):
    two = "GRID,2,,1.,0.,0.\n"
    for text, held in (
        ("GRID,1,,0.,0.,0.,0,0\n" + two, set()),
        ("GRDSET,,,,,,0,0\nGRID,1,,0.,0.,0.\n" + two, set()),
        ("GRDSET,,,,,,,45\nGRID,1,,0.,0.,0.,0,0\n" + two, {(2, "rx"), (2, "ry")}),
    ):
        equations(tmp_path, text)
        assert fmu.read_mesh(tmp_path / "deck.bdf").held == held


TURNED = "CORD2R,5,0,0.,0.,0.,0.,0.,1.\n,.866025403784,.5,0.\nGRID,1,,0.,0.,0.,5\n"


def test_components_that_are_condensed_move_in_an_unknown_way(tmp_path):
    """Axes turned by 30° about z: of a held second axis x and y are known, of a condensed one neither is."""
    rows = {(1, "x"): 1.0, (1, "z"): 2.0}
    held = read(tmp_path, TURNED + "SPC1,1,2,1\nASET1,13,1\n", rows, rows)
    assert held.motions[1, "y"] == pytest.approx({(1, "x"): 0.5}, rel=1e-9)
    condensed = read(tmp_path, TURNED + "ASET1,13,1\n", rows, rows)
    model = fmu.SeparableModel.from_terms(
        ["k"], [(condensed.stiffness, "k")], [condensed.mass], condensed.dofs, None, condensed.motions
    )
    assert [d for d in "xyz" if model.sees((1, d))] == ["z"]


def test_a_node_with_axes_whose_motion_is_lost(tmp_path):
    """The first component of node 1 follows node 2, which has no rows: only the motion along z is known."""
    rows = {(1, "y"): 1.0, (1, "z"): 2.0}
    lost = read(tmp_path, TURNED + "GRID,2,,1.,0.,0.\nMPC,1,1,1,1.,2,1,-1.\n", rows, rows)
    assert "No sensors can be at nodes that follow others without rows: 1." in lost.notes
    stiffness = [(lost.stiffness, "k")]
    model = fmu.SeparableModel.from_terms(["k"], stiffness, [lost.mass], lost.dofs, None, lost.motions)
    assert [d for d in "xyz" if model.sees((1, d))] == ["z"]


def chain(n, factor=1.0):
    return [Equation((k, "x"), {(k - 1, "x"): factor, (0, "y"): 1.0}, f"MPC {k}") for k in range(1, n + 1)]


def test_a_chain_of_constraints_in_any_order():
    n = 1000
    order = np.random.default_rng(0).permutation(n)
    links = chain(n, 0.9)
    found = transformation([links[i] for i in order], [(k, "x") for k in range(n + 1)])
    assert found.independent == [(0, "x"), (0, "y")]
    of = dict(zip(found.dofs, found.T.toarray(), strict=True))
    for k in (1, 7, n):
        assert_allclose(of[k, "x"], [0.9**k, (1.0 - 0.9**k) / 0.1], rtol=1e-12)


def test_an_rbe2_of_94_nodes_and_a_large_model_are_sparse():
    links = [Equation((k, d), {(0, d): 1.0, (0, "ry"): 0.1}, "RBE2 1") for k in range(1, 95) for d in "xyz"]
    n = 50_000
    found = transformation(links, [(k, d) for k in range(n) for d in "xyz"])
    assert found.T.nnz == 3 * n + 94 * 3 + 1


NODES = "".join(
    f"GRID,{n},,{x}.,{y}.,0.\n" for n, (x, y) in enumerate([(0, 0), (1, 0), (2, 0), (0, 1), (5, 5)], 1)
)
CONTRADICTIONS = {
    "circle of two": ("MPC,1,1,1,1.,2,1,-1.\nMPC,1,2,1,1.,1,1,-.5\n", r"circle \(node 1 x, node 2 x, of MPC 1"),
    "circle of rigid links": (
        "RBE2,1,1,123,2\nRBE2,2,2,123456,3\nMPC,1,1,2,1.,3,2,-1.\n",
        r"circle \(node 1 y, .*of '?MPC 1, equation 1",
    ),
    "own follower": ("MPC,1,1,1,1.,1,2,-1.\nMPC,1,1,2,1.,1,1,-1.\n", r"circle \(node 1 x, node 1 y"),
    "twice": ("RBE2,7,1,123456,2\nRBE2,8,3,3,2\n", r"once \(node 2 z in RBE2 7 and RBE2 8\)"),
    "rigid and MPC": ("RBE2,7,1,123456,2\nMPC,4,2,1,1.,3,1,-1.\n", r"node 2 x in RBE2 7 and MPC 4, equation 1"),
    "held": ("RBE2,7,1,123456,2\nSPC1,1,6,2\n", r"held \(node 2 rz, of RBE2 7, is\)"),
    "held by GRID": ("GRID,9,,1.,1.,1.,,3\nRBE2,7,1,123,9\n", r"held \(node 9 z, of RBE2 7, is\)"),
    "points on a line": ("RBE3,7,,5,123456,1.,123,1,2\n,3\n", r"determine node 5 x.*\(RBE3 7 does not\)"),
    "one point": ("RBE3,7,,5,123456,1.,123,1\n", r"RBE3 7 does not"),
    "no weight": ("RBE3,7,,5,123456,0.,123,1,2,4\n", r"weights that are not negative \(RBE3 7"),
    "negative weight": ("RBE3,7,,5,123456,-1.,123,1,2,4\n", r"weights that are not negative \(RBE3 7"),
    "bar without rotation": ("RBAR,7,1,2,123,123\n", r"six independent components .*RBAR 7"),
    "bar of five": ("RBAR,7,1,2,12345\n", r"six independent components .*RBAR 7"),
    "no factor": ("MPC,4,2,1,0.,3,1,-1.\n", r"MPC 4, equation 1: the factor of node 2 x is zero"),
    "no terms": ("MPC,4\n", r"MPC 4, equation 1 has no terms"),
    "unknown node": ("RBE2,7,1,123456,77\n", r"no node 77"),
    "unknown set": ("CEND\nMPC=9\nBEGIN BULK\nMPC,4,2,1,1.,3,1,-1.\n", r"must have the MPC set 9"),
    "unknown set of an empty deck": ("CEND\nMPC=9\nBEGIN BULK\n", r"the MPC set 9 .*\(it has none\); add the"),
    "unknown supports": ("CEND\nSPC=9\nBEGIN BULK\nSPC1,4,123,1\n", r"the SPC set 9 .*selects \(it has 4\); add"),
    "no supports": ("CEND\nSPC=9\nBEGIN BULK\n", r"the SPC set 9 .*selects \(it has none\)"),
    "no part of supports": ("CEND\nSPC=9\nBEGIN BULK\nSPCADD,9,4,5\nSPC1,4,123,1\n", r"the SPC set 5"),
    "two selections": ("MPC=4\nMPC=5\nBEGIN BULK\nMPC,4,2,1,1.,3,1,-1.\n", r"one MPC set for all subcases"),
}  # fmt: skip


@pytest.mark.parametrize("kind", CONTRADICTIONS)
def test_contradictions_are_refused_with_their_names(tmp_path, kind):
    text, message = CONTRADICTIONS[kind]
    ones = {(node, d): 1.0 for node in range(1, 6) for d in DIRECTIONS}
    deck = text + NODES if "BULK" in text else NODES + text
    with pytest.raises(ValueError, match=f"^mesh: .*{message}"):
        read(tmp_path, deck, ones, ones)


def test_a_constraint_that_would_fill_the_matrices_is_refused(tmp_path):
    n = 5000
    text = "".join(f"GRID,{k},,{k % 71}.,{k // 71}.,0.\n" for k in range(1, n + 1)) + "GRID,9999,,0.,0.,1.\n"
    text += "RBE3,7,,9999,123456,1.,123,1,THRU\n" + f",{n}\n"
    ones = {(9999, d): 1.0 for d in DIRECTIONS}
    with pytest.raises(ValueError, match=r"RBE3 7 couples each of 1\d{4} to all others"):
        read(tmp_path, text, ones, ones)


def test_a_chain_whose_weights_overflow_is_refused_with_a_name():
    links = [Equation((k, "x"), {(k - 1, "x"): 1e9}, f"MPC {k}") for k in range(1, 60)]
    with pytest.raises(RefusedError, match=r"finite weights \(those of node 35 x are not\)"):
        transformation(links, [(0, "x")])
