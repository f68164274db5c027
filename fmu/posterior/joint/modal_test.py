"""One modal test among several: its modes, and what is known to differ in it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from fmu.arguments import check_arguments
from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.parameters import require_name
from fmu.types import Plain


class TestsError(ValueError):
    """Tests, and what varies between them, do not fit together.

    Attributes
    ----------
    mistakes : tuple of str
        Each with its place: ``tests.2.name: …``.
    """

    __test__ = False

    def __init__(self, mistakes: Sequence[str]) -> None:
        super().__init__("; ".join(mistakes))
        self.mistakes = tuple(mistakes)


@check_arguments
@dataclass(frozen=True, eq=False)
class Test:
    """A modal test of a structure that was tested several times, see `fmu.JointProblem`.

    Attributes
    ----------
    name : str
        For tables and figures; no two tests have the same.
    data : ModalData
        What was measured. Modes of different tests that have the same label are the same mode of the structure; a
        test may lack some.
    group : str
        State, place or season of the structure that several tests share, such as ``"before repair"``.
    covariates : mapping of str to float
        What may have changed the structure from test to test, such as ``{"temperature": 12.5}``.
    masses : mapping of place to float, kg
        Point masses that were added for this test; a negative one was taken away.
    springs : mapping of (place, direction) to float, N/m or N·m/rad
        Springs to the ground that were added for this test; a negative one was taken away.
    known : mapping of str to float
        Parameters whose values are known in this test, such as the stiffness 0 of a support that was removed.

    Raises
    ------
    ValueError
        If a name is not allowed, or a value is not finite.
    """

    __test__ = False  # not a test of pytest's

    name: str
    data: ModalData
    group: str = ""
    covariates: Mapping[str, float] = field(default_factory=dict)
    masses: Mapping[Any, float] = field(default_factory=dict)
    springs: Mapping[tuple[Any, str], float] = field(default_factory=dict)
    known: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        require_name(self.name)
        if self.group:
            require_name(self.group, "group")

    @property
    def configuration(self) -> tuple[Any, ...]:
        """What the matrices and the sensors of this test are made of; equal for tests that share them."""
        changes = (tuple(sorted(part.items(), key=str)) for part in (self.masses, self.springs, self.known))
        return (*changes, tuple(self.data.sensors))

    def as_dict(self) -> dict[str, Plain]:
        """Return the known differences of the test, in plain Python types."""
        springs: list[list[Plain]] = [
            [str(place), direction, float(k)] for (place, direction), k in self.springs.items()
        ]
        return {
            "name": self.name,
            "group": self.group,
            "covariates": {name: float(x) for name, x in self.covariates.items()},
            "masses": {str(place): float(m) for place, m in self.masses.items()},
            "springs": springs,
            "known": {name: float(x) for name, x in self.known.items()},
        }
