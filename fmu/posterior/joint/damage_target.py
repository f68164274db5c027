"""Define the decision about damage that a planned test should support."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

from annotated_types import Interval

from fmu.arguments import ArgumentError, as_list, check_arguments
from fmu.posterior.joint.varies.damage import loss_parameter
from fmu.posterior.parameters import Parameter
from fmu.posterior.priors.base import Prior
from fmu.posterior.problem import UpdatingProblem


@check_arguments
@dataclass(frozen=True)
class DamageTarget:
    """A decision about damage: whether a parameter has lost more than a given share of its value.

    Attributes
    ----------
    of : str or sequence of str
        Names of the parameters, such as stiffnesses, that may have been reduced. In a problem with several tests
        (`fmu.JointProblem`), these parameters must vary by `Damage` or by group, and the loss is the loss in the
        planned test's group. In a problem with one test, the loss occurs between this test and the planned one.
    beyond : float
        The relative loss that matters, such as 0.1; between 0 and 0.5.
    prior : Prior, optional
        Prior of each loss, for a problem with one test; defaults to the prior of `Damage`.

    Raises
    ------
    ValueError
        If `beyond` is not between 0 and 0.5.
    """

    of: str | Sequence[str]
    beyond: Annotated[float, Interval(gt=0.0, lt=0.5)]
    prior: Prior | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters that may have been reduced."""
        return tuple(as_list(self.of))

    def parameters(self, problem: UpdatingProblem) -> list[Parameter]:
        """Return the losses as new parameters if the problem has one test, or an empty list if it has several.

        Raises
        ------
        ValueError
            If no name is given, a name is not that of a parameter that can have a loss, a name occurs twice, or a
            prior is given for a problem with several tests or has no probability between −0.5 and 0.95.
        """
        several = len(problem.tests) > 1
        known = problem.layout.by_state if several else problem.names[: problem.n_structural]
        whose = 'parameters that vary by damage or by group (varies = "damage")' if several else "parameters"
        wrong = next((name for name in self.names if name not in known), None)
        if wrong is not None or not self.names or len(set(self.names)) < len(self.names):
            rule = f"must name {whose}, each once: {', '.join(known) or 'the problem has none'}"
            raise ArgumentError("target.of", rule, repr(self.of if wrong is None else wrong))
        if several and self.prior is not None:
            raise ArgumentError("target.prior", "must not be given for several tests, which have one", self.prior)
        return [] if several else [loss_parameter(f"{name} loss", self.prior) for name in self.names]
