"""A parameter with a loss that begins at an unknown date and is either sudden or growing."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass

import numpy as np

from fmu.arguments import ArgumentError, check_arguments
from fmu.numbers import significant
from fmu.posterior.joint.modal_test import Test
from fmu.posterior.joint.varies.base import Factor, Future, Multiplied, Slope, SuddenLoss, Theta, Varies
from fmu.posterior.joint.varies.damage import loss_parameter, undamaged_in_tests
from fmu.posterior.joint.varies.population import Population
from fmu.posterior.joint.varies.taken import SHARED
from fmu.posterior.parameters import Parameter
from fmu.posterior.priors.base import Prior, Uniform
from fmu.types import FloatArray, Plain

_FEWEST = 3
RAMP = 0.2
"""Share of the time between two tests over which a sudden loss rises, so that the density is continuous."""


@check_arguments
@dataclass(frozen=True)
class UndatedDamage(Varies):
    """A parameter that loses a share d from an unknown date τ on: θ_t = θ₀ (1 − d r_t(τ)).

    Sudden damage: r_t(τ) = clip((x_t − τ) / w_t, 0, 1), where x_t is the time of the test. Tests before τ have no
    loss, and tests after τ have the whole loss. Between two tests the data cannot date the damage, so the
    posterior of τ is nearly flat there. A sharp step would make the log-density jump at x_t, which gradient-based
    samplers cannot follow. So w_t is a fifth of the time since the previous test: if τ is in the last fifth before
    x_t, test t has part of the loss. The log-density is then continuous, with a derivative almost everywhere. If
    chance makes the last undamaged test look slightly damaged, τ may lie in the last fifth before that test.

    Growing damage: r_t(τ) = max(0, x_t − τ) / (x_n − τ), where x_n is the time of the last test. The loss grows
    linearly from τ on, and d is the loss in the last test.

    The date lies between the first test and the last, or the last but one for growing damage. A loss near zero
    means no damage; the date then has its prior distribution. Change points with a uniform prior are treated in
    Carlin, Gelfand & Smith 1992, *J. R. Stat. Soc. C* 41, 389–405.

    Attributes
    ----------
    prior : Prior, optional
        Prior of the loss d; the default is as in `Damage`.
    by : str
        Covariate that gives the time of each test, such as ``"day"``. It must be a number in every test, even if
        the parameter is known there, because the date belongs to the event and not to one parameter. By default
        the times are 1, 2, … in the order of the tests; `fmu.predict_tests` then refuses a growing loss.
    grows : bool
        Whether the loss grows linearly from the date on.
    date : Prior, optional
        Prior of the date, in the time unit; uniform by default.
    event : str
        Name of the event. Parameters with the same event have the same date, and must have the same `by`, `grows`
        and `date`. The date is named ``"day of damage"`` after the time and the event, or ``"test of damage"`` if
        test numbers serve as time.
    scatter : Population, optional
        Population of the undamaged values in the tests. By default all tests have the same undamaged value.

    Raises
    ------
    ValueError
        If the event has no name.
    """

    prior: Prior | None = None
    by: str = ""
    grows: bool = False
    date: Prior | None = None
    event: str = "damage"
    scatter: Population | None = None

    def __post_init__(self) -> None:
        if not self.event:
            raise ArgumentError("event", "must not be empty", repr(self.event))

    @property
    def by_date(self) -> str:
        """Name of the covariate that serves as time; empty if test numbers serve as time."""
        return self.by

    @property
    def population(self) -> Population | None:
        """Population of the undamaged values; None if they are the same in all tests."""
        return self.scatter

    def find_mistakes(self, name: str, tests: Sequence[Test]) -> list[str]:
        """Return error messages if the tests do not allow an undated loss in the parameter `name`."""
        found = [] if self.scatter is None else self.scatter.find_mistakes(name, tests)
        if self.by:
            rule = f"must have {self.by} as a number, which is the time of the damage of {name}"
            wrong = [t for t, test in enumerate(tests) if test.known_covariate(self.by) is None]
            if wrong:
                return found + [
                    f"tests.{t}.covariates: {rule} (got {tests[t].covariates.get(self.by)})" for t in wrong
                ]
        times = np.unique(self.times(tests))
        if len(times) < _FEWEST:
            rule = f"the date of a damage needs tests at {_FEWEST} times or more"
            found.append(f"varies.{name}: {rule} (got {len(times)})")
        elif self.date is not None and not np.isfinite(self.date.log_mass(*self._range(times))):
            first, last = self._range(times)
            rule = f"the date must have a probability between {significant(first)} and {significant(last)}"
            found.append(f"varies.{name}: {rule} (got none)")
        return found

    def times(self, tests: Sequence[Test]) -> FloatArray:
        """Return the test times, (n_tests,): the covariate `by` or, if it is empty, 1, 2, … in test order."""
        if not self.by:
            return np.arange(1.0, len(tests) + 1.0)
        return np.array([test.covariates[self.by] for test in tests], dtype=float)

    def _range(self, times: FloatArray) -> tuple[float, float]:
        """Return the earliest and the latest possible date for the ascending test times."""
        return float(times[0]), float(times[-2 if self.grows else -1])

    def in_tests(self, p: Parameter, of: int, theta: Theta, here: Sequence[int]) -> LostFrom:
        """Add the undamaged value, the loss and the date to theta; return the values in the tests.

        Raise ValueError if another parameter with the same event has a different `by`, `date` or `grows`, or as
        `Population.in_tests` and `loss_parameter` do.
        """
        undamaged = undamaged_in_tests(self.scatter, p, of, theta, here, SHARED)
        loss = theta.add(loss_parameter(f"{p.name} loss", self.prior), "loss", of, self.event)
        times = self.times(theta.tests)
        first, last = self._range(np.unique(times))
        prior = Uniform() if self.date is None else self.date
        date = Parameter(
            f"{self.by or 'test'} of {self.event}", prior.median_within(first, last), first, last, prior
        )
        return LostFrom(undamaged, loss, theta.add_common(date, "date", self.event), times, self.grows, self.by)

    def as_dict(self) -> dict[str, Plain]:
        """Return the settings as a dict of plain Python types."""
        return {
            "prior": None if self.prior is None else self.prior.as_dict(),
            "by": self.by,
            "grows": self.grows,
            "date": None if self.date is None else self.date.as_dict(),
            "event": self.event,
            "scatter": None if self.scatter is None else self.scatter.as_dict(),
        }


@dataclass(frozen=True)
class LostFrom(Multiplied):
    """A structural parameter with a loss from a date on: θ = θ₀ (1 − d r(τ)); see `UndatedDamage`.

    Attributes
    ----------
    of : InTests
        θ₀, the undamaged value in each test.
    column, date : int
        Indices in theta of the loss d and of the date τ.
    times : ndarray, shape (n_tests,)
        The time of each test.
    grows : bool
        Whether the loss grows from the date on.
    by : str
        Name of the covariate that serves as time; empty if test numbers serve as time.
    """

    column: int
    date: int
    times: FloatArray
    grows: bool
    by: str

    def factor(self, theta: FloatArray) -> Factor:
        """Return the share of the undamaged value that remains in each test, 1 − d r(τ)."""
        loss, n = theta[:, [self.column]], len(self.times)
        share, by_date = self._share(theta, self.times)
        slopes = [Slope(np.full(n, self.column), -share), Slope(np.full(n, self.date), -loss * by_date)]
        return Factor(1.0 - loss * share, slopes)

    def _share(self, theta: FloatArray, times: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the loss shares r at `times`, (n, n_times), and their derivatives with respect to the date."""
        since = times - theta[:, [self.date]]
        if self.grows:
            whole = self.times.max() - theta[:, [self.date]]
            return np.maximum(since, 0.0) / whole, np.where(since > 0.0, (since - whole) / whole**2, 0.0)
        distinct = np.unique(self.times)
        before = np.concatenate([[-np.inf], distinct])[np.searchsorted(distinct, times)]
        width = RAMP * (times - before)
        is_within = (since > 0.0) & (since < width)
        return np.clip(since / width, 0.0, 1.0), np.where(is_within, -1.0 / width, 0.0)

    @property
    def sudden_loss(self) -> SuddenLoss | None:
        """The sudden loss, with the indices in theta of its date and its size, or None if the loss grows."""
        return None if self.grows else SuddenLoss(self.date, self.column, self.times)

    def losses(self, theta: FloatArray, reference: int) -> FloatArray:
        """Return the relative losses in the tests, (n, n_tests), compared with the state before the date."""
        return theta[:, [self.column]] * self._share(theta, self.times)[0]

    def identity(self, test: int) -> Hashable:
        """Return a key. Tests with equal keys have equal parameter values at every theta."""
        return self.of.identity(test), float(self.times[test])

    def box(self, lower: FloatArray, upper: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return limits that the values exceed rarely or never, (n_tests,) each, for given limits of theta."""
        ends = np.stack([lower, upper])[:, [self.date]]
        dates = np.zeros((2, len(lower)))
        dates[:, [self.date]] = ends
        share = self._share(dates, self.times)[0]
        kept = 1.0 - np.stack([end * one for end in (lower[self.column], upper[self.column]) for one in share])
        corners = np.stack(self.of.box(lower, upper))[:, None] * kept
        return corners.min(axis=(0, 1)), corners.max(axis=(0, 1))

    def next_test(self, theta: FloatArray, like: int, future: Future) -> FloatArray:
        """Return the parameter's values (n,) in a further test, which by default has the last test's time."""
        time = np.array([future.covariates.get(self.by, float(self.times.max()))])
        kept = 1.0 - theta[:, self.column] * self._share(theta, time)[0][:, 0]
        return self.of.next_test(theta, like, future) * kept
