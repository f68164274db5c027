"""Define the decision about damage that a planned test is to support."""

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
        Names of the parameters that may have lost stiffness. With several tests (`fmu.JointProblem`), these
        parameters vary by `Damage` or by group, and the loss is the one in the planned test's group. With one
        test, these parameters may lose stiffness between this test and the planned one.
    beyond : float
        The relative loss that matters, such as 0.1; it must be less than 0.5.
    prior : Prior, optional
        With one test, the prior of each loss; defaults to the prior of `Damage`.
    """

    of: str | Sequence[str]
    beyond: Annotated[float, Interval(gt=0.0, lt=0.5)]
    prior: Prior | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters that may have lost stiffness."""
        return tuple(as_list(self.of))

    def parameters(self, problem: UpdatingProblem) -> list[Parameter]:
        """Return the losses as new parameters for a problem with one test; with several tests the list is empty.

        Raises
        ------
        ValueError
            If no parameter of that name can have a loss, a name occurs twice, or a prior is given for several
            tests.
        """
        several = len(problem.tests) > 1
        known = problem.layout.by_state if several else problem.names[: problem.n_structural]
        whose = 'parameters that vary by damage or by group (varies = "damage")' if several else "parameters"
        wrong = next((name for name in self.names if name not in known), None)
        if wrong is not None or not self.names or len(set(self.names)) < len(self.names):
            rule = f"must name {whose}: {', '.join(known) or 'the problem has none'}"
            raise ArgumentError("target.of", rule, repr(self.of if wrong is None else wrong))
        if several and self.prior is not None:
            raise ArgumentError("target.prior", "must not be given for several tests, which have one", self.prior)
        return [] if several else [loss_parameter(f"{name} loss", self.prior) for name in self.names]
