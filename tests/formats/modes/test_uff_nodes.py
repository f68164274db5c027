"""Nodes of universal files, in the coordinate systems of the file."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fmu.formats.modes.measured_modes import ModesError
from fmu.formats.modes.uff_nodes import read_uff_points
from tests.formats.frf.test_frf_files import nodes, system, written

ORIGIN = np.array([5.0, 6.0, 7.0])
AXES = Rotation.from_rotvec([0.4, -0.2, 0.9]).as_matrix().T
"""Rows: the unit vectors of the system along global axes."""
LOCAL = np.array([[1.0, 2.0, -0.5], [-2.0, 0.5, 1.5]])


def own(points, kind):
    """Return Cartesian coordinates as those of a system of a kind."""
    x, y, z = points.T
    r, rho = np.hypot(x, y), np.linalg.norm(points, axis=1)
    azimuth = np.degrees(np.arctan2(y, x))
    return [points, np.array([r, azimuth, z]).T, np.array([rho, np.degrees(np.arccos(z / rho)), azimuth]).T][kind]


def old(number, kind, reference, points):
    """Return dataset 18 of a system by its origin, a point on its x axis and one in its xz plane, as text."""
    lines = ["    -1", "    18", f"{number:10d}{kind:10d}{reference:10d}{8:10d}{1:10d}", "own"]
    numbers = [f"{x:13.5E}" for x in np.ravel(points)]
    return "\n".join([*lines, "".join(numbers[:6]), "".join(numbers[6:]), "    -1", ""])


def places(path):
    return np.array(list(read_uff_points(path).values()))


@pytest.mark.parametrize("dataset", [15, 2411])
@pytest.mark.parametrize("kind", [0, 1, 2])
def test_positions_in_a_system_of_the_file(tmp_path, kind, dataset):
    """They were taken for global coordinates."""
    given = nodes(0, own(LOCAL, kind), definition=7) | {"type": dataset}
    path = written(tmp_path / "a.unv", [given, system(7, [*AXES, ORIGIN], kind)])
    assert list(read_uff_points(path)) == ["1", "2"]
    # dataset 15 has six digits
    np.testing.assert_allclose(places(path), LOCAL @ AXES + ORIGIN, atol=1e-3 if dataset == 15 else 1e-13)


def test_a_system_of_dataset_18_that_refers_to_a_cylindrical_one(tmp_path):
    """Its three points are in cylindrical coordinates, so that their differences are no vectors."""
    path = written(tmp_path / "a.unv", [nodes(0, LOCAL, definition=8)])
    points = np.array([[1.0, 1.0, 0.0], [1.0, 3.0, 0.0], [2.0, 3.0, 0.0]])  # the axes are the global y, z, x
    text = old(7, 1, 1, [[0, 0, 0], [1, 0, 0], [1, 0, 1]]) + old(8, 0, 7, own(points, 1))
    path.write_text(text + path.read_text())
    np.testing.assert_allclose(places(path), LOCAL[:, [2, 0, 1]] + [1.0, 1.0, 0.0], atol=1e-4)


@pytest.mark.parametrize(("number", "sets"), [(0, []), (1, []), (4, [system(4, [*np.eye(3), np.zeros(3)])])])
def test_global_coordinates_keep_every_bit(tmp_path, number, sets):
    path = written(tmp_path / "a.unv", [nodes(0, LOCAL / 3.0, definition=number), *sets])
    assert np.array_equal(places(path), LOCAL / 3.0)


def test_a_system_that_the_file_lacks_is_refused(tmp_path):
    path = written(tmp_path / "a.unv", [nodes(0, LOCAL, definition=7)])
    with pytest.raises(ModesError, match=r"node 1: must have the coordinate system 7 \(it has not\); export the "):
        read_uff_points(path)


def test_a_node_at_two_places_is_refused(tmp_path):
    path = written(tmp_path / "a.unv", [nodes(0, LOCAL), nodes(1, LOCAL[1:])])
    with pytest.raises(ModesError, match=r"each node once \(got node 1 at two places\)"):
        read_uff_points(path)
