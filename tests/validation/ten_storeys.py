"""The case shear-10dof: a synthetic measurement of a building of ten storeys, its noise to be inferred.

Everything in the case is drawn from its own priors, so that it can be calibrated: ten storey stiffnesses, the
standard deviations of frequencies and shapes, and the measurement given these. This writes the case:

    python -m tests.validation.ten_storeys fmu/cases
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

import fmu
from fmu.fem.pairing.paired_structure import PairedStructure
from fmu.fem.reduced.reduced_structure import ReducedStructure, train
from fmu.posterior.parameters import box
from fmu.types import FloatArray
from tests import shear_building
from tests.matrix_files import write_matrix

STOREYS, STIFFNESS, MASS = 10, 176.729e6, 100e3  # N/m, kg: the lowest frequency is 1 Hz
SPREAD = 0.15
"""Standard deviation of the logarithm of a storey's stiffness."""
SD_FREQUENCY, SD_SHAPE, NOISE_SPREAD = 0.01, 0.03, 0.4
"""Medians of both standard deviations, and the standard deviation of their logarithms."""
MODES, FLOORS = 5, (3, 6, 9, 10)
SEED = 2002

FILE = "shear-10dof.toml"
FOLDER = "shear-10dof"
PARAMETERS = tuple(
    fmu.Parameter(f"k{j}", start=1.0, lower=0.0, upper=np.inf, prior=fmu.LogNormal(1.0, SPREAD))
    for j in range(1, STOREYS + 1)
)
ERRORS = (
    fmu.FrequencyErrors(
        "relative",
        sd=fmu.Parameter("sd_frequency", SD_FREQUENCY, 0.0, np.inf, fmu.LogNormal(SD_FREQUENCY, NOISE_SPREAD)),
    ),
    fmu.ShapeErrors(fmu.Parameter("sd_shape", SD_SHAPE, 0.0, np.inf, fmu.LogNormal(SD_SHAPE, NOISE_SPREAD))),
)
SENSORS = tuple((floor, "x") for floor in FLOORS)
NUMBERS = tuple(range(1, MODES + 1))
ROOF = np.array([-1.0, 1.0, 1.0, -1.0, 1.0])  # which way it moved in each mode of the case's measurement


def prior() -> tuple[FloatArray, FloatArray]:
    """Return the medians of all priors, shape (12,), and the standard deviations of their logarithms."""
    return (
        np.array([1.0] * STOREYS + [SD_FREQUENCY, SD_SHAPE]),
        np.array([SPREAD] * STOREYS + [NOISE_SPREAD] * 2),
    )


def storey(j: int, storeys: int = STOREYS, stiffness: float = STIFFNESS) -> FloatArray:
    """Return the stiffness matrix of storey `j`, from 1, between floors j − 1 and j; N/m."""
    return stiffness * shear_building.storey(j - 1, storeys)


def structure() -> ReducedStructure:
    """Return the first modes at the sensors as functions of the ten factors, by fmu's reduced model.

    Its basis spans all ten degrees of freedom: the reduction is exact. Modes are paired by number, which is right
    for every theta: the matrix of a shear building is tridiagonal, its eigenvalues are simple and its modes never
    change places (the k-th has k − 1 changes of sign). So no measured shape takes part in the model, and one
    model serves all measurements.
    """
    names = [p.name for p in PARAMETERS]
    floors = [(j, "x") for j in range(1, STOREYS + 1)]
    model = shear_building.shear_building(names, STIFFNESS, MASS, dofs=floors)
    paired = PairedStructure.of(
        model, pairing="index", numbers=NUMBERS, sensors=SENSORS, reference=np.ones(STOREYS), shapes=None
    )
    reduced, _ = train(paired, *box(PARAMETERS))
    assert isinstance(reduced, ReducedStructure)  # narrowed for the type checker
    return reduced


def problem(paired: ReducedStructure, data: fmu.ModalData) -> fmu.UpdatingProblem:
    """Return the updating problem for the given measurement."""
    return fmu.UpdatingProblem(paired, data, PARAMETERS, error=ERRORS)


def nothing_measured() -> fmu.ModalData:
    """Return a measurement to have the prior of a problem by."""
    return fmu.ModalData(np.ones(MODES), NUMBERS, SENSORS, shapes=np.ones((len(FLOORS), MODES)))


def simulated(rng: np.random.Generator, paired: ReducedStructure, theta: FloatArray) -> fmu.ModalData:
    """Return a measurement at theta (12,): relative errors f/f^m − 1, and errors of the components of unit shapes.

    As a density of f^m, and of the direction of a shape, the likelihood is normalised up to terms of the order of
    the squares of both standard deviations.
    """
    seen = paired.observed(theta[None, :STOREYS])
    unit = seen.shapes[0] / np.linalg.norm(seen.shapes[0], axis=0)
    unit *= np.sign(unit[-1]) * ROOF  # a solver gives shapes of either sign
    f = seen.frequencies[0] / (1.0 + theta[-2] * rng.standard_normal(MODES))
    shapes = unit + theta[-1] * rng.standard_normal(unit.shape)
    return fmu.ModalData(f, NUMBERS, SENSORS, shapes=shapes)


def drawn(rng: np.random.Generator, paired: ReducedStructure) -> tuple[FloatArray, fmu.ModalData]:
    """Return a truth from the prior, shape (12,), and a measurement of it."""
    truth = problem(paired, nothing_measured()).sample_prior(rng, 1)[0]
    return truth, simulated(rng, paired, truth)


def text() -> str:
    """Return the problem file of the case."""
    truth, data = drawn(np.random.default_rng(SEED), structure())
    shapes = np.asarray(data.shapes) / np.abs(data.shapes).max(axis=0)
    rows = "\n".join(f"    [{', '.join(f'{x:.4f}' for x in shape)}]," for shape in shapes.T)
    head = HEAD.format(
        known=", ".join(f"{x:.3f}" for x in truth[:STOREYS]),
        sd_frequency=truth[-2],
        sd_shape=truth[-1],
        stiffness="".join(STOREY.format(j=j) for j in range(1, STOREYS + 1)),
        frequencies=", ".join(f"{f:.4f}" for f in data.frequencies_hz),
        sensors=", ".join(f'[{floor}, "x"]' for floor in FLOORS),
        dofs=", ".join(f'[{j}, "x"]' for j in range(1, STOREYS + 1)),
        shapes=rows,
    )
    parameters = "".join(PARAMETER.format(j=j, spread=SPREAD) for j in range(1, STOREYS + 1))
    return head + parameters + NOISE.format(frequency=SD_FREQUENCY, shape=SD_SHAPE, spread=NOISE_SPREAD)


def write(folder: Path) -> None:
    """Write the problem file and the matrices that it names."""
    (folder / FOLDER).mkdir(parents=True, exist_ok=True)
    (folder / FILE).write_text(text(), encoding="utf-8")
    for j in range(1, STOREYS + 1):
        write_matrix(folder / FOLDER / f"storey-{j}.mtx", storey(j))
    write_matrix(folder / FOLDER / "mass.mtx", MASS * np.eye(STOREYS))


HEAD = """\
# A synthetic measurement of a shear building of ten storeys: five frequencies, and shapes at four floors.
# Stiffnesses are factors on equal storeys of 176.729 MN/m under floors of 100 t, whose lowest frequency is 1 Hz.
# How large the errors are is inferred too: relative ones of frequencies, and those of the components of shapes of
# unit length.
#
# Truth, errors and measurement are drawn from the priors below, by tests/validation/ten_storeys.py. The truth was
#   k1 ... k10 = {known}
#   sd_frequency = {sd_frequency:.4f}, sd_shape = {sd_shape:.4f}
#
# Twenty numbers for twelve unknowns; the five frequencies alone could be fitted exactly by ten factors. With a
# prior that does not vanish at zero the posterior would reach down to sd_frequency = 0: a proper density, but a
# funnel that narrows in five directions at once. The log-normal priors keep away from there.

name = "shear-10dof"
description = "ten storeys, five modes at four floors (synthetic): stiffnesses and both sizes of errors"

[model]
type = "matrices"
dofs = [{dofs}]
{stiffness}
[[model.mass]]
file = "shear-10dof/mass.mtx"

[measurement]
frequencies = [{frequencies}]      # Hz
sensors = [{sensors}]     # floors at which the five shapes look least alike
shapes = [      # a row a mode
{shapes}
]

[[error]]
of = "frequencies"
kind = "relative"
sd = "sd_frequency"

[[error]]
of = "shapes"
sd = "sd_shape"
"""
STOREY = """
[[model.stiffness]]
file = "shear-10dof/storey-{j}.mtx"
powers = {{ k{j} = 1 }}
"""
PARAMETER = """
[[parameters]]
name = "k{j}"
start = 1.0
lower = 0.0
prior = {{ distribution = "log-normal", median = 1.0, sigma = {spread} }}
"""
NOISE = """
[[noise]]
name = "sd_frequency"
start = {frequency}
prior = {{ distribution = "log-normal", median = {frequency}, sigma = {spread} }}

[[noise]]
name = "sd_shape"
start = {shape}
prior = {{ distribution = "log-normal", median = {shape}, sigma = {spread} }}
"""


if __name__ == "__main__":
    write(Path(sys.argv[1]))
