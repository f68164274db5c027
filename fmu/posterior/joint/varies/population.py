"""A parameter that scatters from test to test. Its distribution over the tests is inferred."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Literal

import numpy as np

from fmu.arguments import ArgumentError, check_arguments
from fmu.posterior.joint.modal_test import Test
from fmu.posterior.joint.varies.autocorrelation import InTime, find_mistakes_of_times
from fmu.posterior.joint.varies.base import InTests, Theta, Varies
from fmu.posterior.joint.varies.drawn import Drawn
from fmu.posterior.joint.varies.nested import Nested, find_mistakes_of_groups, find_mistakes_of_sds
from fmu.posterior.joint.varies.truncated_normal import TruncatedFamily
from fmu.posterior.parameters import Parameter
from fmu.posterior.priors.base import Normal, Prior, settings_of
from fmu.posterior.priors.one_sided import HalfNormal
from fmu.types import Plain, Positive

_SCATTER = 0.2
"""Scale of the default half-normal prior of a population's standard deviation, relative to the start value."""


@check_arguments
@dataclass(frozen=True)
class Population(Varies):
    """A parameter whose values in the tests are draws from one distribution, which is inferred.

    Attributes
    ----------
    distribution : {"normal", "log-normal"}
        Distribution of the values over the tests, truncated to the parameter's bounds. For ``"normal"``, the mean
        and the standard deviation (in the parameter's unit) are inferred. For ``"log-normal"``, the median and the
        standard deviation of the logarithm are inferred. All these are values before truncation. The mean or
        median has the parameter's own prior and bounds.
    sd : Prior, optional
        Prior of the inferred standard deviation. Default: half-normal, with a scale of a fifth of the parameter's
        starting value, or of 0.2 for ``"log-normal"``.
    between : Prior, optional
        Prior of a second standard deviation, between groups of tests such as seasons, relative to the value. `sd`
        is then the standard deviation within a group (`fmu.posterior.joint.varies.nested`). By default groups do
        not differ.
    sd_by_group : bool
        Whether each group of tests has its own standard deviation, with the prior `sd`, about the common mean or
        median. By default all tests have the same standard deviation.
    correlation_time : float, Prior or "inferred", optional
        Correlation time T of the values: the scores of two tests a time Δt apart have the correlation exp(−Δt/T)
        (`fmu.posterior.joint.varies.autocorrelation`). If a prior is given, T is inferred. With ``"inferred"``, T
        has a log-normal prior with 5 % of its probability below a third of the median time between tests, and 5 %
        above the time from the first test to the last. By default tests are independent.
    by : str
        Covariate that gives the time of each test, such as ``"day"``. It must be a number, different in each test
        in which the parameter is unknown. By default the times are 1, 2, … in the order of the tests.

    Raises
    ------
    ValueError
        If the distribution is unknown, a known correlation time is not positive and finite, or `by` is given
        without a correlation time.
    """

    distribution: Literal["normal", "log-normal"] = "normal"
    sd: Prior | None = None
    between: Prior | None = None
    sd_by_group: bool = False
    correlation_time: Positive | Prior | Literal["inferred"] | None = None
    by: str = ""
    by_test: ClassVar[bool] = True

    def __post_init__(self) -> None:
        if self.by and self.correlation_time is None:
            raise ArgumentError("by", "must be given with a correlation_time", repr(self.by))

    @property
    def population(self) -> Population:
        """The population itself, because the values are drawn from it."""
        return self

    @property
    def is_in_time(self) -> bool:
        """Whether the values are correlated in time."""
        return self.correlation_time is not None

    @property
    def of_logarithm(self) -> bool:
        """Whether the logarithm of the parameter is normally distributed over the tests."""
        return self.distribution == "log-normal"

    def find_mistakes(self, name: str, tests: Sequence[Test]) -> list[str]:
        """Return error messages if the tests do not allow the parameter `name` to scatter from test to test."""
        found = super().find_mistakes(name, tests)
        if self.between is not None:
            found += find_mistakes_of_groups(name, tests)
        if self.sd_by_group:
            found += find_mistakes_of_sds(name, tests)
        if self.correlation_time is not None:
            found += find_mistakes_of_times(name, self.by, tests)
        return list(dict.fromkeys(found))

    def in_tests(self, p: Parameter, of: int, theta: Theta, here: Sequence[int]) -> InTests:
        """Add the population's parameters and a score per test in `here` to theta; return the values in the tests.

        Raise ValueError as `parameters` does, or if the median of the prior `between` or `correlation_time` is
        negative or, as for `fmu.Uniform`, not finite.
        """
        within = self._within_groups(p, of, theta, here)
        if self.between is None:
            return within
        return Nested.of_groups(within, self.between, self.of_logarithm, p.name, of, theta, here)

    def _within_groups(self, p: Parameter, of: int, theta: Theta, here: Sequence[int]) -> Drawn:
        mean, sd = self.parameters(p)
        centre = theta.add(mean, "mean", of)
        groups = [test.group if self.sd_by_group else "" for test in theta.tests]
        numbers = {
            group: theta.add(replace(sd, name=f"{sd.name} [{group}]") if group else sd, "sd", of, group)
            for group in dict.fromkeys(groups[t] for t in here)
        }
        widths = np.array([numbers.get(group, min(numbers.values())) for group in groups])
        n, columns = len(theta.tests), np.zeros(len(theta.tests), dtype=np.int64)
        for t in here:
            name = theta.tests[t].name
            columns[t] = theta.add_score(Parameter(f"{p.name} score [{name}]", 0.0, prior=Normal(1.0)), of, name)
        scored, start = np.isin(range(n), here), (mean.start, np.full(n, sd.start))
        family, how, in_time = TruncatedFamily(self.of_logarithm, p.lower, p.upper), self.correlation_time, None
        if how is not None:
            in_time = InTime.of_tests(how, self.by, p, of, theta, here)
        return Drawn(family, centre, widths, columns, scored, np.zeros(n), start, in_time)

    def parameters(self, of: Parameter) -> tuple[Parameter, Parameter]:
        """Return the population's inferred centre and width as parameters of theta.

        Raises
        ------
        ValueError
            If the distribution is log-normal and the parameter may be zero or negative; if it is normal, `sd` is
            not given and the parameter starts at zero, so that the default prior would have scale zero; or if the
            prior `sd` needs bounds, as `fmu.Uniform` does, or has a negative median.
        """
        if self.of_logarithm and of.lowest <= 0.0:
            raise ValueError(f"{of.name}.lower: must be positive for a log-normal population (got {of.lower})")
        size = _SCATTER * (1.0 if self.of_logarithm else abs(of.start))
        if self.sd is None and size == 0.0:
            raise ValueError(f"{of.name}: a population about zero needs a prior of its sd (got none)")
        prior = HalfNormal(size) if self.sd is None else self.sd
        centre, width = ("median", "log sd") if self.of_logarithm else ("mean", "sd")
        median = prior.start_of(f"{of.name} {width}")
        mean = Parameter(f"{of.name} {centre}", of.start, of.lower, of.upper, of.prior, of.unit)
        unit = "" if self.of_logarithm else of.unit
        return mean, Parameter(f"{of.name} {width}", median, max(0.0, prior.support[0]), np.inf, prior, unit)

    def as_dict(self) -> dict[str, Plain]:
        """Return the settings as a dict of plain Python types."""
        how = self.correlation_time
        return {
            "distribution": self.distribution,
            "sd": None if self.sd is None else self.sd.as_dict(),
            **({} if self.between is None else {"between": self.between.as_dict()}),
            **({"sd_by_group": True} if self.sd_by_group else {}),
            **({} if how is None else {"correlation_time": settings_of(how)}),
            **({"by": self.by} if self.by else {}),
        }
