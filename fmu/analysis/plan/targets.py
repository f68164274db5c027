"""The purpose of a planned test: parameters, a combination of them, a prediction, or a decision about damage.

The loss d of a parameter has mean m and standard deviation s₀ before the test, and standard deviation s₁ after it.
Suppose that the true loss is d*. In the linearised model, the posterior mean after the test is then normally
distributed with mean m + r (d* − m) and variance r s₁², where r = 1 − s₁²/s₀². The expected probability after the
test that the loss exceeds x is

    E P(d > x | test) = Φ( (m + r (d* − m) − x) / (s₁ √(1 + r)) ).

A plan that minimises s₁ is c-optimal (Pukelsheim 2006, *Optimal Design of Experiments*, chapter 2).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.stats

from fmu.analysis.plan.before import Before
from fmu.analysis.plan.sensors.information import State
from fmu.analysis.trace.damage import probably
from fmu.arguments import ArgumentError
from fmu.numbers import share
from fmu.posterior.joint.damage_target import DamageTarget
from fmu.tables import data_frame
from fmu.types import FloatArray

if TYPE_CHECKING:
    import pandas as pd


Target = str | Sequence[str] | Mapping[str, float] | Callable[[FloatArray], FloatArray] | DamageTarget
"""Parameter names; weights of a combination, by name; a prediction from theta without inferred error parameters,
(n, n_structural), to (n,) or (n, t); or a decision about damage."""


PROBABILITIES = ("before", "if_none", "if_twice")
"""Columns that contain probabilities of a loss."""


def losses_of(target: DamageTarget, before: Before, psi: FloatArray) -> FloatArray:
    """Return the losses (n, t) in the planned test at ψ (n, P); `fmu.analysis.plan.before` defines ψ.

    Raises
    ------
    ValueError
        If the planned test resembles a test of the reference state, which has no losses.
    """
    if before.losses:
        return before.losses_at(psi)
    layout, group = before.problem.layout, before.problem.tests[before.test].group
    if group == layout.reference:
        rule = f"must name a test of a group with losses: {', '.join(layout.states)}"
        raise ArgumentError("like", rule, f"a test of {group}")
    found = layout.losses(before.theta(psi))[:, layout.states.index(group)]
    return found[:, [layout.by_state.index(name) for name in target.names]]


def damage_in(target: Target | None) -> DamageTarget | None:
    """Return the target if it is a `DamageTarget`, otherwise None."""
    return target if isinstance(target, DamageTarget) else None


def target_of(target: Target | None, before: Before) -> FloatArray | None:
    """Return the target's derivatives with respect to ψ, (n, t, P), or None if there is no target.

    Losses and predictions are differentiated at the draws by central differences, one-sided at bounds.

    Raises
    ------
    ValueError
        If a name is unknown, the weights are all zero, a prediction does not return finite numbers in n rows, a
        quantity in the target depends on no parameter at some draw, or the target is losses in a test of the
        reference state.
    """
    names = [one.name for one in before.parameters]
    if target is None:
        return None
    if isinstance(target, DamageTarget):
        rows = before.slopes(lambda psi: losses_of(target, before, psi))
    elif callable(target):
        rows = before.slopes(lambda psi: _predict(target, before.theta(psi)))
    else:
        weights = [{target: 1.0}] if isinstance(target, str) else [target] if isinstance(target, Mapping) else []
        weights = weights or [{name: 1.0} for name in target]
        rows = np.zeros((len(before.draws), len(weights), len(names)))
        for t, one in enumerate(weights):
            for name, weight in one.items():
                if name not in names:
                    raise ArgumentError("target", f"must name parameters, {', '.join(names)}", repr(name))
                rows[:, t, names.index(name)] += weight
    if not (rows.shape[1] and np.all(np.any(rows, axis=2))):
        got = "a combination of weight zero" if rows.shape[1] else "no quantity"
        raise ArgumentError("target", "must depend on the parameters", got)
    return rows


def without_the_unneeded(before: Before, target: Target | None) -> Before:
    """Return a copy without the parameters ψ that affect neither the test nor the target.

    If ψ are the structural parameters of a single test with their priors, all are kept. Raise ValueError as
    `target_of` does.
    """
    if before.is_prior:
        return before
    slopes = [before.slopes(before.values), target_of(target, before)]
    found = [part.any(axis=(0, 1)) for part in slopes if part is not None]
    return before.only(np.any(found, axis=0))


def _predict(target: Callable[[FloatArray], FloatArray], theta: FloatArray) -> FloatArray:
    """Return the user's prediction at theta (n, p), shape (n, t).

    Raise ValueError unless it is finite and it has shape (n,) or (n, t).
    """
    found = np.asarray(target(theta), dtype=float)
    if found.shape[:1] != (len(theta),) or found.ndim > 2 or not np.all(np.isfinite(found)):
        rule = f"must return finite numbers of shape (n,) or (n, t) at theta (n, {theta.shape[1]})"
        raise ArgumentError("target", rule, f"shape {found.shape}")
    return found.reshape(len(theta), -1)


@dataclass(frozen=True, eq=False)
class Decision:
    """A decision about damage that a planned test has to support.

    Attributes
    ----------
    names : tuple of str
        Names of the parameters whose losses matter.
    beyond : float
        Smallest loss x that matters.
    mean : ndarray, shape (t,)
        Mean m of each loss before the test.
    """

    names: tuple[str, ...]
    beyond: float
    mean: FloatArray

    @classmethod
    def of(cls, target: Target | None, before: Before) -> Decision | None:
        """Return the decision that a `DamageTarget` describes, or None for any other target.

        Raise ValueError if the planned test resembles a test of the reference state, which has no losses.
        """
        damage = damage_in(target)
        if damage is None:
            return None
        return cls(damage.names, damage.beyond, losses_of(damage, before, before.reference[None])[0])

    def expect(self, rows: FloatArray, state: State) -> pd.DataFrame:
        """Return a table of the test's expected result for each loss, by the formula in the module docstring.

        Columns: ``sd_before`` and ``sd_after`` of the loss; ``before``, the probability before the test that the
        loss exceeds x; and the expected probability after it, ``if_none`` if there is no loss (false alarm) and
        ``if_twice`` if the loss is 2 x (power). All are averages over the draws. `rows` are the derivatives of the
        losses with respect to the scaled parameters, (n, t, P).
        """
        s0 = np.linalg.norm(rows, axis=2)
        s1 = np.sqrt(np.einsum("ntp,npq,ntq->nt", rows, state.covariance(), rows))
        r = np.clip(1.0 - (s1 / s0) ** 2, 0.0, 1.0)
        columns = {"sd_before": s0, "sd_after": s1, "before": scipy.stats.norm.cdf((self.mean - self.beyond) / s0)}
        for name, truth in (("if_none", 0.0), ("if_twice", 2.0 * self.beyond)):
            off = self.mean + r * (truth - self.mean) - self.beyond
            columns[name] = scipy.stats.norm.cdf(off / (s1 * np.sqrt(1.0 + r)))
        return data_frame({key: np.mean(one, axis=0) for key, one in columns.items()}, "loss", self.names)

    def worst(self, rows: FloatArray, state: State) -> dict[str, float]:
        """Return the largest ``if_none`` and the smallest ``if_twice`` over all losses; see `expect`."""
        table = self.expect(rows, state)
        return {"if_none": float(table["if_none"].max()), "if_twice": float(table["if_twice"].min())}

    def sentences(self, table: pd.DataFrame) -> list[str]:
        """Return one sentence for each row of the table from `expect`."""
        beyond, twice = share(self.beyond), share(2.0 * self.beyond)
        return [
            f"The probability that {name} has lost more than {beyond} is {probably(row.before)} before the test. "
            f"After it, {probably(row.if_twice)} is expected if {name} has lost {twice}, and "
            f"{probably(row.if_none)} if it has lost nothing."
            for name, row in table.iterrows()
        ]


def with_probabilities_in_words(table: pd.DataFrame) -> pd.DataFrame:
    """Return the table with its probabilities as text, such as ``"32 %"`` or ``"< 1 %"``."""
    return table.assign(**{key: table[key].map(probably) for key in PROBABILITIES if key in table})
