"""One modal test of several: the measured modes, and the known changes of the structure in this test."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from fmu.arguments import check_arguments
from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.parameters import require_name
from fmu.types import Plain


class TestsError(ValueError):
    """Error in the tests, or in the parameters that vary between the tests.

    Attributes
    ----------
    mistakes : tuple of str
        One message per error, each preceded by the argument that is wrong: ``tests.2.name: …``.
    """

    __test__ = False

    def __init__(self, mistakes: Sequence[str]) -> None:
        super().__init__("; ".join(mistakes))
        self.mistakes = tuple(mistakes)


@check_arguments
@dataclass(frozen=True, eq=False)
class Test:
    """One modal test of a structure that was tested several times; see `fmu.JointProblem`.

    Attributes
    ----------
    name : str
        Name for tables and figures, different for every test.
    data : ModalData
        The measured modes. Modes with the same label in different tests are the same mode of the structure. A test
        need not contain every mode.
    group : str
        State, location or season that several tests share, such as ``"before repair"``.
    covariates : mapping of str to float
        Quantities that may have changed the structure from test to test, such as ``{"temperature": 12.5}``.
    masses : mapping of node or rigid arm to float, kg
        Point masses that were added for this test. A negative value is a mass that was removed.
    springs : mapping of (node or rigid arm, direction) to float, N/m or N·m/rad
        Springs to the ground that were added for this test. A negative value is a spring that was removed.
    known : mapping of str to float
        Known values of parameters in this test, such as the stiffness 0 of a support that was removed.

    Raises
    ------
    ValueError
        If a name is not allowed, or a value is not finite.
    """

    __test__ = False  # pytest must not collect this class

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
        """Known changes and sensors of this test; equal for tests with the same matrices and sensors."""
        changes = (tuple(sorted(part.items(), key=str)) for part in (self.masses, self.springs, self.known))
        return (*changes, tuple(self.data.sensors))

    def as_dict(self) -> dict[str, Plain]:
        """Return a dict of the test's name, group, covariates and known changes, in plain Python types."""
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
