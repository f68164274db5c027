"""Updating with several tests of one structure at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated

import numpy as np

from fmu.arguments import OwnRule, check_arguments
from fmu.engines.base import Engine
from fmu.fem.pairing.modal_model import Model
from fmu.posterior.build import check_names
from fmu.posterior.errors.base import ErrorModel
from fmu.posterior.errors.mac import MACErrors
from fmu.posterior.errors.shape import ShapeErrors
from fmu.posterior.joint.build_layout import build_layout
from fmu.posterior.joint.configurations import find_configurations, stack_tests
from fmu.posterior.joint.modal_test import Test, TestsError
from fmu.posterior.joint.model_in_tests import ModelInTests
from fmu.posterior.joint.quantities import Errors
from fmu.posterior.joint.typical import centre_scores
from fmu.posterior.joint.varies import Variation, way_of
from fmu.posterior.joint.varies.base import Varies
from fmu.posterior.joint.varies.taken import SHARED
from fmu.posterior.parameters import Parameter
from fmu.posterior.priors.base import Prior
from fmu.posterior.problem import UpdatingProblem
from fmu.types import FloatArray, Positive


@check_arguments
def JointProblem(  # it is the constructor of a problem
    model: Annotated[Model, OwnRule()],
    tests: Sequence[Test],
    parameters: Sequence[Parameter],
    *,
    varies: Mapping[str, str | Variation] | None = None,
    slopes: Mapping[str, Mapping[str, Prior]] | None = None,
    reference: str | None = None,
    correlation: float | None = None,
    pairing: str = "shape",
    beta: Positive | None = None,
    error: str | ErrorModel | Sequence[ErrorModel] = "frequency",
    reduction: Annotated[bool | float, OwnRule()] = True,
    engine: Engine | None = None,
    name: str = "problem",
) -> UpdatingProblem:
    """Return the posterior of all tests of a structure together.

    Its modes are the modes of every test, named ``"test: mode"``. Its parameters are the shared ones and those of
    each test, group or population (`fmu.posterior.joint.layout`). Everything that takes a problem takes it. One
    evaluation answers all tests: those that share the matrices are one batch, and one reduced model serves them.

    Parameters
    ----------
    model : SeparableModel, BlackBoxModel or ModalModel
        The structure as it is without the changes of any test. A `ModalModel`, or a map of the user's own, gives
        all modes that the tests have between them, in the order in which the tests name them.
    tests : sequence of Test
    parameters : sequence of Parameter
        Parameters of the model, in the order of theta for a single test.
    varies : mapping of str to {"shared", "test", "group"}, Population or Damage
        By the name of the parameter; shared if it is not named. ``"test"`` and ``"group"``: each test, or group of
        tests, has a value of its own, with the parameter's prior. A `Population`: the values of the tests scatter
        about a common mean (hierarchical updating; Behmanesh, Moaveni, Lombaert & Papadimitriou 2015, *Mech.
        Syst. Signal Process.* 64–65, 360–376). `Damage`: groups other than the reference have lost a share of it.
    slopes : mapping of str to mapping of str to Prior
        By the names of parameter and covariate: the prior of the relative slope b, with which the value in a test
        is multiplied by 1 + b (x − x₀), where x₀ is the mean of the covariate over the tests.
    reference : str, optional
        The group of tests that losses refer to; that of the first test by default.
    correlation : float, optional
        The populations are correlated (`fmu.posterior.joint.correlation`), and this is the shape η of the prior of
        their correlation matrix, LKJ(η): 1 is flat, and the larger it is, the smaller are the correlations.
        Independent by default.
    pairing, beta, error, reduction, engine, name
        See `UpdatingProblem` and `UpdatingProblem.reduced`. ``"soft"`` pairing and the modal residual are for
        single tests. `fmu.MassErrors` and `fmu.StaticErrors` name the test in which the mass was weighed, or the
        displacement measured: ``fmu.MassErrors(32.5e3, sd=300.0, test="autumn")``.

    Returns
    -------
    UpdatingProblem
        See its `tests`, `layout` and `values`.

    Raises
    ------
    TestsError
        Lists what is wrong in the tests, in `varies` and in `slopes`.
    ValueError
        As `UpdatingProblem` does.
    """
    tests = tuple(tests)
    slopes = {key: dict(value) for key, value in (slopes or {}).items()}
    check_names(parameters)
    reference = (tests[0].group if tests else "") if reference is None else reference
    errors = Errors.of(error)
    ways = {p.name: way_of(SHARED) for p in parameters} | {
        name: way_of(how) for name, how in (varies or {}).items()
    }
    found = find_mistakes(tests, parameters, ways, slopes, reference, correlation)
    found += errors.find_mistakes(model, [test.name for test in tests])
    if any(isinstance(one, (ShapeErrors, MACErrors)) for one in np.ravel(np.array(error, dtype=object))):
        found += mistakes_of_shapes(tests)
    if found:
        raise TestsError(found)
    if pairing == "soft" or (isinstance(error, str) and error == "modal-residual"):
        what = "soft pairing" if pairing == "soft" else "the modal residual"
        raise ValueError(f"tests: {what} is for a single test (got {len(tests)})")
    layout = build_layout(parameters, tests, ways, slopes, reference, correlation)
    data = stack_tests(tests)
    common = {"beta": beta, "error": errors.of_modes}
    options = {"pairing": pairing, "reduction": reduction, "engine": engine, **common}
    parts, tolerance = find_configurations(model, tests, layout, options)
    joint = ModelInTests(parts, [test.name for test in tests], len(parameters), data.n_modes)
    problem = UpdatingProblem(joint, data, parameters, name=name, layout=layout, **common)
    problem.likelihood.quantities = errors.bound(joint, layout)
    problem.tolerance = tolerance
    return problem.with_layout(centre_scores(problem)) if problem.is_hierarchical else problem


def simulate_next_test(
    problem: UpdatingProblem,
    rng: np.random.Generator,
    theta: FloatArray,
    like: str | None = None,
    covariates: Mapping[str, float] | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Return the frequencies of one more test of the structure, Hz: computed, and with the errors of a test.

    Parameters
    ----------
    problem : UpdatingProblem
        Of several tests.
    rng : Generator
    theta : ndarray, shape (n, ndim)
        Draws: values that scatter over the tests are drawn anew from the population of each.
    like : str, optional
        Name of the test that it resembles in configuration, group, modes and errors; the first by default.
    covariates : mapping of str to float, optional
        Those not named are at their means over the tests.

    Returns
    -------
    computed, measured : ndarray, shape (n, n_modes of that test)

    Raises
    ------
    ValueError
        If there is no such test or covariate, or the error models give no distribution of the frequencies.
    """
    tests = problem.tests
    names = [test.name for test in tests]
    if like is not None and like not in names:
        raise ValueError(f"like: must be one of {', '.join(names)} (got {like!r})")
    t = 0 if like is None else names.index(like)
    unknown = [name for name in covariates or {} if name not in tests[t].covariates]
    if unknown:
        raise ValueError(f"covariates: must be among {', '.join(tests[t].covariates)} (got {unknown[0]!r})")
    values = problem.layout.of_next_test(theta[:, : problem.n_structural], rng, t, covariates or {})
    computed = problem.model.frequencies_of_test(t, values)
    columns = problem.model.test_of_modes == t
    every = np.tile(np.asarray(problem.data.frequencies_hz), (len(theta), 1))
    every[:, columns] = computed
    return computed, problem.simulate_data(rng, every, theta)[:, columns]


def find_mistakes(
    tests: Sequence[Test],
    parameters: Sequence[Parameter],
    varies: Mapping[str, Varies],
    slopes: Mapping[str, Mapping[str, Prior]],
    reference: str,
    correlation: float | None = None,
) -> list[str]:
    """Return the contradictions between tests and parameters, each with its place."""
    names = [p.name for p in parameters]
    found = ["tests: must be at least 2 (got 1)"] if len(tests) == 1 else []
    found = found or ([] if tests else ["tests: must be at least 2 (got none)"])
    taken: dict[str, int] = {}
    for t, test in enumerate(tests):
        first = taken.setdefault(test.name, t)
        if first != t:
            found.append(f"tests.{t}.name: must not be that of tests.{first} (got {test.name!r})")
        unknown = [name for name in test.known if name not in names]
        found += [f"tests.{t}.known: must name parameters among {', '.join(names)} (got {n!r})" for n in unknown]
        others = {label for other in tests if other is not test for label in other.data.labels}
        if len(tests) > 1 and not others & set(test.data.labels):
            labels = ", ".join(test.data.labels)
            found.append(f"tests.{t}.labels: must have a mode in common with another test (got {labels})")
    for name, how in varies.items():
        if name in names:
            found += how.find_mistakes(name, tests)
        else:
            found.append(f"varies: must name parameters among {', '.join(names)} (got {name!r})")
    for name in names:
        if tests and all(name in test.known for test in tests):
            found.append(f"tests: {name} must be unknown in one of them; otherwise it is no parameter")
    groups = {test.group for test in tests}
    if tests and reference not in groups:
        found.append(f"reference: must be the group of a test (got {reference!r})")
    if correlation is not None:
        n = sum(varies[name].scatters for name in names)
        if n < 2:
            found.append(f"correlation: needs two parameters or more with a population (got {n})")
        if not 0.0 < correlation < np.inf:
            found.append(f"correlation: must be positive (got {correlation})")
    for name, by in slopes.items():
        if name not in names:
            found.append(f"slopes: must name parameters among {', '.join(names)} (got {name!r})")
        for covariate in by:
            missing = [t for t, test in enumerate(tests) if covariate not in test.covariates]
            found += [
                f"tests.{t}.covariates: must have {covariate}, on which {name} depends (got none)" for t in missing
            ]
            if not missing and len({test.covariates[covariate] for test in tests}) < 2:
                found.append(f"slopes.{name}: {covariate} must differ between tests (got one value)")
    return found


def mistakes_of_shapes(tests: Sequence[Test]) -> list[str]:
    """Return the obstacles to a comparison of shapes, each with its place."""
    found = []
    for t, test in enumerate(tests):
        if test.data.shapes is None:
            found.append(f"tests.{t}.shapes: must be given, as shapes are compared (got none)")
        elif test.data.sensors != tests[0].data.sensors:
            found.append(f"tests.{t}.sensors: must be those of tests.0, in their order, as shapes are compared")
    return found
