"""Eigenvectors in the printed output of Nastran, along the axes of each node."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import eigh

import fmu
from fmu.formats.modes.f06 import read_f06
from fmu.formats.modes.measured_modes import ModesError
from tests.formats.models.write_with_pynastran import IDS, portal

FILES = Path(__file__).parent / "models" / "nastran"
SENSORS = [(205, "x"), (303, "-z"), (410, "y"), (410, "rx")]
MSC = """\
1    PORTAL                                                       JANUARY  1, 2026  MSC NASTRAN   PAGE     9

      EIGENVALUE =  3.947842E+03
          CYCLES =  1.000000E+01         R E A L   E I G E N V E C T O R   N O .          1

      POINT ID.   TYPE          T1             T2             T3             R1             R2             R3
             7      G      1.000000E+00   0.0           -2.5E-01       0.0            0.0            0.0
             8      S      4.000000-001
1    PORTAL                                                       JANUARY  1, 2026  MSC NASTRAN   PAGE    10
"""


def test_modes_are_those_of_the_frame():
    modes = read_f06(FILES / "turned.f06", SENSORS, FILES / "turned.bdf")
    frame = portal()
    squares, shapes = eigh(frame.K([2.1e11]).toarray(), frame.M([2.1e11]).toarray())
    np.testing.assert_allclose(modes.frequencies_hz, np.sqrt(squares[:4]) / (2.0 * np.pi), rtol=1e-6)
    wanted = frame.observation([(IDS.index(node), d) for node, d in SENSORS]) @ shapes[:, :4]
    sign = np.sign(np.sum(wanted * modes.shapes, axis=0))
    np.testing.assert_allclose(sign * modes.shapes, wanted, atol=2e-6 * np.abs(shapes).max())
    assert modes.labels == ("1", "2", "3", "4")


def test_a_table_as_msc_prints_it(tmp_path):
    (tmp_path / "a.f06").write_text(MSC)
    modes = read_f06(tmp_path / "a.f06", [(7, "x"), (7, "-z"), (8, "x")])
    assert modes.frequencies_hz.tolist() == [10.0]
    assert modes.shapes.ravel().tolist() == [1.0, 0.25, 0.4]


def test_in_a_problem_file(tmp_path):
    for name in ("turned.f06", "turned.bdf", "turned.op4"):
        shutil.copy(FILES / name, tmp_path)
    (tmp_path / "portal.toml").write_text("""
name = "portal"
error = "frequency"
model = { type = "matrices", mesh = "turned.bdf", stiffness = [{ file = "turned.op4", variable = "KGG", powers = { k = 1 } }], mass = [{ file = "turned.op4", variable = "MGG" }] }
[measurement]
f06 = { file = "turned.f06", deck = "turned.bdf", modes = [1, 2, 3] }
sd = 0.1
sensors = [[205, "x"], [205, "y"], [303, "z"], [410, "y"]]
[[parameters]]
name = "k"
start = 1.0
lower = 0.5
upper = 2.0
prior = { distribution = "uniform" }
""")  # noqa: E501
    check = fmu.check(fmu.load(tmp_path / "portal.toml"), draws=2)
    assert check.shapes["mac"].to_numpy()[0].diagonal().min() > 0.999999


@pytest.mark.parametrize(
    ("change", "options", "message"),
    [
        (("R E A L   E I", "N O"), {}, "real eigenvectors"),
        (("CYCLES", "LOOPS"), {}, "frequencies above 0 Hz"),
        (("", ""), {"sensors": [(9, "x")]}, "nodes of the file .got 9"),
        (("", ""), {"modes": [2]}, "modes: must be some of 1"),
        (("", ""), {"deck": Path("nothing.bdf")}, "deck: must be a file"),
        (("1.000000E+01", "9.999999E+99999"), {}, "finite|infinite|above"),
    ],
)
def test_broken_files_are_refused(tmp_path, change, options, message):
    (tmp_path / "a.f06").write_text(MSC.replace(*change))
    with pytest.raises(ModesError, match=message):
        read_f06(tmp_path / "a.f06", **{"sensors": [(7, "x")], **options})
