"""Kinds of variation of a parameter between tests, with one module for each kind."""

from collections.abc import Sequence
from typing import get_args

from fmu.posterior.joint.modal_test import Test
from fmu.posterior.joint.varies.base import Varies
from fmu.posterior.joint.varies.damage import Damage
from fmu.posterior.joint.varies.population import Population
from fmu.posterior.joint.varies.taken import SHARED, ByGroup, ByTest, Shared
from fmu.posterior.joint.varies.undated import UndatedDamage

VARIES: dict[str, Varies] = {SHARED: Shared(), "test": ByTest(), "group": ByGroup()}
"""The kinds of variation without settings, keyed by name."""
Variation = Population | Damage | UndatedDamage
"""The kinds of variation with settings."""


class Unknown(Varies):
    """Placeholder for an unknown kind of variation, so that the error is reported with all other errors."""

    def __init__(self, name: str) -> None:
        self.name = name

    def find_mistakes(self, name: str, tests: Sequence[Test]) -> list[str]:
        """Return a list with one message, which names the possible kinds of variation."""
        kinds = " or ".join(kind.__name__ for kind in get_args(Variation))
        return [f"varies.{name}: must be one of {', '.join(VARIES)}, a {kinds} (got {self.name!r})"]


def way_of(how: str | Variation) -> Varies:
    """Return `how` itself, or the kind of variation if `how` is its name; an unknown name gives an `Unknown`."""
    return VARIES.get(how, Unknown(how)) if isinstance(how, str) else how
