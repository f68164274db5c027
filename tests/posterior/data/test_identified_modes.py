"""Modes that sdypy-EMA identifies from FRFs: of a chain, and of a slow structure."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest

import fmu
from tests.oscillators import chain, measured, receptances

ROW = [(0, 0), (1, 0), (2, 0)]
TRUE = np.sqrt(chain()[0]) / 2 / np.pi


def mac(one, other):
    return (one.T @ other) ** 2 / np.outer(np.sum(one**2, axis=0), np.sum(other**2, axis=0))


def test_the_library_is_asked_for(monkeypatch):
    monkeypatch.setitem(sys.modules, "sdypy", None)
    with pytest.raises(ImportError, match=r"identified by sdypy-EMA: install fmu\[ema\]"):
        measured(ROW).identify_modes()


def test_lines_it_cannot_take():
    for f, message in (
        (np.geomspace(1.0, 60.0, 400), "evenly spaced, at multiples of the spacing"),
        (np.arange(1.05, 60.0, 0.1), r"\(got 1.05, 1.15, … Hz\); pick_frequencies takes any lines"),
        (np.arange(8.0, 12.0, 0.2), r"at least 40 lines in use \(got 20\)"),
    ):
        with pytest.raises(ValueError, match=f"frequencies_hz: must be .*{message}"):
            measured(ROW, f=f).identify_modes()
    with pytest.raises(ValueError, match=r"reference: must be a drive or a response, one of 0 x, 0 x, 1 x, 2 x"):
        measured(ROW).identify_modes(reference=(7, "x"))


@pytest.mark.parametrize("k", range(3))
@pytest.mark.parametrize("band", [None, (5.0, 50.0)])
def test_modes_of_a_chain(k, band):
    pytest.importorskip("sdypy.EMA", reason="needs sdypy-EMA: make test-programs")
    found = measured(ROW, k, noise=0.05, seed=k, band=band).identify_modes()
    np.testing.assert_allclose(found.modes.frequencies_hz, TRUE, rtol=1e-3)
    np.testing.assert_allclose(found.damping, [0.01, 0.02, 0.01], rtol=0.1)
    assert np.diag(mac(found.modes.shapes, chain()[1])).min() > 0.999
    assert found.modes.sensors == ((0, "x"), (1, "x"), (2, "x"))
    assert len(found.missed_hz) == 0
    assert len(measured(ROW, k, band=band).identify_modes(2).damping) == 2


def test_a_roving_hammer_with_a_reversed_direction():
    pytest.importorskip("sdypy.EMA", reason="needs sdypy-EMA: make test-programs")
    data = measured([(1, 0), (1, 1), (1, 2)])
    turned = fmu.FRFData(data.frequencies_hz, -data.values, data.drives, ((1, "-x"),) * 3)
    found = turned.identify_modes(reference=(1, "-x"))
    assert found.modes.sensors == data.drives
    assert np.diag(mac(found.modes.shapes, chain()[1])).min() > 1 - 1e-4


def test_a_slow_structure():
    """0.5 Hz and 12 % apart: sdypy-EMA's own window, of 2 Hz, would take the two modes for one."""
    pytest.importorskip("sdypy.EMA", reason="needs sdypy-EMA: make test-programs")
    f = np.arange(0.1, 1.0, 0.001)
    shapes = np.array([[1.0, 0.6], [-0.6, 1.0]])
    values = receptances(
        f, (2 * np.pi * np.array([0.50, 0.56])) ** 2, shapes, np.array([0.01, 0.01]), [(0, 0), (1, 0)]
    )
    data = fmu.FRFData(f, values, ((0, "y"), (0, "y")), ((0, "y"), (1, "y")), "receptance")
    found = data.identify_modes()
    np.testing.assert_allclose(found.modes.frequencies_hz, [0.50, 0.56], rtol=1e-4)
    np.testing.assert_allclose(found.damping, 0.01, rtol=0.02)
    assert np.diag(mac(found.modes.shapes, shapes)).min() > 0.999


class Poles:
    """Stands for sdypy-EMA's model: a pole at the first resonance, one that grows, and one 1.5 % off the third."""

    def __init__(self, frf, freq, **settings):
        self.freq, self.nat_xi = freq, np.array([0.01, -0.02, 0.01])

    def get_poles(self, **settings):
        pass

    def select_closest_poles(self, near, **settings):
        self.nat_freq = np.array(near) * [1.0, 1.0, 1.015]

    def get_constants(self, **settings):
        shapes = chain()[1]
        return None, np.concatenate([shapes * shapes[0], np.zeros((3, 2))], axis=1)


def test_poles_that_grow_are_no_modes_and_those_within_a_bandwidth_are(monkeypatch):
    monkeypatch.setitem(sys.modules, "sdypy", SimpleNamespace(EMA=SimpleNamespace(Model=Poles)))
    found = measured(ROW).identify_modes()
    np.testing.assert_allclose(found.missed_hz, TRUE[1:2], rtol=1e-3)
    np.testing.assert_allclose(found.modes.frequencies_hz, TRUE[[0, 2]] * [1.0, 1.015], rtol=1e-3)
    np.testing.assert_allclose(found.damping, [0.01, 0.01])
    assert np.diag(mac(found.modes.shapes, chain()[1][:, [0, 2]])).min() > 1 - 1e-9
