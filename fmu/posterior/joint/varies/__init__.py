"""How a parameter of the structure varies between tests, a module for each way."""

from collections.abc import Sequence
from typing import get_args

from fmu.posterior.joint.modal_test import Test
from fmu.posterior.joint.varies.base import Varies
from fmu.posterior.joint.varies.damage import Damage
from fmu.posterior.joint.varies.population import Population
from fmu.posterior.joint.varies.taken import SHARED, ByGroup, ByTest, Shared

VARIES: dict[str, Varies] = {SHARED: Shared(), "test": ByTest(), "group": ByGroup()}
"""The ways that have no settings, by their names."""
Variation = Population | Damage
"""The ways that have settings."""


class Unknown(Varies):
    """A name of no way to vary."""

    def __init__(self, name: str) -> None:
        self.name = name

    def find_mistakes(self, name: str, tests: Sequence[Test]) -> list[str]:
        """Return a mistake that lists the ways."""
        kinds = " or ".join(kind.__name__ for kind in get_args(Variation))
        return [f"varies.{name}: must be one of {', '.join(VARIES)}, a {kinds} (got {self.name!r})"]


def way_of(how: str | Variation) -> Varies:
    """Return how a parameter varies, given by name or as an object."""
    return VARIES.get(how, Unknown(how)) if isinstance(how, str) else how
