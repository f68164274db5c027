"""Models whose exact posterior is known, each as a function of a user that gives frequencies and nothing else."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

import fmu
from tests.shear_building import two_frequencies_hz

Vector = NDArray[np.float64]
SLOW = """
import time
from pathlib import Path
import numpy as np

log = Path(__file__).with_name("log")


def told(what, theta):
    with log.open("a") as file:
        file.write(f"{what} {theta.tobytes().hex()}\\n")


def storeys(theta):
    told("begun", theta)
    time.sleep(SECONDS)
    k, m = theta, np.array([16e3, 15e3, 12e3])
    K = np.array([[k[0] + k[1], -k[1], 0.0], [-k[1], k[1] + k[2], -k[2]], [0.0, -k[2], k[2]]])
    frequencies = np.sqrt(np.linalg.eigvalsh(K / np.sqrt(np.outer(m, m)))) / (2.0 * np.pi)
    told("done", theta)
    return frequencies
"""
"""A module with a function that takes SECONDS, and logs when each of its calls begins and ends."""
PROBLEM = """
name = "slow storeys"
[model]
type = "python"
function = "slow:storeys"
[measurement]
frequencies = [4.2, 10.3, 14.6]
sd = [0.04, 0.08, 0.12]
""" + "".join(
    f"""
[[parameters]]
name = "k{i + 1}"
start = {median}
prior = {{ distribution = "log-normal", median = {median}, sigma = 0.4 }}
"""
    for i, median in enumerate((5e7, 4.5e7, 3e7))
)
"""The problem file of this function."""


class Case(NamedTuple):
    """A posterior by matrices, the same through a function, and the solves that it may take."""

    name: str
    exact: Any
    function: Callable[[Vector], Vector]
    error: Any
    most: int


def through(case: Case, **options: Any) -> fmu.UpdatingProblem:
    """Return the problem of a case through its function."""
    data = fmu.ModalData(list(case.exact.data.frequencies_hz))
    model = fmu.BlackBoxModel(case.function, case.exact.ndim, **options)
    return fmu.UpdatingProblem(model, data, case.exact.parameters, error=case.error)


def built_in(name: str, most: int, error: Any, pairing: str | None = None) -> Case:
    """Return a built-in case; the function gives its paired frequencies."""
    exact = fmu.cases.load(name) if pairing is None else fmu.cases.load(name, pairing)
    return Case(name, exact, lambda theta: exact.model.frequencies(theta[None])[0], error, most)


def plate(most: int = 250) -> Case:
    """A cantilever plate of Morley's triangles with eight moduli, and twelve frequencies with noise."""
    from skfem import Basis, BilinearForm, ElementTriMorley, MeshTri
    from skfem.helpers import dd, ddot, eye, trace

    thickness, nu, density, modulus = 0.004, 0.3, 7850.0, 2.1e11
    mesh = MeshTri.init_tensor(np.linspace(0.0, 0.8, 9), np.linspace(0.0, 0.5, 5))
    element = ElementTriMorley()
    patches = [(0.2 * i, 0.2 * (i + 1), 0.25 * j, 0.25 * (j + 1)) for j in range(2) for i in range(4)]

    @BilinearForm
    def bending(u: Any, v: Any, _: Any) -> Any:
        moment = 1.0 / (1.0 + nu) * (dd(u) + nu / (1.0 - nu) * eye(trace(dd(u)), 2))
        return modulus * thickness**3 / 12.0 * ddot(moment, dd(v))

    @BilinearForm
    def inertia(u: Any, v: Any, _: Any) -> Any:
        return density * thickness * u * v

    whole = Basis(mesh, element)
    held = whole.get_dofs(lambda x: x[0] == 0.0).all()
    free = np.setdiff1d(np.arange(whole.N), held)
    M = inertia.assemble(whole).toarray()[np.ix_(free, free)]
    centre = mesh.p[:, mesh.t].mean(axis=1)
    stiffness = []
    for x0, x1, y0, y1 in patches:
        inside = np.flatnonzero((centre[0] > x0) & (centre[0] < x1) & (centre[1] > y0) & (centre[1] < y1))
        part = bending.assemble(Basis(mesh, element, elements=inside)).toarray()
        stiffness.append(part[np.ix_(free, free)])
    names = [f"E{k + 1}" for k in range(8)]

    def frequencies(theta: Vector) -> Vector:
        K = sum(factor * part for factor, part in zip(theta, stiffness, strict=True))
        return np.sqrt(eigh(K, M, subset_by_index=(0, 11), eigvals_only=True)) / (2.0 * np.pi)

    rng = np.random.default_rng(3)
    measured = frequencies(rng.uniform(0.8, 1.2, 8)) * (1.0 + 0.005 * rng.standard_normal(12))
    error = fmu.FrequencyErrors("relative", sd=0.005)
    parameters = [fmu.Parameter(name, 1.0, 0.5, 1.5, prior=fmu.Normal(0.2, mean=1.0)) for name in names]
    model = fmu.SeparableModel.from_terms(names, stiffness=list(zip(stiffness, names, strict=True)), mass=[M])
    data = fmu.ModalData(measured.tolist())
    exact = fmu.UpdatingProblem.reduced(model, data, parameters, pairing="index", error=error)
    return Case("plate of eight moduli", exact, frequencies, error, most)


def cases() -> list[Callable[[], Case]]:
    """Return what makes each case, in the order of the page."""
    beam = fmu.FrequencyErrors("absolute", sd=float(np.sqrt(0.5)))  # β = 1
    return [
        lambda: built_in("cantilever-young", 60, beam, "shape"),
        lambda: built_in("cantilever-section", 60, beam, "shape"),
        lambda: built_in("garteur", 400, fmu.FrequencyErrors("relative", sd=0.005)),
        plate,
    ]


def storeys(theta: Vector) -> Vector:
    """Frequencies of a shear building of two storeys, of stiffnesses theta[:2]."""
    return two_frequencies_hz(theta[:2])


def two_storeys(
    function: Callable[[Vector], Any],
    measured: Vector,
    sd: Vector,
    names: tuple[str, ...] = ("k1", "k2"),
    **data: Any,
) -> fmu.UpdatingProblem:
    """Return the problem of a function of two stiffnesses, and of factors after them that have no effect."""
    start, lower, upper = [5e7, 3e7], [2e7, 1e7], [9e7, 6e7]
    parameters = [
        fmu.Parameter(name, start[i], lower[i], upper[i], unit="N/m")
        if i < 2
        else fmu.Parameter(name, 1.0, 0.5, 1.5)
        for i, name in enumerate(names)
    ]
    return fmu.UpdatingProblem(
        fmu.BlackBoxModel(function, len(names)),
        fmu.ModalData(measured.tolist(), **data),
        parameters,
        error=fmu.FrequencyErrors("absolute", sd=sd),
    )


class PoorCase(NamedTuple):
    """A posterior of two stiffnesses, of which few solves give a poor surrogate.

    Attributes
    ----------
    name : str
    n_modes : int
        Frequencies measured.
    sd : float
        Of the lower frequency, Hz; that of the upper one is three times as large.
    lower, upper : tuple of float
        Bounds.
    seed : int
        Of the surrogate: one that is off.
    fills_box : bool
        Whether the posterior is wide enough for quadrature over all of the box.
    edge : float
        Solves fail where the first stiffness is larger.
    """

    name: str
    n_modes: int
    sd: float
    lower: tuple[float, float]
    upper: tuple[float, float]
    seed: int
    fills_box: bool

    edge: float = np.inf

    def problem(self, batched: bool = False) -> fmu.UpdatingProblem:
        """Return the problem through a function."""
        measured = storeys(np.array([5.2e7, 3.1e7]))[: self.n_modes]
        parameters = [
            fmu.Parameter(name, start, lower, upper, unit="N/m")
            for name, start, lower, upper in zip(("k1", "k2"), (5e7, 3e7), self.lower, self.upper, strict=True)
        ]

        def function(theta: Vector) -> Vector:
            if np.any(theta.T[0] > self.edge):
                raise RuntimeError("no convergence")
            return storeys(theta.T)[: self.n_modes].T

        return fmu.UpdatingProblem(
            fmu.BlackBoxModel(function, 2, batched=batched),
            fmu.ModalData(measured.tolist()),
            parameters,
            error=fmu.FrequencyErrors("absolute", sd=self.sd * np.array([1.0, 3.0])[: self.n_modes]),
        )

    def moments(self) -> tuple[Vector, Vector]:
        """Return mean and sd by quadrature."""
        upper = min(self.upper[0], self.edge), self.upper[1]
        problem = self._replace(upper=upper, edge=np.inf).problem(batched=True)
        if self.fills_box:
            middle, width = 0.5 * (problem.lower + problem.upper), problem.upper - problem.lower
            return grid_moments(problem, middle, width / 12.0, 801)
        best = fmu.find_map(problem, 16)[0]
        return grid_moments(problem, best.mean, best.sd, 301)


POOR = (
    PoorCase("one maximum", 2, 0.005, (5e6, 2.6e7), (2e8, 2e8), 1, False),
    PoorCase("two maxima", 2, 0.05, (5e6, 5e6), (2e8, 2e8), 5, True),
    PoorCase("cut off where solves fail", 2, 0.02, (2e7, 2.6e7), (9e7, 6e7), 1, False, 5.2e7),
)


def grid_moments(problem: Any, mean: Vector, sd: Vector, n: int = 101) -> tuple[Vector, Vector]:
    """Return mean and sd of the first two parameters by quadrature over ± 6 sd, the others at their start."""
    axes = [
        np.linspace(max(problem.lower[j], mean[j] - 6 * sd[j]), min(problem.upper[j], mean[j] + 6 * sd[j]), n)
        for j in (0, 1)
    ]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    theta = np.tile(problem.start, (len(points), 1))
    theta[:, :2] = points
    log = problem.log_prob(theta)
    w = np.exp(log - log.max())
    found = w @ points / w.sum()
    return found, np.sqrt(w @ (points - found) ** 2 / w.sum())
