"""Simulated frequency response functions of a shear building of three storeys with damping."""

from functools import cache

import numpy as np

import fmu
from tests.shear_building import frequencies_hz, shear_building

NAMES = ("k1", "k2", "k3")
STIFFNESS, MASS = 2.0e6, 1000.0
TRUTH = np.array([1.1, 0.9, 1.05])
RATIOS = np.array([0.012, 0.02, 0.015])
LINES = np.linspace(1.0, 16.0, 120)
POINTS = ((2, "x"), (0, "x"))


def building():
    """Return the model, with a parameter of 1 for each storey."""
    return shear_building(NAMES, STIFFNESS, MASS, dofs=[(i, "x") for i in range(3)])


def frequencies(theta):
    """Return the frequencies, Hz."""
    return frequencies_hz(building(), theta)[0]


def receptances(theta=TRUTH, ratios=RATIOS, lines=LINES, points=POINTS, drive=(2, "x")):
    """Return the receptances (n_points, n_lines) by the sum over the modes of LAPACK."""
    model = building()
    f, shapes = frequencies_hz(model, theta)
    shapes = shapes / np.sqrt(MASS)  # of unit length before
    w, wr = 2 * np.pi * lines, 2 * np.pi * f
    at = [shapes[place] for place, _ in points]
    g = 1.0 / (wr[:, None] ** 2 - w**2 + 2j * np.asarray(ratios)[:, None] * wr[:, None] * w)
    return np.array([(one * shapes[drive[0]]) @ g for one in at])


def simulate(noise=0.03, seed=0, kind="accelerance", distort=lambda H, w: H, **options):
    """Return simulated FRFData with a relative error of the real and of the imaginary part."""
    rng, w = np.random.default_rng(seed), 2 * np.pi * LINES
    H = distort(receptances(), w) * (1j * w) ** ("receptance", "mobility", "accelerance").index(kind)
    sd = noise * np.abs(H)
    values = H + sd * (rng.standard_normal(H.shape) + 1j * rng.standard_normal(H.shape))
    return fmu.FRFData(LINES, values, ((2, "x"),) * 2, POINTS, kind, **({"sd": sd} | options))


def parameters():
    return [fmu.Parameter(name, 1.0, 0.6, 1.6) for name in NAMES]


def ratios():
    return [fmu.Parameter(f"zeta{i}", 0.015, 0.001, 0.1, fmu.LogNormal(0.015, 0.5)) for i in (1, 2, 3)]


def modes():
    f, _ = frequencies_hz(building(), TRUTH)
    return fmu.ModalData(f * [1.002, 0.997, 1.004], sd_hz=0.01 * f, numbers=(1, 2, 3), sensors=POINTS)


@cache
def problem(scale="linear", noise=0.03, seed=0, kind="accelerance", others=(), damping=None, **options):
    """Return the problem of the simulated FRFs alone, or beside the errors `others` of modes."""
    own = fmu.FRFErrors(simulate(noise, seed, kind), damping or fmu.ModalDamping(ratios()), scale, **options)
    return fmu.UpdatingProblem(building(), modes(), parameters(), error=[own, *others])
