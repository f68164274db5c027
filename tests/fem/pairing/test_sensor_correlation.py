"""Correlation of test and model: closed forms, and a sensor at the wrong place is the one that is named."""

import numpy as np
import pytest

from fmu.fem.modes.modal import mac
from fmu.fem.pairing.correlation import (
    Correlation,
    close_groups,
    comac,
    ecomac,
    scale_shapes,
    subspace_mac,
)

SENSORS = 12


def chain(n=SENSORS, modes=4):
    """Return the lowest modes of a chain held at one end: sin((2k−1)π/2 · j/n)."""
    x = np.arange(1, n + 1) / n
    return np.sin(np.outer(x, (2 * np.arange(1, modes + 1) - 1) * np.pi / 2))


def found(measured, computed, groups=()):
    names = tuple(f"{j} x" for j in range(len(measured)))
    return Correlation(names, tuple(map(str, range(1, measured.shape[1] + 1))), measured, computed, groups)


def noisy(shapes, sd=0.02, seed=1):
    return shapes + sd * np.random.default_rng(seed).normal(size=shapes.shape)


def test_of_equal_shapes_in_any_scale_and_sign():
    phi = chain()
    measured = phi * np.array([3.0, -0.1, 7.0, -1.0])
    assert comac(measured, phi) == pytest.approx(np.ones(SENSORS), rel=1e-12)
    assert ecomac(measured, phi) == pytest.approx(np.zeros(SENSORS), abs=1e-12)


def test_by_hand():
    """Two sensors, one mode: φ = (1, 1), ψ = (2, 1)·√(2/5), c = √(2/5) by the weighted median or 2√(2/5)."""
    measured, computed = np.array([[1.0], [1.0]]), np.array([[2.0], [1.0]])
    phi, psi = scale_shapes(measured, computed)
    assert psi[:, 0] == pytest.approx(np.array([2.0, 1.0]) * np.sqrt(2 / 5))
    assert np.abs(phi - psi).sum() == pytest.approx(np.sqrt(2 / 5))  # the least of |c − 2s| + |c − s|
    assert comac(measured, computed) == pytest.approx([1.0, 1.0])
    measured = np.array([[1.0, 1.0], [1.0, -1.0], [1.0, 1.0]])
    computed = np.array([[1.0, 1.0], [1.0, -1.0], [1.0, 0.0]])
    size = np.sqrt(2 / 3)  # of the second computed shape
    assert comac(measured, computed)[2] == pytest.approx(1 / (1 + size**-2 * 1.0), rel=1e-12)
    assert ecomac(measured, computed) == pytest.approx([0.0, 0.0, 0.25 / size])


@pytest.mark.parametrize("scale", [5.0, -5.0])
def test_one_wrong_sensor_does_not_spoil_the_scale_of_the_others(scale):
    phi = chain(6, 3)
    measured = scale * phi
    measured[5] *= -1  # it holds a third of the energy and more
    error = ecomac(measured, phi)
    assert error[:5] == pytest.approx(np.zeros(5), abs=1e-12)
    assert error[5] > 1.0


@pytest.mark.parametrize("seed", range(5))
def test_nothing_is_named_where_there_is_noise_alone(seed):
    assert len(found(noisy(chain(), 0.05, seed), chain()).suspects) == 0


@pytest.mark.parametrize("at", [2, 5, 8, 11])
def test_a_sensor_of_the_wrong_sign_is_named_with_what_to_do(at):
    measured = noisy(chain())
    measured[at] *= -1
    told = found(measured, chain())
    assert told.suspects.tolist() == [at]
    (sentence,) = told.doubts_of_sensors()
    assert sentence.startswith(f"Sensor {at} x: test and model disagree")
    assert "with the opposite sign it would agree" in sentence
    assert told.comac[at] > 0.95  # blind to signs


@pytest.mark.parametrize(("at", "instead"), [(2, 8), (11, 3), (6, 1)])
def test_a_sensor_put_at_a_wrong_node_is_named(at, instead):
    measured = noisy(chain())
    measured[at] = noisy(chain())[instead]
    told = found(measured, chain())
    assert told.suspects[0] == at
    assert "look at its place" in told.doubts_of_sensors()[0]
    assert np.argmin(told.comac) == at


def test_two_sensors_exchanged_are_both_named():
    measured = noisy(chain())
    measured[[3, 9]] = measured[[9, 3]]
    told = found(measured, chain())
    assert set(told.suspects.tolist()) == set(told.exchanged) == {3, 9}
    (sentence,) = told.doubts_of_sensors()
    assert sentence.startswith("Sensors 3 x and 9 x: exchanged, they would agree with the model (ECoMAC 0.")


@pytest.mark.parametrize("pair", [[0, 1], [0, 3], [1, 2], [2, 3]])
def test_two_of_four_sensors_exchanged_are_named(pair):
    """Half of the sensors are wrong, so that neither stands out from the median."""
    measured = noisy(chain(4, 3))
    measured[pair] = measured[pair[::-1]]
    told = found(measured, chain(4, 3))
    assert list(told.exchanged) == pair
    assert told.sensors_in_doubt() == f"sensors {pair[0]} x and {pair[1]} x"


@pytest.mark.parametrize("seed", range(5))
def test_other_errors_are_no_exchange(seed):
    for n in (4, 12):
        measured = noisy(chain(n, 3), 0.05, seed)
        assert found(measured, chain(n, 3)).exchanged == ()
        measured[seed % n] *= -1.0
        assert found(measured, chain(n, 3)).exchanged == ()


def test_a_sensor_of_a_wrong_scale_is_named():
    """Microvolts taken for millivolts are found by ECoMAC; CoMAC does not see them."""
    measured = noisy(chain())
    measured[7] *= 2.5
    told = found(measured, chain())
    assert told.suspects.tolist() == [7]
    assert told.comac[7] > 0.95
    assert "look at its place" in told.doubts_of_sensors()[0]


def test_few_sensors_and_one_mode_name_nothing():
    measured = chain(3, 3)
    measured[1] *= -1
    assert len(found(measured, chain(3, 3)).suspects) == 0
    measured = chain()[:, :1].copy()
    measured[5] *= -1
    assert len(found(measured, chain()[:, :1]).suspects) == 0


def test_close_modes_turned_into_each_other_agree_as_a_space():
    phi = chain()
    turn = np.array([[np.cos(0.7), -np.sin(0.7)], [np.sin(0.7), np.cos(0.7)]])
    measured = phi.copy()
    measured[:, 1:3] = phi[:, 1:3] @ turn
    single = mac(phi, measured)
    assert single[1, 1] == pytest.approx(np.cos(0.7) ** 2, abs=0.05)
    assert subspace_mac(measured[:, 1:3], phi[:, 1:3]) == pytest.approx([1.0, 1.0], rel=1e-12)
    told = found(measured, phi, ((1, 2),))
    assert told.subspace == pytest.approx({1: 1.0, 2: 1.0})
    assert "Modes 2 and 3 are close: their measured shapes lie in the space" in told.notes()[0]
    other = found(measured, phi[:, [0, 1, 3, 2]], ((1, 2),))  # the second computed mode is another one
    assert other.subspace[1] < 0.05
    assert other.notes() == []


def test_the_subspace_of_one_shape_is_its_mac():
    rng = np.random.default_rng(2)
    a, b = rng.normal(size=(2, 7, 1))
    assert subspace_mac(a, b) == pytest.approx(mac(b, a)[0], rel=1e-12)
    assert subspace_mac(np.hstack([a, 2 * a]), np.hstack([a, b]))[-1] == pytest.approx(0.0, abs=1e-12)
    assert subspace_mac(a, np.zeros((7, 1)))[0] == 0.0


def test_principal_angles_are_those_of_scipy():
    from scipy.linalg import subspace_angles

    rng = np.random.default_rng(4)
    a, b = rng.normal(size=(9, 3)), rng.normal(size=(9, 2))
    assert subspace_mac(a, b) == pytest.approx(np.cos(subspace_angles(a, b)[::-1]) ** 2, rel=1e-10)


def test_groups_are_those_that_are_close_in_test_or_model():
    assert close_groups([10.0, 10.05, 20.0, 30.0, 30.1]) == ((0, 1), (3, 4))
    assert close_groups([10.0, 12.0, 20.0], [10.0, 20.1, 20.0]) == ((1, 2),)
    assert close_groups([10.0, 10.08, 10.16, 12.0]) == ((0, 1, 2),)  # each is close to the next
    assert close_groups([10.0]) == ()


def test_alike_shapes_are_told_whatever_the_model():
    phi = chain()
    near, nearer = (np.stack([phi[:, 0], phi[:, 0] + s * phi[:, 1]], axis=1) for s in (0.4, 0.2))
    (sentence,) = found(nearer, phi[:, :2]).doubts_of_modes()
    assert sentence.startswith("The measured shapes of modes 1 and 2 are alike at the sensors (AutoMAC 0.9")
    assert found(near, phi[:, :2]).doubts_of_modes() == []
    assert found(phi, phi).doubts_of_modes() == []
