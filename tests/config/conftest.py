import pytest

FRAME = """\
name = "portal"
pairing = "index"
reduction = false

[model]
type = "frame"

[model.materials.steel]
E = 2.1e11
nu = 0.3
rho = 7850.0

[model.sections.leg]
tube = { diameter = 0.1, thickness = 0.005 }

[model.sections.beam]
A = 3e-3
Iy = 4e-6
Iz = 9e-6
J = 7e-6

[model.points]
left = [0.0, 0.0, 0.0]
corner = [0.0, 0.0, 2.0]
other = [3.0, 0.0, 2.0]
right = [3.0, 0.0, 0.0]

[model.supports]
left = "clamped"
right = ["x", "y", "z"]

[[model.masses]]
point = "corner"
mass = 20.0

[[model.members]]
from = "left"
to = "corner"
group = "legs"
section = "leg"
material = "steel"
elements = 3

[[model.members]]
from = "other"
to = "right"
group = "legs"
section = "leg"
material = "steel"
elements = 3

[[model.members]]
from = "corner"
to = "other"
group = "beam"
section = "beam"
material = "steel"
elements = 4
y_direction = [0.0, 1.0, 0.0]

[measurement]
frequencies = [9.5, 12.1]
sd = [0.1, 0.2]
sensors = [["corner", "x"], ["other", "y"]]

[[parameters]]
name = "E legs"
property = "E"
groups = ["legs"]
start = 2.1e11
lower = 1.5e11
upper = 2.5e11
unit = "N/m²"

[[parameters]]
name = "rho beam"
property = "rho"
groups = ["beam"]
start = 7850.0
lower = 5000.0
upper = 9000.0
prior = { distribution = "normal", mean = 7850.0, sd = 500.0 }
"""

MATRICES = """\
name = "two storeys"
reduction = false

[model]
type = "matrices"
dofs = [["first", "x"], ["second", "x"]]

[[model.stiffness]]
file = "k1.mtx"
powers = { k1 = 1 }

[[model.stiffness]]
file = "k2.npz"
factor = 2.0
powers = { k2 = 1 }

[[model.mass]]
file = "m.mtx"

[measurement]
frequencies = [3.1, 9.8]
sd = 0.05
shapes = [[0.6, 1.0], [1.0, -0.6]]
sensors = [["first", "x"], ["second", "x"]]

[[parameters]]
name = "k1"
start = 2.97e7
lower = 1e7
upper = 6e7

[[parameters]]
name = "k2"
start = 2.97e7
lower = 1e7
upper = 6e7
"""


@pytest.fixture
def frame_text():
    return FRAME


@pytest.fixture
def matrices_text():
    return MATRICES


@pytest.fixture
def folder(tmp_path):
    """A folder with the matrices of the two storeys."""
    import numpy as np
    import scipy.sparse as sp
    from scipy.io import mmwrite

    mmwrite(tmp_path / "k1.mtx", sp.coo_array([[1.0, 0.0], [0.0, 0.0]]))
    sp.save_npz(tmp_path / "k2.npz", sp.csr_array(0.5 * np.array([[1.0, -1.0], [-1.0, 1.0]])))
    mmwrite(tmp_path / "m.mtx", sp.coo_array(np.diag([16.5e3, 16.1e3])))
    return tmp_path
