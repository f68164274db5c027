"""GARTEUR SM-AG19: the model is the aeroplane, its modes are those measured, and updating brings them together."""

import tomllib
from pathlib import Path

import numpy as np
import pytest
import scipy.linalg as sl

from fmu import cases
from fmu.analysis.identifiability import identifiability
from fmu.analysis.start.initial_modes import initial_modes
from fmu.analysis.uninformed import left_to_prior
from fmu.config.problem import ProblemFile
from fmu.fem.frame.components import DIRECTIONS
from fmu.fem.pairing.reference_modes import count_rigid
from fmu.posterior.maxima import local_maxima

MEASURED = [6.38, 16.10, 33.13, 33.53, 35.65, 48.38, 49.43, 55.08, 63.04, 66.50]

# Of each measured mode: whether it is symmetric, which part moves in which direction with the most energy, and
# whether the drums turn far more than they rise. Vertical bending with n nodes is symmetric for even n.
KINDS = [
    (True, "wing", "z", False),
    (False, "tail", "y", False),
    (False, "wing", "z", True),
    (True, "wing", "z", True),
    (False, "wing", "z", False),
    (True, "wing", "z", False),
    (False, "wing", "x", False),
    (True, "wing", "x", False),
    (False, "wing", "z", False),
    (False, "tail", "x", False),
]


def case():
    """Return the case's file as a dict, to be answered by the full model."""
    return tomllib.loads(cases.path("garteur").read_text(encoding="utf-8")) | {"reduction": False}


def built(file, pairing=None):
    return ProblemFile.model_validate(file).build("garteur.toml", Path(), pairing)


@pytest.fixture(scope="module")
def problem():
    return built(case())


@pytest.fixture(scope="module")
def best(problem):
    return highest(problem)


def highest(problem):
    """Return where the log-probability is highest, uphill from the start."""
    return local_maxima(problem, starts=1)[0].theta


def error_percent(problem, theta):
    return 100.0 * (problem.frequencies(theta) / MEASURED - 1.0)


def test_it_weighs_what_the_aeroplane_does(problem):
    model = problem.model.structure
    along_x = np.array([direction == "x" for _, direction in model.dofs], dtype=float)
    mass = along_x @ model.M(problem.start) @ along_x
    plates = 7.5e-3 * 1.5 + 1e-3 * (2.0 + 2 * 0.4 + 0.3 + 0.4) + 76.2e-3 * 1.1e-3 * 1.7  # m³
    assert mass == pytest.approx(2700.0 * plates + 2 * 0.2 + 1.143 + 0.353, rel=1e-4)
    assert mass == pytest.approx(44.0, rel=0.05)


def test_six_modes_as_a_rigid_body_are_not_counted(problem):
    assert count_rigid(problem.model.truth.blocks, problem.start, 10) == 6
    assert problem.frequencies(problem.start).min() > 6.0


def test_measured_modes_answer_to_modes_of_their_kind(problem, best):
    """Before updating and after it, though two pairs come in another order before."""
    for theta in (problem.start, best):
        assert [kind(problem, theta, k) for k in range(10)] == KINDS
    before, after = problem.frequencies(problem.start), problem.frequencies(best)
    assert list(np.argsort(before)) == [0, 1, 2, 3, 4, 6, 5, 7, 9, 8]
    assert list(np.argsort(after)) == list(range(10))


def test_a_look_at_it_before_updating_takes_the_order_as_given(problem):
    found = initial_modes(problem)
    assert [found.of(k).number for k in range(10)] == [7, 8, 9, 10, 11, 13, 12, 14, 16, 15]
    assert not any("order" in doubt for doubt in found.doubts)


def kind(problem, theta, k):
    model = problem.model.structure
    nodes, shape = model.geometry.nodes, problem.model.truth.shapes(theta)[:, k]
    forces = model.M(theta) @ shape
    energy, moved = np.zeros((2, len(nodes), 6))
    for (node, direction), i in model.dof_of.items():
        moved[node, DIRECTIONS.index(direction)] = shape[i]
        energy[node, DIRECTIONS.index(direction)] = shape[i] * forces[i]
    mirrored = [int(np.argmin(np.linalg.norm(nodes - node * [1, -1, 1], axis=1))) for node in nodes]
    parity = np.sign(np.sum(moved[:, [0, 2]] * moved[mirrored][:, [0, 2]]))
    # y and the rotations about x and z change sign in the mirror
    reflected = parity * moved * [1, -1, 1, -1, 1, -1]
    np.testing.assert_allclose(moved[mirrored], reflected, atol=1e-6 * np.abs(moved).max())
    parts = {"fuselage": nodes[:, 2] < 0.08, "tail": nodes[:, 2] > 0.12}
    parts["wing"] = ~parts["fuselage"] & ~parts["tail"]
    share = {(part, d): energy[where, i].sum() for part, where in parts.items() for i, d in enumerate("xyz")}
    front, rear = (np.argmin(np.linalg.norm(nodes - [x, 0.95, 0.106], axis=1)) for x in (0.2, -0.2))
    rise = moved[[front, rear], 2]
    turns = np.ptp(rise) > max(4.0 * abs(rise.sum()), np.abs(moved[:, :3]).max())
    return bool(parity > 0), *max(share, key=share.get), bool(turns)


def test_updating_brings_all_ten_within_one_per_cent(problem, best):
    before, after = error_percent(problem, problem.start), error_percent(problem, best)
    assert np.abs(before).max() > 10.0
    assert np.abs(after).max() < 1.0
    assert np.all(problem.lower < best)
    assert np.all(best < problem.upper)


@pytest.mark.validate
def test_tail_torsion_is_the_highest_mode(best, problem):
    """Were it below five-node bending, no parameters would explain the frequencies."""
    other = case()
    other["measurement"]["counterparts"] = [1, 2, 3, 4, 5, 7, 6, 8, 9, 10]
    swapped = built(other)
    theta = highest(swapped)
    assert np.abs(error_percent(swapped, theta)).max() > 2.0
    assert swapped.log_prob(theta) < problem.log_prob(best) - 20.0


def test_by_number_it_is_the_same_at_the_start(problem):
    by_number = built(case(), "index")
    np.testing.assert_allclose(by_number.frequencies(problem.start), problem.frequencies(problem.start), rtol=1e-6)


@pytest.mark.parametrize(("change", "least", "most"), [("joints", 1e-5, 3e-4), ("mesh", 1e-5, 6e-4)])
def test_what_was_chosen_does_not_matter(problem, change, least, most):
    """Stiff joints ten times as stiff, or three times as many elements."""
    file = case()
    if change == "mesh":
        for member in file["model"]["members"]:
            member["elements"] *= 3
    else:
        for name, spring in file["model"]["springs"].items():
            updated = ("rx", "ry", "rz") if name == "wing-fuselage" else ()
            stiffness = spring["stiffness"]
            spring["stiffness"] = {d: k * (1 if d in updated else 10) for d, k in stiffness.items()}
    moved = np.abs(built(file).frequencies(problem.start) / problem.frequencies(problem.start) - 1.0)
    assert least < moved.max() < most


def test_the_section_of_wing_and_layer():
    """As the file's comment computes it, from plates of 100 x 10 and 76.2 x 1.1 mm."""
    wing, layer = 1e-3, 76.2e-3 * 1.1e-3
    reduced = wing * layer / (wing + layer)
    section = case()["model"]["sections"]["wing"]
    assert section["A"] == pytest.approx(wing + layer, rel=1e-4)
    Iy = 0.1 * 0.01**3 / 12 + 76.2e-3 * 1.1e-3**3 / 12 + reduced * 6.15e-3**2
    Iz = 0.01 * 0.1**3 / 12 + 1.1e-3 * 76.2e-3**3 / 12 + reduced * 11.9e-3**2
    assert (section["Iy"], section["Iz"]) == pytest.approx((Iy, Iz), rel=1e-4)


def test_every_elastic_mode_below_100_hz_was_measured(problem):
    model = problem.model.structure
    K, M = model.K(problem.start).toarray(), model.M(problem.start).toarray()
    lam = sl.eigh(K, M, eigvals_only=True, subset_by_index=[0, 16])
    frequencies = np.sqrt(np.abs(lam)) / (2 * np.pi)
    assert np.all(frequencies[:6] < 0.01)
    np.testing.assert_allclose(frequencies[6:16], np.sort(problem.frequencies(problem.start)), rtol=1e-6)
    assert frequencies[16] > 100.0


def test_what_ten_frequencies_do_not_tell_of_eleven_parameters(problem):
    """The pitch joint hardly moves in these modes; the drums' mass trades against the wing's torsion."""
    pitch, drums = left_to_prior(identifiability(problem))
    assert pitch.names == ("k pitch",)
    assert drums.words.startswith("0.95 m drum weights + ")
    assert "GJ wing" in drums.names
