"""Map the inferred parameters of all tests to the structural parameters in each test."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.joint.correlation import Correlation
from fmu.posterior.joint.modal_test import Test
from fmu.posterior.joint.outliers import ContaminatedScores
from fmu.posterior.joint.varies.autocorrelation import ScoresInTime
from fmu.posterior.joint.varies.base import Future, InTests, Role, Slope, Varies, add_by_column, sum_by_test
from fmu.posterior.joint.varies.drawn import Drawn, PopulationBatch
from fmu.posterior.joint.varies.taken import SHARED, Held, Taken
from fmu.posterior.parameters import Parameter, box
from fmu.types import FloatArray, IntArray, Plain


@dataclass(frozen=True)
class Layout:
    """Inferred parameters of all tests, and the structural parameters in each test as functions of them.

    For a single test whose parameters are all updated, the layout is the identity.

    Attributes
    ----------
    structural : tuple of Parameter
        The structural parameters, as for a single test.
    parameters : tuple of Parameter
        The inferred parameters except the parameters of the errors: first the main parameters, such as shared
        values, values in each test or group, means, standard deviations, losses and slopes; then the scores.
    tests : tuple of Test
    values_of : tuple of InTests
        For each structural parameter, its values in all tests as a function of theta.
    populations : mapping of str to Varies
        Populations, keyed by the name of the structural parameter that scatters over the tests.
    by_state : tuple of str
        Names of the structural parameters that vary between groups of tests.
    correlation : Correlation, optional
        Correlation between the populations. If it is None, they are independent.
    outliers : ContaminatedScores, optional
        Score density when tests may be outliers. If it is None, there are no outliers.
    in_time : ScoresInTime, optional
        Score density when some scores are correlated in time. If it is None, tests are independent.
    roles : tuple of Role
        Meaning of each parameter in `parameters`.
    reference : str
        The group of tests that losses refer to.
    slopes : dict
        How parameters depend on covariates, in plain Python types.
    by_date : mapping of str to str
        Time covariate of each undated loss, keyed by parameter name; ``""`` if test numbers serve as time.
    """

    structural: tuple[Parameter, ...]
    parameters: tuple[Parameter, ...]
    tests: tuple[Test, ...]
    values_of: tuple[InTests, ...]
    populations: Mapping[str, Varies] = field(default_factory=dict)
    by_state: tuple[str, ...] = ()
    correlation: Correlation | None = None
    outliers: ContaminatedScores | None = None
    in_time: ScoresInTime | None = None
    roles: tuple[Role, ...] = ()
    reference: str = ""
    slopes: Mapping[str, Plain] = field(default_factory=dict)
    by_date: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of_one(cls, parameters: Sequence[Parameter], data: ModalData) -> Layout:
        """Return the layout of a single test: theta consists of the structural parameters that are updated."""
        updated = [j for j, p in enumerate(parameters) if p.updated]
        return cls(
            tuple(parameters),
            tuple(parameters[j] for j in updated),
            (Test("test", data),),
            tuple(
                Taken(np.array([updated.index(j)])) if p.updated else Held(p, 1) for j, p in enumerate(parameters)
            ),
            roles=tuple(Role(SHARED, j) for j in updated),
        )

    @property
    def held(self) -> dict[str, float]:
        """Values of the structural parameters that are not updated, keyed by name."""
        return {p.name: p.start for p in self.structural if not p.updated}

    @cached_property
    def is_identity(self) -> bool:
        """Whether theta is the list of structural parameters: there is one test and every parameter is updated."""
        return len(self.tests) == 1 and not self.held

    def of_model(self, theta: FloatArray) -> FloatArray:
        """Return the model's parameters followed by the inferred error parameters, at theta (n, ndim).

        The model's parameters are the structural parameters in all tests, one test after the other
        (`fmu.posterior.joint.model_in_tests.ModelInTests`).
        """
        if self.is_identity:
            return theta
        n = len(self.parameters)
        return np.concatenate([self.values(theta[:, :n]).reshape(len(theta), -1), theta[:, n:]], axis=1)

    @property
    def states(self) -> tuple[str, ...]:
        """Groups of tests other than the reference; empty if no parameter varies between groups."""
        groups = dict.fromkeys(test.group for test in self.tests if test.group != self.reference)
        return tuple(groups) if self.by_state else ()

    def configuration(self) -> dict[str, Plain]:
        """Return the data that define the layout as a dict of plain Python types."""
        return {
            "tests": [test.as_dict() for test in self.tests],
            "populations": {name: one.as_dict() for name, one in self.populations.items()},
            "reference": self.reference,
            "correlated": self.correlation is not None,
            **({} if self.outliers is None else {"outliers": self.outliers.of.as_dict()}),
            **({"slopes": dict(self.slopes)} if self.slopes else {}),
            **({"by_date": dict(self.by_date)} if self.by_date else {}),
        }

    def losses(self, theta: FloatArray) -> FloatArray:
        """Return the losses 1 − θ/θ_reference for the parameters in `by_state`, shape (n, n_states, n_by_state).

        Trends and scatter are left out. If a group has only known values, the value in its first test is used.

        Parameters
        ----------
        theta : ndarray, shape (n, n_parameters)

        Raises
        ------
        ValueError
            If no parameter varies between groups.
        """
        if not self.states:
            raise ValueError("varies: a parameter must vary between groups of tests to have losses (got none)")
        groups = [test.group for test in self.tests]
        later, reference = [groups.index(state) for state in self.states], groups.index(self.reference)
        found = []
        for parameter, value_of in zip(self.structural, self.values_of, strict=True):
            if parameter.name in self.by_state:
                found.append(value_of.losses(theta, reference)[:, later])
        return np.stack(found, axis=2)

    def losses_by_test(self, theta: FloatArray) -> FloatArray:
        """Return the undated losses in each test, (n, n_tests, n_by_date). `by_date` must not be empty."""
        of = [
            value_of.losses(theta, 0)
            for parameter, value_of in zip(self.structural, self.values_of, strict=True)
            if parameter.name in self.by_date
        ]
        return np.stack(of, axis=2)

    def correlations(self, theta: FloatArray) -> FloatArray:
        """Return the populations' correlation matrices (I if independent), (n, n_populations, n_populations)."""
        if self.correlation is None:
            return np.tile(np.eye(len(self.drawn)), (len(theta), 1, 1))
        factor = self.correlation.factor(theta)
        return np.asarray(np.einsum("nik,njk->nij", factor, factor))

    @cached_property
    def drawn(self) -> list[Drawn]:
        """Structural parameters that scatter over the tests, each without its trends, losses and group effects."""
        found = [one.base for one in self.values_of if isinstance(one.base, Drawn)]
        batch = PopulationBatch(found)
        for one in found:
            one.batch = batch
        return found

    @property
    def batch(self) -> PopulationBatch:
        """The parameters in `drawn` as one batch. There must be at least one."""
        return self.drawn[0].batch

    @property
    def scales(self) -> list[int]:
        """Sorted indices in theta of the parameters of the populations and of the score density.

        They are the centres, widths (within groups), correlations and correlation times, and the outlier share.
        """
        found = {k for one in self.drawn for k in (one.centre, *one.widths.tolist())}
        return sorted([*found, *(self.density_of_scores.columns if self.density_of_scores else ())])

    @property
    def density_of_scores(self) -> Correlation | ContaminatedScores | ScoresInTime | None:
        """Score density with correlations or outliers; None if the scores are independent and standard normal."""
        return self.in_time or self.outliers or self.correlation

    def precision_of_scores(self, theta: FloatArray, z: FloatArray) -> FloatArray:
        """Return each test's score precision minus I, given the other tests' scores, shape (n, n_tests, p, p)."""
        if self.outliers is not None:
            return self.outliers.precision(theta, z)
        known = self.in_time or self.correlation
        return np.zeros((*z.shape, z.shape[2])) if known is None else known.precision(theta)

    def remove_centring(self) -> Layout:
        """Return a copy of the layout in the non-centred form, in which every score is a standardised value."""
        references = {one.centre: (np.zeros_like(one.centring), one.reference) for one in self.drawn}
        return replace(self, values_of=tuple(one.refer_to(references) for one in self.values_of))

    def without_time(self) -> Layout:
        """Return a copy of the layout in which scores are independent in time."""
        return replace(self, in_time=None)

    def values(self, theta: FloatArray) -> FloatArray:
        """Return the structural parameters in all tests, (n, n_tests, n_structural), at theta (n, n_parameters).

        Entries for parameters that are known in a test are meaningless.
        """
        return np.stack([value_of(theta)[0] for value_of in self.values_of], axis=2)

    def distinct(self, tests: Sequence[int], parameters: Sequence[int]) -> tuple[IntArray, IntArray]:
        """Return the groups of tests in which the given structural parameters have equal values at every theta.

        Parameters
        ----------
        tests, parameters : sequence of int
            Indices of the tests and of the structural parameters. None of the parameters is known in these tests.

        Returns
        -------
        first : ndarray of int, shape (n_distinct,)
            Index of the first test in each group.
        row : ndarray of int, shape (len(tests),)
            For each test, the index of its group in `first`.
        """
        numbers: dict[Any, int] = {}
        identities = (tuple(self.values_of[j].identity(t) for j in parameters) for t in tests)
        row = np.array([numbers.setdefault(one, len(numbers)) for one in identities])
        return np.array(tests)[np.unique(row, return_index=True)[1]], row

    def of_next_test(
        self,
        theta: FloatArray,
        rng: np.random.Generator,
        scores: FloatArray,
        like: int,
        covariates: Mapping[str, float],
    ) -> FloatArray:
        """Draw the structural parameters in a further test, shape (n, n_structural).

        Parameters
        ----------
        theta : ndarray, shape (n, n_parameters)
        rng : Generator
        scores : ndarray, shape (n, n_populations)
            The further test's standardised values in the populations.
        like : int
            Index of an existing test. The further test belongs to the same group.
        covariates : mapping of str to float
            Default: the mean over the tests or, for the time of an undated loss, the time of the last test.
        """
        future = Future(rng, {one.centre: z for one, z in zip(self.drawn, scores.T, strict=True)}, covariates)
        return np.stack([value_of.next_test(theta, like, future) for value_of in self.values_of], axis=1)

    def draw_scores(self, theta: FloatArray, rng: np.random.Generator, n_tests: int) -> FloatArray:
        """Draw standardised scores, (n, n_tests, n_populations), without outliers and correlation in time."""
        return self.correlate(theta, rng.standard_normal((len(theta), n_tests, len(self.drawn))))

    def correlate(self, theta: FloatArray, z: FloatArray) -> FloatArray:
        """Apply the populations' correlation at theta to independent scores z, (n, n_tests, n_populations)."""
        return z if self.correlation is None else np.einsum("nij,ntj->nti", self.correlation.factor(theta), z)

    def box(self) -> tuple[FloatArray, FloatArray]:
        """Return lower and upper limits that parameter values rarely exceed, each (n_tests, n_structural)."""
        ends = [value_of.box(*box(self.parameters)) for value_of in self.values_of]
        return tuple(np.stack(end, axis=1) for end in zip(*ends, strict=True))  # type: ignore[return-value]

    def chain_slopes(self, theta: FloatArray, slopes: FloatArray, test: IntArray) -> FloatArray:
        """Return the derivatives with respect to theta of m quantities, each from one test (chain rule).

        Parameters
        ----------
        theta : ndarray, shape (n, n_parameters)
        slopes : ndarray, shape (n, m, n_structural)
            Derivatives with respect to the structural parameters in the test; zero for parameters known there.
        test : ndarray of int, shape (m,)
            For each quantity, the index of its test.

        Returns
        -------
        ndarray, shape (n, m, n_parameters)
        """
        found = np.zeros((*slopes.shape[:2], theta.shape[1]))
        rows = np.arange(slopes.shape[1])
        for j, value_of in enumerate(self.values_of):
            for columns, values in value_of(theta)[1]:
                # each quantity has one column here, so += adds every term
                found[:, rows, columns[test]] += slopes[:, :, j] * values[:, test]
        return found

    def gradient(self, theta: FloatArray, slopes: FloatArray, test: IntArray) -> FloatArray:
        """Return the gradient with respect to theta, (n, ndim), of a sum of m terms, each from one test.

        Parameters
        ----------
        theta : ndarray, shape (n, ndim)
        slopes : ndarray, shape (n, m, n_structural + n_noise)
            Derivatives of each term with respect to the structural parameters in its test, followed by the
            derivatives with respect to the inferred error parameters.
        test : ndarray of int, shape (m,)
            For each term, the index of its test.
        """
        n, P = len(self.parameters), len(self.structural)
        by_test = sum_by_test(slopes[..., :P], test, len(self.tests))
        every = [(j, slope) for j, value_of in enumerate(self.values_of) for slope in value_of(theta[:, :n])[1]]
        terms = np.concatenate([by_test[:, :, j] * slope.values for j, slope in every], axis=1)
        columns = np.concatenate([slope.columns for _, slope in every])
        order = np.argsort(columns, kind="stable")
        distinct, first = np.unique(columns[order], return_index=True)
        found = np.zeros_like(theta)
        found[:, distinct] = np.add.reduceat(terms[:, order], first, axis=1)
        found[:, n:] = slopes[:, :, P:].sum(axis=1)
        return found

    def log_prior(self, theta: FloatArray, independent: FloatArray) -> FloatArray:
        """Return the log-prior (n,), given the log-prior `independent` (n,) for independent parameters.

        Independent scores are standard normal. Corrections are added for centred scores, whose density depends on
        the population, and for scores that are correlated or may be outlying.
        """
        value = independent
        for one in self._centred:
            value = value + np.einsum("nt->n", one.log_prior(theta)[0])
        if self.density_of_scores is not None:
            z = self.population_scores(theta)
            value = value + np.einsum("nt->n", self.density_of_scores.log_density(theta, z)[0])
        return value

    def population_scores(self, theta: FloatArray) -> FloatArray:
        """Return the parameter values standardised by their populations, shape (n, n_tests, n_populations)."""
        return np.stack([one.population_scores(theta)[0] for one in self.drawn], axis=2)

    def log_prior_gradient(self, theta: FloatArray, independent: FloatArray) -> FloatArray:
        """Change `independent`, the gradient for independent parameters, to `log_prior`'s gradient; return it."""
        gradient = independent
        for one in self._centred:
            by_score, by_centre, by_width = one.log_prior(theta)[1]
            gradient[:, by_score.columns[one.scored]] += by_score.values[:, one.scored]
            for slope in (by_centre, by_width):
                add_by_column(gradient, slope)
        if self.density_of_scores is not None:
            found = [one.population_scores(theta) for one in self.drawn]
            z = np.stack([z for z, _ in found], axis=2)
            _, by_z, by_columns = self.density_of_scores.log_density(theta, z)
            gradient[:, self.density_of_scores.columns] += by_columns
            for j, (one, (_, slopes)) in enumerate(zip(self.drawn, found, strict=True)):
                of_score, *of_both = (by_z[:, :, j] * np.where(one.scored, s, 0.0) for s in slopes)
                gradient[:, one.columns[one.scored]] += of_score[:, one.scored]
                both = np.full_like(one.widths, one.centre), one.widths
                for columns, of_all in zip(both, of_both, strict=True):
                    add_by_column(gradient, Slope(columns, of_all))
        return gradient

    def log_prior_curvature(self, theta: FloatArray, independent: FloatArray, scale: FloatArray) -> FloatArray:
        """Return −∇² of `log_prior`, (n, ndim, ndim), in units of `scale`. Entries for scores are approximate.

        They ignore the bounds, and mixed entries with the populations' parameters are left out. `independent`, −∇²
        of the log-density for independent parameters in the same units, is overwritten.
        """
        curvature = independent
        for one in self._centred:
            columns = one.columns[one.scored]
            curvature[:, columns, columns] = one.curvature(theta)[:, one.scored] * scale[columns] ** 2
        if self.density_of_scores is not None:
            precision = self.precision_of_scores(theta, self.population_scores(theta))
            slopes = [np.sqrt(one.curvature(theta)) for one in self.drawn]
            for i, of_rows in enumerate(self.drawn):
                for j, of_columns in enumerate(self.drawn):
                    here = of_rows.scored & of_columns.scored
                    rows, columns = of_rows.columns[here], of_columns.columns[here]
                    of_both = precision[:, here, i, j] * slopes[i][:, here] * slopes[j][:, here]
                    curvature[:, rows, columns] += of_both * scale[rows] * scale[columns]
        for one in self.drawn if self.in_time else ():
            one.add_curvature_in_time(theta, curvature, scale)
        return curvature

    def draw_from_prior(self, theta: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Convert draws of independent parameters, theta (n, ndim), to prior draws. `theta` may be overwritten."""
        if self.density_of_scores is not None:
            z = self.draw_scores(theta, rng, len(self.tests))
            z = z if self.outliers is None else z * self.outliers.draw_from_prior(rng, theta)
            z = z if self.in_time is None else self.in_time.correlate(theta, z)
            for j, one in enumerate(self.drawn):
                theta[:, one.columns[one.scored]] = z[:, one.scored, j]
        return self.restore_scores(theta)

    def standardise_scores(self, theta: FloatArray) -> FloatArray:
        """Return a copy of theta (n, ndim) in which all scores are converted to the non-centred form."""
        found = theta.copy()
        for one in self.drawn:
            found[:, one.columns[one.scored]] = one.population_scores(theta)[0][:, one.scored]
        return found

    def restore_scores(self, theta: FloatArray) -> FloatArray:
        """Return theta (n, ndim) with scores converted from the non-centred form to this layout's centring."""
        for one in self._centred:
            theta = one.restore_scores(theta)
        return theta

    @cached_property
    def _centred(self) -> list[Drawn]:
        return [one for one in self.drawn if np.any(one.centring > 0.0)]
