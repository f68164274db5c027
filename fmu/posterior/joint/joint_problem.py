"""Updating with several tests of one structure at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from typing import Annotated, Any

import numpy as np
from scipy.linalg import block_diag

from fmu.arguments import OwnRule, check_arguments
from fmu.engines.base import Engine
from fmu.fem.black_box import BlackBoxModel
from fmu.fem.modes.changes import changed_model
from fmu.fem.modes.separable import SeparableModel
from fmu.posterior.build import check_names
from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.data.repeated import mean_shapes
from fmu.posterior.errors.base import ErrorModel
from fmu.posterior.errors.mac import MACErrors
from fmu.posterior.errors.shape import ShapeErrors
from fmu.posterior.joint.damage import Damage
from fmu.posterior.joint.joint_model import Configuration, JointModel, SlopesByTest
from fmu.posterior.joint.layout import BY_GROUP, BY_TEST, VARIES, Layout, Role, find_populations
from fmu.posterior.joint.modal_test import Test
from fmu.posterior.joint.population import Population
from fmu.posterior.joint.quantities import Errors, over
from fmu.posterior.joint.scored_prior import ScoredPrior
from fmu.posterior.joint.typical import centre_scores
from fmu.posterior.parameters import Parameter
from fmu.posterior.priors.base import Prior
from fmu.posterior.problem import UpdatingProblem
from fmu.types import FloatArray, Positive


class TestsError(ValueError):
    """Tests, and what varies between them, do not fit together.

    Attributes
    ----------
    mistakes : tuple of str
        Each with its place: ``tests.2.name: …``.
    """

    __test__ = False

    def __init__(self, mistakes: Sequence[str]) -> None:
        super().__init__("; ".join(mistakes))
        self.mistakes = tuple(mistakes)


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
        parts, tolerance = _configurations(model, self.tests, self.layout, options)
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


def stack_tests(tests: Sequence[Test]) -> ModalData:
    """Return the modes of all tests as the modes of one test, with the labels ``"test: mode"``.

    Raises
    ------
    ValueError
        If some tests have an uncertainty of their frequencies or shapes, and others do not.
    """
    every = [test.data for test in tests]
    trusts = [data.sd_hz is not None or data.covariance_hz2 is not None for data in every]
    if len(set(trusts)) > 1:
        lacking = trusts.index(False)
        raise TestsError(
            [f"tests.{lacking}: must have sd or covariance, as tests.{trusts.index(True)} has (got none)"]
        )
    sd = covariance = None
    if any(data.covariance_hz2 is not None for data in every):
        covariance = block_diag(*(_covariance(data) for data in every))
    elif trusts[0]:
        sd = np.concatenate([np.asarray(data.sd_hz) for data in every])
    has_shapes = all(data.shapes is not None and data.sensors == every[0].sensors for data in every)
    shapes_sd = None
    if has_shapes and all(data.shapes_sd is not None for data in every):
        shapes_sd = np.concatenate([np.asarray(data.shapes_sd) for data in every], axis=1)
    return ModalData(
        np.concatenate([np.asarray(data.frequencies_hz) for data in every]),
        numbers=tuple(number for data in every for number in data.numbers),
        counts_rigid=any(data.counts_rigid for data in every),
        sensors=every[0].sensors if has_shapes else (),
        labels=tuple(f"{test.name}: {label}" for test in tests for label in test.data.labels),
        shapes=np.concatenate([np.asarray(data.shapes) for data in every], axis=1) if has_shapes else None,
        sd_hz=sd,
        covariance_hz2=covariance,
        shapes_sd=shapes_sd,
        use=tuple(used for data in every for used in data.use),
    )


def _covariance(data: ModalData) -> FloatArray:
    if data.covariance_hz2 is not None:
        return np.asarray(data.covariance_hz2)
    return np.diag(np.asarray(data.sd_hz) ** 2)


def _configurations(
    model: SeparableModel | BlackBoxModel, tests: Sequence[Test], layout: Layout, options: Mapping[str, Any]
) -> tuple[list[Configuration], Any]:
    """Return the configurations of tests that share matrices, each with its trained model; and their tolerance."""
    keys = [test.configuration for test in tests]
    first_mode = np.cumsum([0, *(test.data.n_modes for test in tests)])
    found, tolerance = [], None
    lower, upper = layout.box()
    for key in dict.fromkeys(keys):
        here = [t for t, other in enumerate(keys) if other == key]
        first = tests[here[0]]
        number = {p.name: j for j, p in enumerate(layout.structural)}
        known = {number[name]: value for name, value in first.known.items()}
        kept = [j for j in range(len(layout.structural)) if j not in known]
        changed: Any = model
        if first.masses or first.springs or known:
            if not isinstance(model, SeparableModel):
                raise TestsError(
                    [f"tests.{here[0]}: changes need a model with matrices (got {type(model).__name__})"]
                )
            try:
                changed = changed_model(model, first.masses, first.springs, known)
            except ValueError as error:
                raise TestsError([f"tests.{here[0]}.{error}"]) from error
        parameters = [
            over(layout.structural[j], float(lower[here, j].min()), float(upper[here, j].max())) for j in kept
        ]
        data, modes = _together([tests[t] for t in here])
        alone = UpdatingProblem.reduced(changed, data, parameters, **options)
        tolerance = alone.tolerance
        distinct, rows = layout.distinct(here, kept)
        of_modes = [tests[t].data.n_modes for t in here]
        found.append(
            Configuration(
                model=alone.model,
                tests=np.array(here),
                distinct=distinct,
                parameters=np.array(kept),
                columns=np.concatenate([np.arange(first_mode[t], first_mode[t + 1]) for t in here]),
                test=np.repeat(np.arange(len(here)), of_modes),
                row=np.repeat(rows, of_modes),
                mode=np.concatenate(modes),
            )
        )
    return found, tolerance


def _together(tests: Sequence[Test]) -> tuple[ModalData, list[Any]]:
    """Return the modes that any of the tests has, and for each test which of them it has.

    Frequencies and shapes are means over the tests, and standard deviations the smallest.
    """
    labels = list(dict.fromkeys(label for test in tests for label in test.data.labels))
    modes = [np.array([labels.index(label) for label in test.data.labels]) for test in tests]
    frequencies = np.full((len(tests), len(labels)), np.nan)
    sd = np.full_like(frequencies, np.nan)
    numbers: dict[int, int] = {}
    counterparts: dict[int, int] = {}
    sensors = tests[0].data.sensors
    shapes = np.full((len(tests), len(sensors), len(labels)), np.nan)
    shapes_sd = np.full_like(shapes, np.nan)
    for t, (test, own) in enumerate(zip(tests, modes, strict=True)):
        data = test.data
        frequencies[t, own] = data.frequencies_hz
        if data.sd_hz is not None or data.covariance_hz2 is not None:
            sd[t, own] = np.sqrt(np.diag(_covariance(data)))
        if data.shapes is not None:
            shapes[t][:, own] = data.shapes
        if data.shapes_sd is not None:
            shapes_sd[t][:, own] = data.shapes_sd
        for known, given in ((numbers, data.numbers), (counterparts, data.counterparts)):
            for mode, value in zip(own.tolist(), given, strict=False):
                if known.setdefault(mode, value) != value:
                    raise TestsError(
                        [f"tests: mode {labels[mode]!r} must have one number (got {known[mode]} and {value})"]
                    )
    seen = ~np.isnan(shapes).all(axis=(0, 1))
    has_shapes = bool(len(sensors)) and bool(seen.all())
    has_sd = has_shapes and not np.isnan(shapes_sd).all(axis=0).any()
    data = ModalData(
        np.nanmean(frequencies, axis=0),
        numbers=tuple(numbers[k] for k in range(len(labels))),
        counts_rigid=any(test.data.counts_rigid for test in tests),
        sensors=sensors,
        labels=tuple(labels),
        shapes=mean_shapes(shapes) if has_shapes else None,
        shapes_sd=np.nanmin(shapes_sd, axis=0) if has_sd else None,
        sd_hz=None if np.isnan(sd).any(axis=0).any() and np.isnan(sd).all(axis=0).any() else np.nanmin(sd, axis=0),
        counterparts=tuple(counterparts[k] for k in range(len(labels))) if counterparts else (),
    )
    return data, modes
