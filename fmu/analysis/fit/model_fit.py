"""The verdict on the model: contradicted by the data, not contradicted, or not testable with the data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from fmu.analysis.fit.allowed_scatter import remedy, scatter_sentences
from fmu.analysis.fit.check import (
    HELD_OUT,
    LAW,
    NOISE,
    POPULATION,
    PREDICTED,
    RESIDUALS,
    RESPONSES,
    SHAPE,
    Check,
    beyond,
    failed_checks,
    level_of,
)
from fmu.analysis.fit.checks import checks_of
from fmu.analysis.fit.populations import effective_parameters
from fmu.analysis.trace.misfit import GROUP
from fmu.analysis.trace.reading import has, parameter_names
from fmu.numbers import names_in_words, share

if TYPE_CHECKING:
    import xarray as xr


CONTRADICTED, NOT_CONTRADICTED, NOT_TESTABLE, UNKNOWN, ALLOWED = (
    "contradicted", "not contradicted", "not testable", "unknown", "not contradicted as a model that may be wrong",
)  # fmt: skip
NO_HELD_OUT = "No mode was held out: `use = false` at a mode keeps it out of the updating, as a test of the model"
NO_HELD_OUT_FRF = (
    "No value was held out: `use` and `band` keep FRFs or lines out of the updating, as a test of the model"
)


@dataclass(frozen=True)
class ModelFit:
    """The checks of a model against the data, and the verdict.

    Attributes
    ----------
    checks : tuple of Check
        All checks that were made. The probability that a correct model fails at least one of them is at most
        `fmu.analysis.fit.check.level_of`; this does not cover the checks of mode shapes.
    n_data, n_parameters : int
        Number of independent measured values used in updating, and effective number of parameters, inferred noise
        included.
    left_out : str
        Measured quantities that no check covers, because their residuals have no known distribution; empty if
        there are none.
    scatter : tuple of str
        Sentences on the size of the model discrepancy and its correlation between modes; empty if the model has
        none.
    remedy : str
        How to allow for a model discrepancy if a check failed; empty if no check failed or no further remedy is
        known.
    """

    checks: tuple[Check, ...]
    n_data: int
    n_parameters: int
    left_out: str = ""
    scatter: tuple[str, ...] = ()
    remedy: str = ""

    @property
    def verdict(self) -> str:
        """`UNKNOWN`, `CONTRADICTED`, `NOT_TESTABLE`, `NOT_CONTRADICTED` or, with a discrepancy, `ALLOWED`.

        The verdict is `CONTRADICTED` if a check failed, however many parameters the model has, and `UNKNOWN` if
        there are no checks. If the data do not outnumber the parameters, the model can fit any data that its
        priors allow, so a good fit is no evidence for it. Only held-out modes or FRF values, a population or a
        parameter law then test it. The verdict is `NOT_TESTABLE` if nothing tests the model, or if none of the
        checks could have failed. In the remaining cases it is `ALLOWED` for a model with a discrepancy, and
        `NOT_CONTRADICTED` for a model without one.
        """
        if any(check.failed for check in self.checks):
            return CONTRADICTED
        if not self.checks:
            return UNKNOWN
        is_tested = any(check.kind in (HELD_OUT, POPULATION, LAW) and check.could_fail for check in self.checks)
        if not (is_tested or (self.able and self.n_data > self.n_parameters)):
            return NOT_TESTABLE
        return ALLOWED if self.scatter else NOT_CONTRADICTED

    @property
    def counts(self) -> str:
        """Numbers of data and of parameters in words: ``"10 data, 11 parameters"``."""
        return f"{self.n_data} data, {self.n_parameters} parameter{'' if self.n_parameters == 1 else 's'}"

    @property
    def able(self) -> tuple[Check, ...]:
        """Checks that failed or could have failed."""
        return tuple(check for check in self.checks if check.could_fail)

    @property
    def answer(self) -> str:
        """The verdict in a few words: ``"contradicted by 2 of 6 checks"``."""
        told = len(failed_checks(self.checks))
        if self.verdict == CONTRADICTED:
            return f"contradicted by {told} of {len(self.able)} checks"
        if self.verdict != NOT_TESTABLE:
            return self.verdict
        why = "no check could have failed" if self.n_data > self.n_parameters else self.counts
        return f"not testable: {why}"

    @property
    def against(self) -> tuple[str, ...]:
        """Sentences of the failed checks: first checks that name a cause, then others by increasing p-value."""
        return tuple(check.sentence for check in failed_checks(self.checks))

    @property
    def said(self) -> tuple[str, ...]:
        """Sentences of the failed checks, then sentences on the discrepancy: how to allow for it, or its size."""
        return (*self.against, *self._allowed)

    @property
    def reasons(self) -> tuple[str, ...]:
        """Reasons for the verdict, one sentence each.

        If checks failed, these are their sentences and those on the discrepancy (`said`). If there are no checks,
        the only reason is that nothing measured can be compared with a prediction. Otherwise the reasons state
        which checks could have failed, and either how many degrees of freedom are left or why the model is not
        testable. If no mode or FRF value was held out, a last sentence says how to hold one out.
        """
        if self.verdict == UNKNOWN:
            return ("Nothing that was measured can be compared with a prediction that has an error model.",)
        if self.verdict == CONTRADICTED:
            return self.said
        if self.verdict == NOT_TESTABLE:
            first = (
                f"There are no more data than parameters: {self.counts}. Such a model can follow any data that "
                "its priors allow, and that it follows these does not confirm it."
            )
            if self.n_data > self.n_parameters:
                first = "No check could have failed."
            return (first, *self._allowed, *self._could_fail, *self._held_out)
        left = self.n_data - self.n_parameters
        freedom = f"{self.counts}: {left} degree{'' if left == 1 else 's'} of freedom left." if left > 0 else (
            f"{self.counts}: only what was held out tests the model."
        )  # fmt: skip
        return (*self._allowed, *self._could_fail, freedom, *self._held_out)

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences on the false-alarm rate of the checks, and on inferred noise compared with its prior."""
        level = () if self.verdict in (UNKNOWN, NOT_TESTABLE) else (self._level,)
        return (*level, *self._noise)

    def _of(self, *kinds: str) -> list[Check]:
        return [check for check in self.checks if check.kind in kinds]

    @property
    def _allowed(self) -> tuple[str, ...]:
        """Sentences on the discrepancy: how to allow for it if the model is contradicted, otherwise its size.

        The size is also stated if the model is contradicted but no remedy is known.
        """
        if self.verdict == CONTRADICTED and self.remedy:
            return (f"{self.remedy}.",)
        return tuple(f"{sentence}." for sentence in self.scatter)

    @property
    def _could_fail(self) -> tuple[str, ...]:
        """Sentences that say which passed checks could have failed, and which test nothing.

        They cover the checks of predictions, residuals, FRFs and mode shapes.
        """
        said = []
        for kind, by in ((PREDICTED, "by the other modes"), (HELD_OUT, "though not used in updating")):
            telling = [check for check in self._of(kind) if check.could_fail and np.isfinite(check.below)]
            if telling:
                errors = beyond(min(check.below for check in telling), max(check.above for check in telling))
                of = "its frequency" if len(telling) == 1 else "any of these frequencies"
                said.append(f"Predicted {by}: {_modes(telling)}; errors {errors} of {of} would have been found.")
            silent = [check for check in self._of(kind) if not check.could_fail]
            for why in dict.fromkeys(check.why_not for check in silent):
                same = [check for check in silent if check.why_not == why]
                said.append(f"No check of {_modes(same)}: {why}.")
        said += [
            f"All used data together: {check.found}; {check.shows} would have been found."
            if check.could_fail
            else f"All used data together: {check.found}; no check, since {check.why_not}."
            for check in self._of(RESIDUALS)
        ]
        said += [
            f"{check.of}: {check.found}; {check.shows} would have been found."
            for check in self._of(RESPONSES, HELD_OUT)
            if check.kind == RESPONSES or not np.isfinite(check.below)
        ]
        shapes = self._of(SHAPE)
        if shapes:
            said.append(
                f"Like the measured shape, {shapes[0].shows.replace('below', 'at least')}: {_modes(shapes)}."
            )
        return tuple(said)

    @property
    def _noise(self) -> tuple[str, ...]:
        """Sentences that compare inferred noise with its prior, one for each noise check that passed."""
        return tuple(
            f"{check.of}: {check.found}. "
            + (f"{check.why_not[0].upper()}{check.why_not[1:]}: only beyond {check.limit} would it have counted "
               "against the model. Judge whether errors of that size are possible."
               if check.why_not else f"Beyond {check.limit} it would have counted against the model.")
            for check in self._of(NOISE) if not check.failed
        )  # fmt: skip

    @property
    def _held_out(self) -> tuple[str, ...]:
        advice = NO_HELD_OUT_FRF if self._of(RESPONSES) else NO_HELD_OUT
        return () if self._of(HELD_OUT) else (f"{advice}.",)

    @property
    def _level(self) -> str:
        most = share(level_of(self.checks))
        said = f"A correct model would fail at least one of these checks less than {most} of the time."
        return f"{said} No check tests the {self.left_out}." if self.left_out else said


def model_fit(trace: xr.DataTree) -> ModelFit:
    """Judge whether the model fits the data, using the checks of `fmu.analysis.fit.checks`.

    If the trace stores no squared residuals, there are no checks, and the verdict is `UNKNOWN`.
    """
    if not has(trace, GROUP):
        return ModelFit((), 0, len(parameter_names(trace)))
    told = trace[GROUP].attrs
    n_data, n_parameters = int(told["n_data"]), effective_parameters(trace)
    checks = tuple(checks_of(trace))
    way_out = remedy(trace) if any(check.failed for check in checks) else ""
    of_model = scatter_sentences(trace), way_out
    return ModelFit(checks, n_data, n_parameters, str(told["other"]), *of_model)


def _modes(checks: Sequence[Check]) -> str:
    names = [check.of.removeprefix("mode ") for check in checks]
    return f"mode{'' if len(names) == 1 else 's'} {names_in_words(names)}"
