"""Eigenvectors in the printed output of Nastran, along the axes of each node."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import eigh

import fmu
from fmu.formats.modes.f06 import computed_f06, read_f06
from fmu.formats.modes.measured_modes import ModesError
from tests.formats.models.write_with_pynastran import IDS, portal

FILES = Path(__file__).parents[1] / "models" / "nastran"
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


MYSTRAN = """\
 MYSTRAN Version 18.0.0   APR 20 2026 MYSTRAN developed by Dr Bill Case

                                            R E A L   E I G E N V A L U E S
    MODE  EXTRACTION      EIGENVALUE           RADIANS              CYCLES            GENERALIZED   GENERALIZED
   NUMBER   ORDER                                                                        MASS        STIFFNESS
        1       1      0.000000E+00        0.000000E+00        0.000000E+00        1.000000E+00        0.000000E+00
        2       2      5.526178E+04        2.350782E+02        3.741386E+01        1.000000E+00        5.526178E+04

 OUTPUT FOR EIGENVECTOR        1

                                                         E I G E N V E C T O R
                                              (in global coordinate system at each grid)
           GRID     COORD      T1            T2            T3            R1            R2            R3
                     SYS
              2        0  1.0           0.0           1.469285E-01  1.488433E-01 -9.498478E-01  0.0

                         ------------- ------------- ------------- ------------- ------------- -------------
                MAX* :    1.497977E-20  3.329834E-20  5.151302E-01  1.488433E-01  0.0           1.131326E-19

 OUTPUT FOR EIGENVECTOR        1

                                     S I N G L E   P O I N T   C O N S T R A I N T   F O R C E S
              2        0  9.0           9.0           9.0           9.0           9.0           9.0
 OUTPUT FOR EIGENVECTOR        2
                                                         E I G E N V E C T O R
              2        0  9.713463E-20  0.0          -2.715434E-01  1.609491E+00  6.414785E-01  0.0
"""


def test_a_table_as_mystran_prints_it(tmp_path):
    """Forces of a mode have the same title, and are not its shape."""
    (tmp_path / "a.F06").write_text(MYSTRAN)
    modes = read_f06(tmp_path / "a.F06", [(2, "z"), (2, "-rx")], modes=[2])
    assert modes.frequencies_hz.tolist() == [37.41386]
    assert modes.shapes.ravel().tolist() == [-0.2715434, -1.609491]
    with pytest.raises(ModesError, match=r"must have frequencies above 0 Hz .mode 1 has none"):
        read_f06(tmp_path / "a.F06", [(2, "z")])


def table(frequencies, heading=""):
    lines = [f"  {i}  {i}  1.0E+00  1.0E+00  {f:.6E}  1.0E+00  1.0E+00" for i, f in enumerate(frequencies, 1)]
    return "\n".join(["     R E A L   E I G E N V A L U E S", heading, *lines, ""])


def test_several_subcases_are_refused(tmp_path):
    """Frequencies were those of the first subcase, and shapes those of the last."""
    path = tmp_path / "a.f06"
    second = MSC.replace("1.000000E+01", "1.100000E+01")
    for text, sensors in ((MSC + second, [(7, "x")]), (table([1.0, 2.0]) + table([11.0, 12.0]), [])):
        path.write_text(text)
        with pytest.raises(ModesError, match=r"a.f06: must have the modes of one subcase.*mode 1 has 1"):
            computed_f06(path, sensors, path)
    path.write_text(table([10.0]) + MSC + MSC)  # a mode on two pages
    assert computed_f06(path, [(7, "x")], path)[0].tolist() == [10.0]
    before, after = "(BEFORE AUGMENTATION OF RESIDUAL VECTORS)", "(AFTER AUGMENTATION OF RESIDUAL VECTORS)"
    path.write_text(table([1.0, 3.0], before) + table([1.0, 2.0, 3.0], after))
    assert computed_f06(path, [], path)[0].tolist() == [1.0, 2.0, 3.0]


def test_what_a_program_said_when_it_failed(tmp_path):
    line = " *ERROR  1822: GRID        0 ON CONM2          4 IS UNDEFINED"
    (tmp_path / "a.f06").write_text(f"{line}\n *ERROR  1: another\n")
    with pytest.raises(
        ModesError, match=r"got none; DISP = ALL, .*; it says: '\*ERROR 1822: GRID 0 ON CONM2 4 IS UN"
    ):
        read_f06(tmp_path / "a.f06", [(2, "z")])
