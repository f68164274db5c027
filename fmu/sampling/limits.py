"""Limits of a run: the largest numbers of draws and solves, and the effective sample size (ESS) to reach."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from fmu.numbers import whole

if TYPE_CHECKING:
    from fmu.samplers.loop.record import RunResult

GROWTH_LIMIT = 32
"""Default `max_draws` divided by `draws`."""


class Limits(NamedTuple):
    """The conditions under which `fmu.sample` stops.

    Attributes
    ----------
    first : int
        Number of steps after which convergence is first judged.
    until_ess : float or None
        Bulk and tail ESS that every parameter must reach, in addition to convergence, before the run ends. If it
        is None, the run ends after `first` steps.
    draws, solves : int or None
        Largest number of steps, and of solves; None if there is no limit.
    """

    first: int
    until_ess: float | None = None
    draws: int | None = None
    solves: int | None = None

    @classmethod
    def of(cls, draws: int, until_ess: float | None, max_draws: int | None, max_solves: int | None) -> Limits:
        """Return the limits of a run.

        If neither `max_draws` nor `max_solves` is given, a run with `until_ess` takes at most `GROWTH_LIMIT` times
        `draws` steps. Raise ValueError if a number is out of range, `max_draws` is less than `draws`, or
        `max_draws` or `max_solves` is given without `until_ess`.
        """
        from fmu.samplers.settings import positive_number, whole_number

        draws = whole_number("draws", draws, 1)
        if until_ess is None:
            for name, given in (("max_draws", max_draws), ("max_solves", max_solves)):
                if given is not None:
                    raise ValueError(f"{name}: needs until_ess, as draws is the number without it (got {given!r})")
            return cls(draws)
        positive_number("until_ess", until_ess)
        if max_solves is not None:
            max_solves = whole_number("max_solves", max_solves, 1)
        if max_draws is not None:
            max_draws = whole_number("max_draws", max_draws, draws)
        elif max_solves is None:
            max_draws = GROWTH_LIMIT * draws
        return cls(draws, until_ess, max_draws, max_solves)

    def shorten(self, warmup: int, costs: tuple[float, float]) -> tuple[int, Limits]:
        """Reduce the planned numbers of steps if they would take more than `solves` solves.

        Return the number of warm-up steps and the limits. The warm-up and `first` are shortened by the same
        factor.

        Parameters
        ----------
        warmup : int
            Planned number of warm-up steps.
        costs : tuple of two float
            Solves per step during and after warm-up; see `fmu.samplers.settings.usual_costs`.
        """
        planned = warmup * costs[0] + self.first * costs[1]
        if self.solves is None or planned <= self.solves:
            return warmup, self
        part = self.solves / planned
        return int(part * warmup), self._replace(first=max(int(part * self.first), 1))

    def first_after(self, warmup: int, solves: int, costs: tuple[float, float]) -> int:
        """Return the number of steps to draw before convergence is first judged, at least 1 and at most `first`.

        If there is a limit on the solves, these steps are expected to fit within the solves that remain. `solves`
        is the number of solves that the `warmup` warm-up steps took. If it exceeds the usual number, later steps
        are assumed to exceed their usual cost by the same factor.
        """
        if self.solves is None:
            return self.first
        dearer = max(solves / (warmup * costs[0]), 1.0) if warmup else 1.0
        return max(min(self.first, int((self.solves - solves) / (dearer * costs[1]))), 1)

    def allow(self, result: RunResult) -> tuple[int, str]:
        """Return the number of further steps allowed, and a text that names the limit if it is reached.

        The text is empty if further steps are allowed. Each is assumed to take the average number of solves of the
        steps so far. If the remaining solves suffice for at most 1 % more steps, no further step is allowed.
        """
        allowed = []
        if self.draws is not None:
            allowed.append((self.draws - result.draws, f"{whole(self.draws)} draws per chain"))
        if self.solves is not None:
            drawn = int(result.posterior.stats["n_solves"].sum())
            left = self.solves - drawn - int(result.warmup.stats["n_solves"].sum())
            steps = max(left, 0) * result.draws // max(drawn, 1)
            allowed.append((steps if steps > result.draws // 100 else 0, f"{whole(self.solves)} solves"))
        steps, limit = min(allowed)
        return steps, "" if steps else limit

    def describe_excess(self, result: RunResult, planned_warmup: int) -> str:
        """Return a text on a shortened warm-up, and on an excess of more than 1 % over the limit on solves.

        The text is empty if neither occurred.
        """
        if self.solves is None:
            return ""
        said = ""
        if result.warmup_draws < planned_warmup:
            steps = whole(result.warmup_draws)
            said = f", which shortened its warm-up from {whole(planned_warmup)} to {steps} steps"
        warmed, drawn = (int(part.stats["n_solves"].sum()) for part in (result.warmup, result.posterior))
        if warmed + drawn <= 1.01 * self.solves:
            return said
        return f"{said}: the warm-up took {whole(warmed)} and {whole(result.draws)} draws {whole(drawn)}"
