"""Set up the joint updating problem for several tests of one structure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Annotated, Any, NamedTuple

import numpy as np

from fmu.arguments import OwnRule, check_arguments
from fmu.engines.base import Engine
from fmu.fem.pairing.modal_model import Model
from fmu.formats.shown import names_shown
from fmu.posterior.build import check_names
from fmu.posterior.discrepancy.embedded import Discrepancy
from fmu.posterior.errors.base import ErrorModel
from fmu.posterior.errors.mac import MACErrors
from fmu.posterior.errors.shape import ShapeErrors
from fmu.posterior.joint.build_layout import build_layout
from fmu.posterior.joint.configurations import find_configurations, stack_tests
from fmu.posterior.joint.modal_test import Test, TestsError
from fmu.posterior.joint.model_in_tests import ModelInTests
from fmu.posterior.joint.outliers import Outliers
from fmu.posterior.joint.quantities import Errors
from fmu.posterior.joint.typical import centre_scores
from fmu.posterior.joint.varies import Variation, way_of
from fmu.posterior.joint.varies.base import Varies
from fmu.posterior.joint.varies.laws import Law
from fmu.posterior.joint.varies.taken import Shared
from fmu.posterior.joint.varies.trend import Slopes, find_mistakes_of_slopes
from fmu.posterior.parameters import Parameter
from fmu.posterior.priors.base import Prior
from fmu.posterior.problem import UpdatingProblem
from fmu.types import FloatArray, Positive


@check_arguments
def JointProblem(  # capitalised because it constructs a problem
    model: Annotated[Model, OwnRule()],
    tests: Sequence[Test],
    parameters: Sequence[Parameter],
    *,
    varies: Mapping[str, str | Variation] | None = None,
    slopes: Mapping[str, Mapping[str, Prior | Law | str]] | None = None,
    reference: str | None = None,
    correlation: float | None = None,
    outliers: Outliers | None = None,
    pairing: str = "shape",
    beta: Positive | None = None,
    error: str | ErrorModel | Sequence[ErrorModel] = "frequency",
    discrepancy: Discrepancy | Sequence[Discrepancy] = (),
    reduction: Annotated[bool | float, OwnRule()] = True,
    engine: Engine | None = None,
    name: str = "problem",
) -> UpdatingProblem:
    """Return the joint posterior for all tests of a structure.

    The problem's modes are the modes of all tests, named ``"test: mode"``. Its parameters are the shared
    parameters and the parameters of each test, group or population (`fmu.posterior.joint.layout`). Every function
    that accepts an `UpdatingProblem` accepts the result. One evaluation computes all tests: tests with the same
    matrices and sensors are solved in one batch with one reduced model.

    Parameters
    ----------
    model : SeparableModel, BlackBoxModel or ModalModel
        The structure without the changes made for any test. A `ModalModel` returns every mode that at least one
        test contains, in ascending order of their ``numbers`` or, if these contradict the labels, in the order in
        which the labels first occur. The modes that a user's function returns are paired by MAC, or selected by
        the ``numbers`` in the data, which are 1, 2, … in every test unless they are given.
    tests : sequence of Test
    parameters : sequence of Parameter
        Parameters of the model, in the same order as for a single test.
    varies : mapping of str to {"shared", "test", "group"}, Population, Damage or UndatedDamage
        How each parameter varies between the tests, keyed by parameter name. Parameters without an entry are
        ``"shared"``. ``"test"`` or ``"group"``: each test, or each group of tests, has its own value, with the
        parameter's prior. `Population`: the values in the tests scatter about a common mean (hierarchical
        updating; Behmanesh, Moaveni, Lombaert & Papadimitriou 2015, *Mech. Syst. Signal Process.* 64–65,
        360–376). `Damage`: in groups other than the reference, the parameter is reduced by a relative loss.
        `UndatedDamage`: the loss begins at an unknown date.
    slopes : mapping of str to mapping of str to Prior, Polynomial, PiecewiseLinear or str
        How a parameter depends on covariates x_k, keyed by parameter name and covariate name. The value in a test
        is multiplied by 1 + Σ_k g_k(x_k). A `Prior` is the prior of the relative slope b in g(x) = b (x − x₀),
        where x₀ is the covariate's mean over the tests. `Polynomial` and `PiecewiseLinear` are other laws. If the
        name of another parameter is given, both parameters have the same law with the same slopes.
    reference : str, optional
        The group of tests that losses refer to. Default: the group of the first test.
    correlation : float, optional
        Shape parameter η of the LKJ(η) prior for the populations' correlation matrix
        (`fmu.posterior.joint.correlation`). 1 is a flat prior; larger values favour smaller correlations. By
        default the populations are independent.
    outliers : Outliers, optional
        Allows tests to be outliers of the populations. The posterior sums over all possibilities; the trace
        contains each test's outlier probability. By default no test is an outlier.
    discrepancy : Discrepancy or sequence of Discrepancy, optional
        Model discrepancy. It is the same in all tests: a mode of the structure, identified by its label, has the
        same discrepancy parameters in every test.
    pairing, beta, error, reduction, engine, name
        See `UpdatingProblem` and `UpdatingProblem.reduced`. ``"soft"`` pairing and the modal residual are only for
        a single test. `fmu.MassErrors`, `fmu.StaticErrors` and `fmu.FRFErrors` must name the test in which the
        mass was weighed, or the displacement or the FRFs were measured: ``fmu.MassErrors(32.5e3, sd=300.0,
        test="autumn")``. Damping parameters are appended to `parameters`, and `varies` may name them too.

    Returns
    -------
    UpdatingProblem
        Its `tests`, `layout` and `values` relate the inferred parameters to the individual tests.

    Raises
    ------
    TestsError
        If the tests or another argument are wrong, or contradict each other, or an inferred standard deviation may
        be zero where the parameters can fit its errors exactly; the error lists all faults that can be found
        before the models are built. Also if a problem with a population and `fmu.FRFErrors` has inferred error
        parameters.
    ValueError
        If soft pairing or the modal residual is requested, two parameters share a name, or a parameter's bounds,
        start or prior do not allow it to vary as requested; also in the cases listed for `UpdatingProblem` and
        `UpdatingProblem.reduced`.
    """
    tests = tuple(tests)
    slopes = {key: dict(value) for key, value in (slopes or {}).items()}
    errors, of_model = Errors.of(error), len(parameters)
    parameters = [*parameters, *errors.damping_parameters()]
    check_names(parameters)
    reference = (tests[0].group if tests else "") if reference is None else reference
    ways = {p.name: Shared() for p in parameters} | {name: way_of(how) for name, how in (varies or {}).items()}
    found = find_mistakes(tests, parameters, of_model, ways, slopes, reference, correlation, outliers)
    found += errors.find_mistakes(model, [test.name for test in tests])
    if any(isinstance(one, (ShapeErrors, MACErrors)) for one in np.ravel(np.array(error, dtype=object))):
        found += mistakes_of_shapes(tests)
    if found:
        raise TestsError(found)
    if pairing == "soft" or error == "modal-residual":
        what = "soft pairing" if pairing == "soft" else "the modal residual"
        raise ValueError(f"tests: {what} is for a single test (got {len(tests)})")
    layout = build_layout(parameters, tests, ways, slopes, reference, correlation, outliers)
    unbounded = errors.find_vanishing(layout, of_model)
    if unbounded:
        raise TestsError([f"lower.{name}: {rule} (got 0.0)" for name, rule in unbounded.items()])
    data = stack_tests(tests)
    common: dict[str, Any] = {"beta": beta}
    options = {"pairing": pairing, "reduction": reduction, "engine": engine, "error": errors.of_modes, **common}
    parts, tolerance = find_configurations(model, tests, layout, of_model, options)
    joint = ModelInTests(parts, [test.name for test in tests], len(parameters), data.n_modes)
    common |= {"name": name, "layout": layout, "error": error}
    problem = plain = UpdatingProblem(joint, data, parameters, **common)
    if plain.is_hierarchical and plain.likelihood.every and plain.likelihood.noise:
        names = names_shown([p.name for p in plain.likelihood.noise])
        rule = "must have known errors beside a population; infer gains alone, of Gaussian errors"
        raise TestsError([f"error: frequency response functions {rule} (got inferred {names})"])
    if discrepancy:
        problem = UpdatingProblem(joint, data, parameters, discrepancy=discrepancy, **common)
    problem.tolerance = tolerance
    # centring uses each test's data alone, but a discrepancy couples the tests
    if not problem.is_hierarchical:
        return problem
    centred = centre_scores(plain.with_layout(layout.without_time()))
    return problem.with_layout(replace(centred, in_time=layout.in_time))


def simulate_next_test(
    problem: UpdatingProblem,
    rng: np.random.Generator,
    theta: FloatArray,
    like: str | None = None,
    covariates: Mapping[str, float] | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Simulate the frequencies, in Hz, of one further test of the structure, without and with measurement errors.

    Parameters
    ----------
    problem : UpdatingProblem
        A problem with several tests.
    rng : Generator
    theta : ndarray, shape (n, ndim)
        Posterior draws. For each draw, a parameter with a population gets a new value from that population, and a
        parameter with a separate value in each test gets a draw from its prior. The further test is not an
        outlier.
    like : str, optional
        Name of the test whose configuration, group, modes and error models the further test has. Default: the
        first test.
    covariates : mapping of str to float, optional
        Covariates in the further test. The default of a covariate is its mean over the tests, but times have other
        defaults: if the values of a population are correlated in time, the further test takes place after the last
        test (`InTime.next_scores`); an undated loss, even a growing one, has its value at the last test's time.

    Returns
    -------
    computed, measured : ndarray, shape (n, n_modes)
        Frequencies without and with errors, in Hz, for the modes of the test `like`; NaN where the solve failed.

    Raises
    ------
    ValueError
        If no test has the name `like`, that test does not have one of the `covariates`, or the error models do not
        define a frequency distribution.
    """
    tests = problem.tests
    names = [test.name for test in tests]
    if like is not None and like not in names:
        raise ValueError(f"like: must be one of {', '.join(names)} (got {like!r})")
    t = 0 if like is None else names.index(like)
    unknown = [name for name in covariates or {} if name not in tests[t].covariates]
    if unknown:
        raise ValueError(f"covariates: must be among {', '.join(tests[t].covariates)} (got {unknown[0]!r})")
    found = draw_next_test(problem, rng, theta, t, covariates or {})
    return found.computed, found.measured


class NextTest(NamedTuple):
    """Simulated draws of one further test, in the configuration of an existing test.

    Attributes
    ----------
    scores : ndarray, shape (n, n_populations)
        Standardised values in the populations, in the order of ``layout.drawn``.
    values : ndarray, shape (n, n_structural)
        Structural parameters.
    computed, measured : ndarray, shape (n, n_modes)
        Frequencies without and with errors, in Hz.
    """

    scores: FloatArray
    values: FloatArray
    computed: FloatArray
    measured: FloatArray


def draw_next_test(
    problem: UpdatingProblem, rng: np.random.Generator, theta: FloatArray, t: int, covariates: Mapping[str, float]
) -> NextTest:
    """Return draws of one further test in the configuration of test `t`, an index; see `simulate_next_test`."""
    structural = theta[:, : problem.n_structural]
    layout = problem.layout
    scores = layout.draw_scores(structural, rng, 1)[:, 0]
    if layout.in_time is not None:
        of_tests = layout.population_scores(structural)
        scores = layout.in_time.next_scores(structural, of_tests, scores, covariates)
    values = layout.of_next_test(structural, rng, scores, t, covariates)
    computed = problem.model.frequencies_of_test(t, values)
    columns = problem.model.test_of_modes == t
    every = np.tile(np.asarray(problem.data.frequencies_hz), (len(theta), 1))
    every[:, columns] = computed
    return NextTest(
        scores, values, computed, problem.simulate_data(rng, every, theta, same_structure=True)[:, columns]
    )


def find_mistakes(
    tests: Sequence[Test],
    parameters: Sequence[Parameter],
    of_model: int,
    varies: Mapping[str, Varies],
    slopes: Slopes,
    reference: str,
    correlation: float | None = None,
    outliers: Outliers | None = None,
) -> list[str]:
    """Return error messages about wrong or contradictory arguments of `JointProblem`.

    Each message names the argument. The first `of_model` parameters belong to the model, and the others are
    damping parameters.
    """
    names = [p.name for p in parameters]
    found = ["tests: must be at least 2 (got 1)"] if len(tests) == 1 else []
    found = found or ([] if tests else ["tests: must be at least 2 (got none)"])
    taken: dict[str, int] = {}
    for t, test in enumerate(tests):
        first = taken.setdefault(test.name, t)
        if first != t:
            found.append(f"tests.{t}.name: must not be that of tests.{first} (got {test.name!r})")
        of_structure = names[:of_model]
        rule = f"must name parameters among {', '.join(of_structure)}"
        found += [f"tests.{t}.known: {rule} (got {n!r})" for n in test.known if n not in of_structure]
    for name, how in varies.items():
        if name in names:
            found += how.find_mistakes(name, tests)
        else:
            found.append(f"varies: must name parameters among {', '.join(names)} (got {name!r})")
    for name in (p.name for p in parameters if not p.updated):
        given = {"varies": type(varies[name]) is not Shared, "slopes": name in slopes}
        rule = "must not be given for a parameter that is not updated"
        found += [f"{key}.{name}: {rule}" for key, is_given in given.items() if is_given]
    for name in names:
        if tests and all(name in test.known for test in tests):
            found.append(f"tests: {name} must be unknown in one of them; otherwise it is no parameter")
    groups = {test.group for test in tests}
    if tests and reference not in groups:
        found.append(f"reference: must be the group of a test (got {reference!r})")
    for name in (name for name in names if varies[name].by_group):
        values = {test.known.get(name) for test in tests if test.group == reference}
        if 0.0 in values and None not in values:
            rule = f"must have a test in which {name} is not known to be 0, as losses of {name} refer to it"
            found.append(f"reference: {rule} (got {reference!r})")
    n = sum(varies[name].population is not None for name in names)
    if outliers is not None and not n:
        rule = "needs a parameter with a population, of which a test may be an outlier"
        found.append(f"outliers: {rule} (got none)")
    together = {"correlation": correlation is not None, "outliers": outliers is not None}
    in_time = ", ".join(name for name in names if varies[name].is_in_time)
    if in_time:
        rule = "must not be given with populations that are correlated in time"
        found += [f"{key}: {rule} (got {in_time})" for key, is_given in together.items() if is_given]
    if correlation is not None:
        if n < 2:
            found.append(f"correlation: needs two parameters or more with a population (got {n})")
        if not 0.0 < correlation < np.inf:
            found.append(f"correlation: must be positive (got {correlation})")
    return found + find_mistakes_of_slopes(slopes, names, tests)


def mistakes_of_shapes(tests: Sequence[Test]) -> list[str]:
    """Return error messages about tests without mode shapes, or with other sensors than the first test."""
    found = []
    for t, test in enumerate(tests):
        if test.data.shapes is None:
            found.append(f"tests.{t}.shapes: must be given, as shapes are compared (got none)")
        elif test.data.sensors != tests[0].data.sensors:
            found.append(f"tests.{t}.sensors: must be those of tests.0, in their order, as shapes are compared")
    return found
