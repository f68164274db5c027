"""Measured modes: defaults, plain description, wrong input."""

import json
import re

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from fmu.posterior.data.modal_data import ModalData


def test_defaults():
    data = ModalData([31.9, 197.9, 553.0])
    assert data.n_modes == 3
    assert data.numbers == (1, 2, 3)
    assert data.labels == ("1", "2", "3")
    assert data.sensors == ()


def test_frequencies_are_a_copy_that_cannot_be_written():
    given = np.array([31.9, 197.9])
    data = ModalData(given)
    given[0] = 1.0
    assert_array_equal(data.frequencies_hz, [31.9, 197.9])
    with pytest.raises(ValueError, match="read-only"):
        data.frequencies_hz[0] = 2.0


def test_description_is_plain_python():
    nodes = np.arange(2)
    data = ModalData(
        np.array([31.9, 197.9]),
        numbers=tuple(np.array([1, 3])),
        sensors=tuple((node, "z") for node in nodes),
        labels=("first", "second"),
    )
    described = json.loads(json.dumps(data.as_dict()))
    assert described == {
        "frequencies_hz": [31.9, 197.9],
        "numbers": [1, 3],
        "sensors": [[0, "z"], [1, "z"]],
        "labels": ["first", "second"],
    }


def test_measured_shapes():
    given = np.array([[1.0, 0.5], [0.0, -2.0]])
    data = ModalData([31.9, 197.9], sensors=((3, "z"), (5, "z")), shapes=given)
    assert data.as_dict()["shapes"] == [[1.0, 0.5], [0.0, -2.0]]
    assert "shapes" not in ModalData([31.9]).as_dict()
    assert "counterparts" not in ModalData([31.9]).as_dict()
    assert ModalData([31.9, 32.0], counterparts=(2, 1)).as_dict()["counterparts"] == [2, 1]
    given[0] = 9.0
    assert_array_equal(data.shapes, [[1.0, 0.5], [0.0, -2.0]])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"frequencies_hz": []}, r"frequencies_hz: must be a list of numbers \(got shape \(0,\)\)"),
        ({"frequencies_hz": 31.9}, r"frequencies_hz: must be a list of numbers \(got shape \(\)\)"),
        ({"frequencies_hz": [[31.9]]}, r"frequencies_hz: must be a list of numbers \(got shape \(1, 1\)\)"),
        ({"frequencies_hz": [31.9, 0.0]}, r"frequencies_hz\.1: must be positive and finite \(got 0\.0 Hz\)"),
        ({"frequencies_hz": [31.9, -2.0]}, r"frequencies_hz\.1: must be positive and finite \(got -2\.0 Hz\)"),
        ({"frequencies_hz": [np.nan, 1.0]}, r"frequencies_hz\.0: must be positive and finite \(got nan Hz\)"),
        ({"frequencies_hz": [np.inf]}, r"frequencies_hz\.0: must be positive and finite \(got inf Hz\)"),
        ({"frequencies_hz": [1.0, 2.0], "numbers": (1,)}, r"numbers: must be 2, one per mode \(got 1\)"),
        (
            {"frequencies_hz": [1.0], "sensors": ((1, "z"),), "shapes": [[1.0], [2.0]]},
            r"shapes: must have shape \(1, 1\), sensors x modes \(got \(2, 1\)\)",
        ),
        (
            {"frequencies_hz": [1.0, 2.0], "sensors": ((1, "z"),), "shapes": [[1.0, 0.0]], "labels": ("a", "b")},
            r"shapes: must not be zero at every sensor: .* leave the mode out \(got zeros for mode b\)",
        ),
        (
            {"frequencies_hz": [1.0], "sensors": ((1, "z"),), "shapes": [[np.nan]]},
            r"shapes: must be finite: leave out the sensor or the mode \(got nan at sensor 1 of mode 1\)",
        ),
        ({"frequencies_hz": [1.0], "labels": ("a", "b")}, r"labels: must be 1, one per mode \(got 2\)"),
        *(
            (
                {"frequencies_hz": [1.0, 2.0], "counterparts": wrong},
                rf"counterparts: must be 2 distinct numbers from 1, one per mode \(got {re.escape(str(wrong))}\)",
            )
            for wrong in ((1,), (2, 2), (0, 1))
        ),
        (
            {"frequencies_hz": [1.0], "sensors": ((1, "z"),), "shapes": [[1.0]], "counterparts": (2,)},
            r"counterparts: must not be given together with shapes, which pair the modes",
        ),
    ],
)
def test_wrong_data(arguments, message):
    with pytest.raises(ValueError, match=f"^{message}$"):
        ModalData(**arguments)


def test_uncertainty_is_kept_and_described():
    data = ModalData([31.9, 197.9], sensors=((3, "z"),), shapes=[[1.0, 2.0]], sd_hz=0.1, shapes_sd=[0.01, 0.02])
    assert_array_equal(data.sd_hz, [0.1, 0.1])
    assert_array_equal(data.shapes_sd, [[0.01, 0.02]])
    described = json.loads(json.dumps(data.as_dict()))
    assert described["sd_hz"] == [0.1, 0.1]
    assert described["shapes_sd"] == [[0.01, 0.02]]
    assert "covariance_hz2" not in described
    covariance = [[0.01, 0.001], [0.001, 0.04]]
    assert ModalData([31.9, 197.9], covariance_hz2=covariance).as_dict()["covariance_hz2"] == covariance


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"sd_hz": [0.1]}, r"sd_hz: must be a number or have shape \(2,\), one per mode \(got \(1,\)\)"),
        ({"sd_hz": [0.1, 0.0]}, r"sd_hz: must be positive and finite \(got 0\.0\)"),
        ({"sd_hz": np.nan}, r"sd_hz: must be positive and finite \(got nan\)"),
        (
            {"sd_hz": 0.1, "covariance_hz2": np.eye(2)},
            r"sd_hz: must not be given together with covariance_hz2 \(got array.*\)",
        ),
        ({"shapes_sd": 0.1}, r"shapes_sd: must not be given without shapes"),
        (
            {"shapes_sd": [[0.1]], "shapes": [[1.0, 2.0], [1.0, 1.0]], "sensors": ((1, "x"), (2, "x"))},
            r"shapes_sd: must be a number or have shape \(2, 2\), sensors x modes \(got \(1, 1\)\)",
        ),
        (
            {"shapes_sd": -1.0, "shapes": [[1.0, 2.0], [1.0, 1.0]], "sensors": ((1, "x"), (2, "x"))},
            r"shapes_sd: must be positive and finite \(got -1\.0\)",
        ),
    ],
)
def test_wrong_uncertainty(arguments, message):
    with pytest.raises(ValueError, match=f"^{message}$"):
        ModalData([31.9, 197.9], **arguments)
