"""A clamped mast of two storeys, one element each, and a beam that nothing changes; tested before and after."""

from functools import cache

import numpy as np

import fmu

HEIGHT, STOREYS = 3.0, 2
NAMES = tuple(f"columns {k + 1}" for k in range(STOREYS))


@cache
def mast():
    """Return the model; the parameters are factors on the moduli of the storeys."""
    section = fmu.Section(A=5e-3, Iy=5e-5, Iz=3e-5, J=1e-6)
    steel = fmu.Material(E=2.1e11, nu=0.3, rho=7850.0)
    elements = {"columns 1": (0, 1), "columns 2": (1, 2), "arm": (2, 3)}
    groups = [fmu.ElementGroup(name, [ends], section, steel) for name, ends in elements.items()]
    nodes = [(0.0, 0.0, 0.0), (0.0, 0.0, HEIGHT), (0.0, 0.0, 2 * HEIGHT), (1.0, 0.0, 2 * HEIGHT)]
    held = {0: ("x", "y", "z", "rx", "ry", "rz")} | dict.fromkeys((1, 2, 3), ("y", "rx", "rz"))
    return fmu.Frame(np.array(nodes), groups, held).separable({name: fmu.Factor([("E", name)]) for name in NAMES})


@cache
def damaged(faster=1.0):
    """Return a short trace: the lower storey loses 30 %, the upper one nothing.

    The frequencies after it are multiplied by `faster`; no stiffness within the bounds makes them twice as high.
    """
    model, tests = mast(), []
    for name, loss, factor in (("first", 0.0, 1.0), ("second", 0.3, faster)):
        theta = np.array([1.0 - loss, 1.0])
        values = np.linalg.eigvals(np.linalg.solve(model.M(theta).toarray(), model.K(theta).toarray()))
        f = factor * np.sqrt(np.sort(values.real)[:2]) / (2 * np.pi)
        group = "before" if name == "first" else "after"
        tests.append(fmu.Test(name, fmu.ModalData(f, numbers=[1, 2], sd_hz=0.005 * f), group=group))
    parameters = [fmu.Parameter(name, 1.0, 0.4, 1.6) for name in NAMES]
    varies = dict.fromkeys(NAMES, fmu.Damage())
    problem = fmu.JointProblem(model, tests, parameters, varies=varies, pairing="index", name="mast")
    return fmu.sample(problem, "hmc", draws=100, warmup=150, seed=1)
