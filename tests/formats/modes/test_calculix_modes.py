"""Modes that CalculiX prints: read as they stand, and refused if a part is missing."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from fmu.formats.modes import READERS
from fmu.formats.modes.calculix import computed_calculix
from fmu.formats.modes.measured_modes import ModesError

TABLE = """
     E I G E N V A L U E   O U T P U T

 MODE NO    EIGENVALUE                       FREQUENCY   
                                     REAL PART            IMAGINARY PART
                           (RAD/TIME)      (CYCLES/TIME     (RAD/TIME)

      1   0.4669882E+04   0.6833654E+02   0.1087610E+02   0.0000000E+00
      2   0.1162188E+06   0.3409089E+03   0.5425733E+02   0.0000000E+00

     P A R T I C I P A T I O N   F A C T O R S

MODE NO.   X-COMPONENT     Y-COMPONENT     Z-COMPONENT     X-ROTATION      Y-ROTATION      Z-ROTATION

      1  -0.7594347E-13  -0.1174146E-11   0.1049922E+02   0.2099844E+01  -0.6096381E+01  -0.6849247E-12
"""  # noqa: W291
SHAPES = """
                    E I G E N V A L U E    N U M B E R     1


 displacements (vx,vy,vz) for set SENSORS and time  0.1000000E+01

         9 -1.470308E-14 -4.517074-114  4.471053E-01
        45  1.110396E-14 -4.577989E-14  4.400000E-01

 forces (fx,fy,fz) for set ALL and time  0.1000000E+01

         9  9.000000E+00  9.000000E+00  9.000000E+00

                    E I G E N V A L U E    N U M B E R     2


 displacements (vx,vy,vz) for set SENSORS and time  0.1000000E+01

         9  1.124968E-15  1.300175E-14  6.674717E-01

 displacements (vx,vy,vz) for set OTHER and time  0.1000000E+01

        45  1.124968E-15  1.300175E-14 -6.674717E-01
"""
SENSORS = ((45, "z"), (9, "-z"), (9, "y"))


@pytest.fixture
def write(tmp_path):
    def written(text):
        (tmp_path / "job.dat").write_text(text)
        return tmp_path / "job.dat"

    return written


def test_frequencies_and_shapes_at_the_sensors(write):
    frequencies, shapes = computed_calculix(write(TABLE + SHAPES), SENSORS)
    assert_array_equal(frequencies, [10.87610, 54.25733])
    assert_array_equal(shapes, [[0.44, -0.6674717], [-0.4471053, -0.6674717], [-4.517074e-114, 1.300175e-14]])


def test_without_sensors_there_are_no_shapes(write):
    assert computed_calculix(write(TABLE))[1] is None


def test_the_last_step_counts(write):
    assert computed_calculix(write(TABLE.replace("0.1087610E+02", "0.1E+01") + SHAPES + TABLE))[0][0] == 10.87610


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", r"job\.dat has no table of eigenvalues: the deck needs \*FREQUENCY"),
        ("\x00\xff" * 100, r"job\.dat has no table of eigenvalues"),
        (TABLE[:200], r"job\.dat has no eigenvalues in its table"),
        (TABLE[: TABLE.index("0.5425733E+02")], r"job\.dat: its table of eigenvalues is cut off \(got '.*'\)"),
        (TABLE.replace("0.1087610E+02", "**********"), r"job\.dat: must have numbers \(got '\*{10}'\)"),
        (TABLE, r"job\.dat has shapes of 0 modes and frequencies of 2: the deck needs \*NODE PRINT with U"),
        (TABLE + SHAPES.partition("E I G E N V A L U E    N U M B E R     2")[0], r"has shapes of 1 modes"),
        (
            TABLE + SHAPES.replace("        45", "        46"),
            r"has no displacement of node 45: it must be in a \*NODE",
        ),
        ((TABLE + SHAPES)[:-20], r"has no displacement of node 45"),
        (
            TABLE + SHAPES.replace("4.471053E-01", "4.471053E-01 L"),
            r"job\.dat has, for node 9, displacements along the axes of \*TRANSFORM: .* needs GLOBAL=YES",
        ),
    ],
)
def test_what_is_missing_is_told(write, text, said):
    with pytest.raises(ValueError, match=said):
        computed_calculix(write(text), SENSORS)


def test_no_file(tmp_path):
    with pytest.raises(ValueError, match=r"no such file"):
        computed_calculix(tmp_path / "job.dat")


def test_numbers_are_finite_or_told_by_the_model(write):
    assert np.isnan(computed_calculix(write(TABLE.replace("0.1087610E+02", "NaN")))[0][0])


def test_as_measured_modes(tmp_path):
    """Modes are taken by their numbers; those at 0 Hz, and sensors that are not printed, are refused."""
    path = tmp_path / "job.dat"
    path.write_text(TABLE + SHAPES)
    modes = READERS["calculix"].read(path, [(9, "-z"), (45, "x")], modes=[1])
    assert modes.labels == ("1",)
    assert_array_equal(modes.frequencies_hz, [10.87610])
    assert_array_equal(modes.shapes, [[-4.471053e-01], [1.110396e-14]])
    for sensors, chosen, message in [
        ([(9, "rx")], None, r"sensors: must be nodes, and x, y or z \(got '9 rx'\)"),
        ([(9, "z")], [3], r"modes: must be some of 1 and 2|modes: must be some of 1, 2"),
        ([(7, "z")], None, "has no displacement of node 7"),
    ]:
        with pytest.raises(ModesError, match=message):
            READERS["calculix"].read(path, sensors, chosen)
    path.write_text((TABLE + SHAPES).replace("0.1087610E+02", "0.0000000E+00"))
    with pytest.raises(ModesError, match=r"above 0 Hz \(mode 1 has none"):
        READERS["calculix"].read(path, [(9, "z")])
