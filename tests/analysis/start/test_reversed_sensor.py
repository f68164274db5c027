"""A sensor that is upside down may change the pairing so that it hardly stands out; it is named all the same."""

import numpy as np
import pytest

import fmu
from fmu.analysis.start.pairing_doubts import ComputedMode, find_reversed_sensor
from fmu.config.template import template
from fmu.fem.modes.modal import assign, mac
from fmu.fem.pairing.correlation import Correlation
from fmu.report.check_page import check_page

UPRIGHT = '["quarter", "z"]'
QUESTION = "Do the sensors agree with the model?"


def checked(folder, change=lambda text: text):
    """Check the template of a frame with its optional shapes, after a change of its text."""
    path = folder / "beam.toml"
    path.write_text(change(template("frame").replace("#: sensors", "sensors").replace("#: shapes", "shapes")))
    return fmu.check(fmu.load(path), draws=10)


def verdict(found):
    return next(one for one in check_page(found).verdicts if one.question == QUESTION)


@pytest.mark.usefixtures("quick_figures")
def test_a_find_reversed_sensor_that_the_pairing_absorbs_is_named(tmp_path):
    found = checked(tmp_path, lambda text: text.replace(UPRIGHT, '["quarter", "-z"]'))
    assert found.modes.correlation.suspects.size == 0  # CoMAC and ECoMAC of the wrong pairs do not tell it
    (said,) = found.sensor_doubts
    assert said.startswith("Sensor quarter -z: with the opposite sign, the modes would be paired in the order of")
    assert "MAC at least 1.00" in said
    assert said in found.doubts
    assert (verdict(found).answer, verdict(found).is_good) == ("1 warning", False)


@pytest.mark.usefixtures("quick_figures")
def test_sensors_as_they_are_agree(tmp_path):
    found = checked(tmp_path)
    assert found.doubts == ()
    assert (verdict(found).answer, verdict(found).is_good) == ("Yes", True)


@pytest.mark.usefixtures("quick_figures")
def test_sensors_are_not_said_to_agree_while_the_pairing_is_in_doubt(tmp_path):
    """The measured frequencies of two modes are exchanged: no sensor's sign would put that right."""
    found = checked(tmp_path, lambda text: text.replace("[5.12, 15.42,", "[15.42, 5.12,"))
    assert any("in different orders" in one for one in found.modes.doubts)
    assert found.sensor_doubts == ()
    assert (verdict(found).answer, verdict(found).is_good) == ("Unknown while the pairing is in doubt", None)


def test_a_sign_is_named_only_if_one_alone_explains_the_pairing():
    """Of random shapes: none is named where all signs are right, and no right one where one or two are wrong."""
    rng = np.random.default_rng(1)
    names, hz = tuple(f"s{j}" for j in range(8)), np.arange(1.0, 6.0)
    modes = [ComputedMode(k + 1, f, None) for k, f in enumerate(hz)]
    signs, told = np.ones((8, 1)), []
    for _ in range(40):
        computed = rng.standard_normal((8, 5))
        shapes = computed[:, :3] + 0.02 * rng.standard_normal((8, 3))
        j, other = rng.choice(8, 2, replace=False)
        named = []
        for wrong in ((), (j,), (j, other)):
            turned = signs.copy()
            turned[list(wrong)] = -1.0
            paired = assign(mac(computed, turned * shapes)[None], hz[None], hz[:3])[0]
            measured = Correlation(names, ("1", "2", "3"), turned * shapes, computed[:, paired])
            named.append(find_reversed_sensor(measured, computed, modes, hz[:3]).partition(":")[0])
        assert named[0] == ""
        assert named[1] in ("", f"Sensor s{j}")
        assert named[2] in ("", f"Sensor s{j}", f"Sensor s{other}")
        told.append(bool(named[1]))
    assert any(told)
