"""The modes of a reference model that the measured ones are compared with."""

import numpy as np
import pytest
import scipy.linalg
import scipy.sparse as sp
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from fmu.fem.frame.components import DIRECTIONS, ElementGroup, Material, Section
from fmu.fem.frame.frame import Frame
from fmu.fem.modes.full_block import full_blocks
from fmu.fem.modes.modal import solve_spectrum
from fmu.fem.modes.separable import SeparableModel, selection
from fmu.fem.modes.terms import Term
from fmu.fem.pairing.paired_structure import PairedStructure
from fmu.fem.pairing.reference_modes import count_rigid, reference_modes
from fmu.fem.pairing.rules import ShapePairing
from tests import cantilever

STEEL = Material(E=2.1e11, nu=0.3, rho=7850.0)


@pytest.mark.parametrize(("directions", "planes"), [("z", "z"), ("y", "y"), ("x", "x"), ("zy", "zyz")])
def test_reference_modes_are_those_that_move_a_sensor(directions, planes):
    model = cantilever.beam(1).separable({"E": [("E", "1")]})
    full = full_blocks(model)
    sensors = np.array([model.dof(30, d) for d in directions])
    everywhere = selection(model.translations, model.n_dof)
    pairing = reference_modes(full, np.array([2.1e11]), selection(sensors, model.n_dof), everywhere, len(planes))
    names = np.array([model.dofs[i][1] for i in pairing.rows.indices])
    for k, plane in enumerate(planes):
        assert set(names[np.abs(pairing.shapes[:, k]) > 1e-12]) == {plane}


def test_torsion_moves_no_translation_in_any_orientation():
    """A mode that only turns the section is not seen, however the beam lies in space."""
    R = Rotation.from_rotvec([0.4, -0.9, 0.3]).as_matrix()
    for rotation in (np.eye(3), R):
        nodes = np.linspace(0, 0.5, 11)[:, None] * rotation[:, 0]
        elements = np.stack([np.arange(10), np.arange(1, 11)], axis=1)
        section = Section.rectangle(width=0.06, height=0.01)
        group = ElementGroup("b", elements, section, STEEL, tuple(rotation[:, 1]))
        model = Frame(nodes, [group], {0: DIRECTIONS}).separable({"E": [("E", "b")]})
        full = full_blocks(model)
        everywhere = selection(model.translations, model.n_dof)
        pairing = reference_modes(full, np.array([2.1e11]), everywhere, everywhere, 4)
        modes = pairing.solve(full, np.array([[2.1e11]]))
        lam = solve_spectrum(full, np.array([[2.1e11]]), 6).eigenvalues[0]
        # W1 S1 W2 T1 W3 …: the fourth one must be left out
        assert_allclose(modes.eigenvalues[0], lam[[0, 1, 2, 4]], rtol=1e-6)


def test_sensors_that_see_too_little():
    stiffness = np.array([[2.0, -1, 0, 0], [-1, 2.0, 0, 0], [0, 0, 4.0, -1], [0, 0, -1, 4.0]])
    K, M = Term(sp.csr_array(stiffness), (1.0,)), Term(sp.csr_array(np.eye(4)), (0.0,))
    two_pairs = full_blocks(SeparableModel([K], [M]))
    with pytest.raises(ValueError, match=r"^sensors: must see the 3 measured modes \(they see 2\)$"):
        reference_modes(two_pairs, np.array([2.0]), selection([3], 4), selection(np.arange(4), 4), 3)


def test_blocks_that_cannot_be_solved():
    model = SeparableModel([Term(sp.csr_array(np.diag([2.0, 3.0])), (1.0,))], [Term(-sp.eye_array(2), (0.0,))])
    rule = r"^start: must have modes \(got none: M is not positive semidefinite: its diagonal is -1\); correct"
    with pytest.raises(ValueError, match=rule):
        reference_modes(full_blocks(model), np.array([1.0]), selection([0], 2), selection([0], 2), 1)


def test_shapes_measured_at_few_sensors_pair_as_well():
    """Reference shapes from outside, any scale and sign, at three nodes."""
    model = cantilever.beam(1).separable({"E": [("E", "1")]})
    full = full_blocks(model)
    theta = np.array([[2.1e11]])
    dofs = np.array([model.dof(node, "z") for node in (15, 30, 49)])
    weak = next(b for b, block in enumerate(full) if dofs[0] in block.dofs)
    local = np.searchsorted(full[weak].dofs, dofs)
    lam, phi = full[weak].modes(theta, 3)
    measured = phi[0][local][:, [2, 0, 1]] * [-3.0, 0.1, 7.0]
    modes = ShapePairing(selection(dofs, model.n_dof), measured).solve(full, theta)
    assert_array_equal(modes.rank[0], [2, 0, 1])
    assert_allclose(modes.eigenvalues[0], lam[0, [2, 0, 1]], rtol=1e-6)


def test_rigid_body_modes_of_a_free_structure_were_not_measured():
    """A modal test of a suspended structure gives its elastic modes."""
    nodes = np.linspace(0, 1.0, 9)[:, None] * [1.0, 0.0, 0.0]
    elements = np.stack([np.arange(8), np.arange(1, 9)], axis=1)
    group = ElementGroup("b", elements, Section(A=4e-4, Iy=3e-8, Iz=5e-8, J=2e-8), STEEL)
    model = Frame(nodes, [group]).separable({"E": [("E", "b")]})
    full, theta = full_blocks(model), np.array([2.1e11])
    sensors = np.array([model.dof(node, "z") for node in (0, 3, 8)])
    everywhere = selection(model.translations, model.n_dof)
    modes = reference_modes(full, theta, selection(sensors, model.n_dof), everywhere, 2).solve(full, theta[None])
    elastic = solve_spectrum(full, theta[None], 12).eigenvalues[0, 6:]
    plane = next(b for b, block in enumerate(full) if sensors[0] in block.dofs)
    bending = full[plane].eigenvalues(theta[None], 4)[0, 2:]
    assert_allclose(modes.eigenvalues[0], bending, rtol=1e-6)
    assert bending[0] == pytest.approx(elastic[0], rel=1e-6)


def free_frame():
    """Return an L in space that nothing holds and no plane of motion decouples."""
    leg = np.linspace(0.0, 1.0, 6)
    corner = np.array([1.2, 0.1, 0.0])
    nodes = np.concatenate([np.outer(leg, corner), np.outer(leg[1:], [0.1, 0.7, 0.3]) + corner])
    elements = np.stack([np.arange(10), np.arange(1, 11)], axis=1)
    group = ElementGroup("L", elements, Section(A=3e-3, Iy=4e-6, Iz=9e-6, J=7e-6), STEEL, (0, 0.3, 1))
    return Frame(nodes, [group]).separable({"E": [("E", "L")]})


@pytest.mark.parametrize("measured", [False, True])
def test_rigid_body_modes_leave_room_for_all_measured_ones(measured):
    """They are of the same block as the elastic ones, and below them."""
    model, n, theta = free_frame(), 6, np.array([2.1e11])
    full = full_blocks(model)
    assert len(full) == 1
    assert count_rigid(full, theta, n) == 6
    lam, phi = full[0].modes(theta[None], 6 + n)
    sensors = tuple((node, direction) for node in (0, 5, 8, 10) for direction in "xyz")
    shapes = model.observation(sensors) @ phi[0, :, 6:] if measured else None
    structure = PairedStructure.of(
        model,
        pairing="shape",
        numbers=tuple(range(1, n + 1)),
        sensors=sensors,
        reference=theta,
        shapes=shapes,
    )
    assert_allclose(structure.modes(theta[None]).eigenvalues[0], lam[0, 6:], rtol=1e-6)


def test_measured_modes_may_answer_to_others_than_the_lowest_in_order():
    """Counted among the elastic modes that the sensors see."""
    model, theta = free_frame(), np.array([2.1e11])
    lam = solve_spectrum(full_blocks(model), theta[None], 12).eigenvalues[0, 6:]

    def paired(counterparts):
        return PairedStructure.of(
            model, pairing="shape", numbers=(1, 2, 3), sensors=(), reference=theta, counterparts=counterparts
        )

    assert_allclose(paired((5, 1, 2)).modes(theta[None]).eigenvalues[0], lam[[4, 0, 1]], rtol=1e-6)
    assert_allclose(paired(()).modes(theta[None]).eigenvalues[0], lam[:3], rtol=1e-6)
    with pytest.raises(ValueError, match=r"^sensors: must see mode 61 \(they see 60\)$"):
        paired((61, 1, 2))


def test_measured_shapes_are_looked_for_above_many_modes_of_light_parts():
    """Four floors bear eight soft appendages: the modes of the floors are ninth to eleventh."""
    n = 12
    drift = np.eye(n) - np.diag(np.ones(n - 1), -1) * (np.arange(n) < 4)[:, None]
    hung = np.eye(n)[4:] - np.eye(n)[np.arange(8) % 4]
    soft = 10.0 * (2 * np.pi * (0.5 + 0.1 * np.arange(8))) ** 2
    terms = [Term(1e6 * drift[:4].T @ drift[:4], (1,)), Term(hung.T @ (soft[:, None] * hung), (0,))]
    mass = np.diag([1e3] * 4 + [10.0] * 8)
    model = SeparableModel(terms, [Term(mass, (0,))], [(i, "x") for i in range(n)])
    lam, phi = scipy.linalg.eigh(model.K([1.0]).toarray(), mass)
    f, sensors = np.sqrt(lam) / (2 * np.pi), tuple((i, "x") for i in range(4))
    of_floors = [8, 9, 10]
    settings = {"pairing": "shape", "numbers": (1, 2, 3), "sensors": sensors, "reference": np.ones(1)}
    paired = PairedStructure.of(model, **settings, shapes=phi[:4, of_floors], measured_hz=f[of_floors])
    assert_allclose(paired.frequencies(np.ones((1, 1)))[0], f[of_floors], rtol=1e-9)
    lowest = PairedStructure.of(model, **settings, shapes=phi[:4, :3], measured_hz=f[:3])
    assert lowest.rule.margin == 3


def test_more_measured_modes_than_are_looked_for_end_the_search():
    n, n_modes = 260, 210
    drift = np.eye(n) - np.eye(n, k=-1)
    model = SeparableModel([Term(drift.T @ drift, (1,))], [Term(np.eye(n), (0,))], [(i, "x") for i in range(n)])
    lam, phi = np.linalg.eigh(drift.T @ drift)
    paired = PairedStructure.of(
        model, pairing="shape", numbers=tuple(range(1, n_modes + 1)), sensors=tuple((i, "x") for i in range(n)),
        reference=np.ones(1), shapes=phi[:, :n_modes], measured_hz=np.sqrt(lam[:n_modes]) / (2 * np.pi),
    )  # fmt: skip
    assert paired.rule.margin == 3


@pytest.mark.parametrize(("hz", "n_rigid"), [(0.5e-3, 1), (2e-3, 0)])
def test_a_rigid_body_mode_is_a_thousand_times_below_what_was_measured(hz, n_rigid):
    """Beside a very stiff spring every other mode is negligible."""
    stiff = (2.0 * np.pi * np.array([hz, 1e4])) ** 2
    model = SeparableModel.from_terms(["k"], [(np.diag(stiff), "k")], [np.eye(2)])
    assert count_rigid(full_blocks(model), np.ones(1), 2, elastic_hz=1.0) == n_rigid
