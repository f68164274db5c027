"""Updating with several tests of one structure at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from typing import Annotated, Any

import numpy as np

from fmu.arguments import OwnRule, check_arguments
from fmu.engines.base import Engine
from fmu.fem.black_box import BlackBoxModel
from fmu.fem.modes.separable import SeparableModel
from fmu.posterior.build import check_names
from fmu.posterior.errors.base import ErrorModel
from fmu.posterior.errors.mac import MACErrors
from fmu.posterior.errors.shape import ShapeErrors
from fmu.posterior.joint.configurations import find_configurations, stack_tests
from fmu.posterior.joint.damage import Damage
from fmu.posterior.joint.joint_model import JointModel, SlopesByTest
from fmu.posterior.joint.layout import BY_GROUP, BY_TEST, VARIES, Layout, Role, find_populations
from fmu.posterior.joint.modal_test import Test, TestsError
from fmu.posterior.joint.population import Population
from fmu.posterior.joint.quantities import Errors
from fmu.posterior.joint.scored_prior import ScoredPrior
from fmu.posterior.joint.typical import centre_scores
from fmu.posterior.parameters import Parameter
from fmu.posterior.priors.base import Prior
from fmu.posterior.problem import UpdatingProblem
from fmu.types import FloatArray, Positive


@check_arguments
class JointProblem(UpdatingProblem):
    """The posterior of all tests of a structure together.

    It is an `UpdatingProblem` whose modes are those of every test, named ``"test: mode"``. Its parameters are the
    shared ones and those of each test, group or population (`fmu.posterior.joint.layout`). Everything that
    takes a problem takes it. One evaluation answers all tests: those that share the matrices are one batch, and
    one reduced model serves them.

    Parameters
    ----------
    model : SeparableModel or BlackBoxModel
        The structure as it is without the changes of any test.
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
        The group of tests that losses refer to (`losses`); that of the first test by default.
    correlation : float, optional
        The populations are correlated (`fmu.posterior.joint.correlation`), and this is the shape η of the prior of
        their correlation matrix, LKJ(η): 1 is flat, and the larger it is, the smaller are the correlations.
        Independent by default.
    pairing, beta, error, reduction, engine, name
        See `UpdatingProblem` and `UpdatingProblem.reduced`. ``"soft"`` pairing and the modal residual are for
        single tests. `fmu.MassErrors` and `fmu.StaticErrors` name the test in which the mass was weighed, or the
        displacement measured: ``fmu.MassErrors(32.5e3, sd=300.0, test="autumn")``.

    Attributes
    ----------
    tests : tuple of Test
    layout : Layout

    Raises
    ------
    TestsError
        Lists what is wrong in the tests, in `varies` and in `slopes`.
    ValueError
        As `UpdatingProblem` does.
    """

    model: JointModel

    def __init__(
        self,
        model: SeparableModel | BlackBoxModel,
        tests: Sequence[Test],
        parameters: Sequence[Parameter],
        *,
        varies: Mapping[str, str | Population | Damage] | None = None,
        slopes: Mapping[str, Mapping[str, Prior]] | None = None,
        reference: str | None = None,
        correlation: float | None = None,
        pairing: str = "shape",
        beta: Positive | None = None,
        error: str | ErrorModel | Sequence[ErrorModel] = "frequency",
        reduction: Annotated[bool | float, OwnRule()] = True,
        engine: Engine | None = None,
        name: str = "problem",
    ) -> None:
        self.tests = tuple(tests)
        varies, slopes = dict(varies or {}), {key: dict(value) for key, value in (slopes or {}).items()}
        check_names(parameters)
        self.reference = (self.tests[0].group if self.tests else "") if reference is None else reference
        errors = Errors.of(error)
        found = find_mistakes(self.tests, parameters, varies, slopes, self.reference, correlation)
        found += errors.find_mistakes(model, [test.name for test in self.tests])
        if any(isinstance(one, (ShapeErrors, MACErrors)) for one in np.ravel(np.array(error, dtype=object))):
            found += mistakes_of_shapes(self.tests)
        if found:
            raise TestsError(found)
        if pairing == "soft" or (isinstance(error, str) and error == "modal-residual"):
            what = "soft pairing" if pairing == "soft" else "the modal residual"
            raise ValueError(f"tests: {what} is for a single test (got {len(self.tests)})")
        self.layout = Layout.of(parameters, self.tests, varies, slopes, self.reference, correlation)
        data = stack_tests(self.tests)
        common = {"beta": beta, "error": errors.of_modes}
        options = {"pairing": pairing, "reduction": reduction, "engine": engine, **common}
        parts, tolerance = find_configurations(model, self.tests, self.layout, options)
        joint = JointModel(self.layout, parts, data.n_modes)
        super().__init__(joint, data, self.layout.parameters, name=name, **common)
        self.likelihood.quantities = errors.bound(joint)
        self.tolerance = tolerance
        if self.is_hierarchical:
            self._take(centre_scores(self))

    @classmethod
    def reduced(cls, *args: Any, **options: Any) -> JointProblem:
        """Return ``JointProblem(…)``, which has a certified reduced model unless `reduction` is False.

        Parameters
        ----------
        *args, **options
            Those of `JointProblem`.

        Raises
        ------
        ValueError
            As `JointProblem` does.
        """
        return cls(*args, **options)

    def _posterior_and_gradient(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the log-probability and its gradient, put together from the derivatives in every test."""
        likelihood: Any = copy(self.likelihood)
        n = self.n_structural
        likelihood.model, likelihood.quantities = SlopesByTest(self.model), ()
        terms, slopes = likelihood.terms_and_gradient(points)
        P, modes = len(self.layout.structural), likelihood.of_used(np.arange(self.data.n_modes))
        test = self.model.test[modes]  # ascending
        first = np.flatnonzero(np.diff(test, prepend=-1))
        by_test = np.zeros((len(points), self.layout.n_tests, P))
        by_test[:, test[first]] = np.add.reduceat(slopes[:, :, :P], first, axis=1)
        gradient = self.prior.log_pdf_gradient(points)
        gradient[:, :n] += self.layout.pull_slopes(points[:, :n], by_test)
        gradient[:, n:] += slopes[:, :, P:].sum(axis=1)
        parts = [terms]
        for quantity in self.likelihood.quantities:
            r, J = quantity.residuals_and_slopes(points[:, :n])
            gradient[:, :n] -= np.einsum("nq,nqk->nk", r, J)
            parts.append(quantity.terms(points[:, :n]))
        terms = terms if len(parts) == 1 else np.concatenate(parts, axis=1)
        return self._record_failures(terms, points).sum(axis=1) + self.prior.log_pdf(points), gradient

    def _take(self, layout: Layout) -> None:
        """Let the scores refer to what `layout` says."""
        self.layout = self.model.layout = layout
        self.prior = ScoredPrior(self.parameters, layout)

    @property
    def roles(self) -> tuple[Role, ...]:
        """What each parameter of theta is for."""
        return (*self.layout.roles, *[Role("noise", None)] * (self.ndim - self.n_structural))

    @property
    def is_hierarchical(self) -> bool:  # type: ignore[override]
        """Whether parameters have a distribution that is inferred: a population."""
        return bool(self.layout.scales)

    def values(self, theta: Any) -> FloatArray:
        """Return the parameters of the structure in every test, shape (n_tests, n) or (n_points, n_tests, n).

        Parameters
        ----------
        theta : array_like, shape (ndim,) or (n_points, ndim)

        Returns
        -------
        ndarray
            The order is that of the tests, and of ``layout.structural``; NaN where a parameter is known.
        """
        points, single = self._points(theta)
        values = self.layout.values(points[:, : self.n_structural])
        for t, test in enumerate(self.tests):
            for j, parameter in enumerate(self.layout.structural):
                if parameter.name in test.known:
                    values[:, t, j] = test.known[parameter.name]
        return values[0] if single else values

    def correlations(self, theta: FloatArray) -> FloatArray:
        """Return the correlation matrix of the populations, shape (n, n_populations, n_populations).

        Parameters
        ----------
        theta : ndarray, shape (n, ndim)
        """
        if self.layout.correlation is None:
            return np.tile(np.eye(len(self.layout.drawn)), (len(theta), 1, 1))
        factor = self.layout.correlation.factor(theta[:, : self.n_structural])
        return np.asarray(np.einsum("nik,njk->nij", factor, factor))

    @property
    def states(self) -> tuple[str, ...]:
        """The groups of tests other than the reference, where a parameter varies between groups; else none."""
        groups = dict.fromkeys(test.group for test in self.tests if test.group != self.reference)
        return tuple(groups) if self.layout.by_state else ()

    def losses(self, theta: FloatArray) -> FloatArray:
        """Return the losses 1 − θ/θ_reference, shape (n, n_states, n_parameters that vary between groups).

        Parameters
        ----------
        theta : ndarray, shape (n, ndim)

        Raises
        ------
        ValueError
            If no parameter varies between groups.
        """
        if not self.states:
            raise ValueError("varies: a parameter must vary between groups of tests to have losses (got none)")
        groups = [test.group for test in self.tests]
        later = np.array([groups.index(state) for state in self.states])
        reference = np.full(len(later), groups.index(self.reference))
        return self.layout.losses(theta[:, : self.n_structural], reference, later)

    def simulate_next_test(
        self,
        rng: np.random.Generator,
        theta: FloatArray,
        like: str | None = None,
        covariates: Mapping[str, float] | None = None,
    ) -> tuple[FloatArray, FloatArray]:
        """Return the frequencies of one more test of the structure, Hz: computed, and with the errors of a test.

        Parameters
        ----------
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
        names = [test.name for test in self.tests]
        if like is not None and like not in names:
            raise ValueError(f"like: must be one of {', '.join(names)} (got {like!r})")
        t = 0 if like is None else names.index(like)
        unknown = [name for name in covariates or {} if name not in self.tests[t].covariates]
        if unknown:
            raise ValueError(
                f"covariates: must be among {', '.join(self.tests[t].covariates)} (got {unknown[0]!r})"
            )
        values = self.layout.of_next_test(theta[:, : self.n_structural], rng, t, covariates or {})
        part = next(one for one in self.model.configurations if t in one.tests)
        here = part.tests[part.test] == t
        columns = part.columns[here]
        computed = part.model.frequencies(values[:, part.parameters])[:, part.mode[here]]
        every = np.tile(np.asarray(self.data.frequencies_hz), (len(theta), 1))
        every[:, columns] = computed
        return computed, self.simulate_data(rng, every, theta)[:, columns]

    def configuration(self) -> dict[str, Any]:
        """Return the data that define the posterior, in plain Python types."""
        return super().configuration() | {
            "tests": [test.as_dict() for test in self.tests],
            "populations": {name: one.as_dict() for name, one in self.layout.populations.items()},
            "reference": self.reference,
            "correlated": self.layout.correlation is not None,
        }


def find_mistakes(
    tests: Sequence[Test],
    parameters: Sequence[Parameter],
    varies: Mapping[str, str | Population | Damage],
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
        if name not in names:
            found.append(f"varies: must name parameters among {', '.join(names)} (got {name!r})")
            continue
        here = [test for test in tests if name not in test.known]
        if isinstance(how, str) and how not in VARIES:
            found.append(
                f"varies.{name}: must be one of {', '.join(VARIES)}, a Population or Damage (got {how!r})"
            )
        elif (how == BY_TEST or isinstance(how, Population)) and len(here) < 2:
            found.append(f"varies.{name}: varies by test, and needs two tests or more (got {len(here)})")
        elif how == BY_GROUP or isinstance(how, Damage):
            for t, test in enumerate(tests):
                if not test.group:
                    found.append(f"tests.{t}.group: must be given, as {name} varies by group (got none)")
            if len({test.group for test in here}) < 2:
                found.append(f"varies.{name}: varies by group, and needs two groups or more (got 1)")
    for name in names:
        if tests and all(name in test.known for test in tests):
            found.append(f"tests: {name} must be unknown in one of them; otherwise it is no parameter")
    groups = {test.group for test in tests}
    if tests and reference not in groups:
        found.append(f"reference: must be the group of a test (got {reference!r})")
    if correlation is not None:
        n = len(find_populations(parameters, varies))
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
