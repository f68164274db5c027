"""One of several modal tests: its measured modes, and the known changes to the structure for this test."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

import numpy as np

from fmu.arguments import ArgumentError, check_arguments
from fmu.formats.modes.csv import read_campaign
from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.parameters import require_name
from fmu.posterior.priors.base import Prior, prior_in
from fmu.types import Plain


class TestsError(ValueError):
    """Error in the arguments of a joint problem: in its tests, or in arguments that must agree with them.

    Attributes
    ----------
    mistakes : tuple of str
        One message per error, each beginning with the wrong argument: ``tests.2.name: …``.
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
    covariates : mapping of str to float, Prior or None
        Quantities that may have changed the structure from test to test, such as ``{"temperature": 12.5}``. Give
        an uncertain value as its distribution, such as ``fmu.Normal(0.5, mean=12.5)``, and None for a value that
        was not measured. If a parameter depends on the covariate, uncertain and unmeasured values are inferred.
        The prior of an unmeasured value is normal, with the 95 % interval predicted from the other tests.
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
    covariates: Mapping[str, float | Prior | None] = field(default_factory=dict)
    masses: Mapping[Any, float] = field(default_factory=dict)
    springs: Mapping[tuple[Any, str], float] = field(default_factory=dict)
    known: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        require_name(self.name)
        if self.group:
            require_name(self.group, "group")

    @classmethod
    @check_arguments
    def from_csv(
        cls,
        path: str | os.PathLike[str],
        labels: Sequence[str],
        *,
        masses: Mapping[Any, float] | None = None,
        springs: Mapping[tuple[Any, str], float] | None = None,
        known: Mapping[str, float] | None = None,
        **options: Any,
    ) -> list[Self]:
        """Read the tests of a campaign from a CSV table with one row per test, and return them as a list.

        Parameters
        ----------
        path : path-like
            Table with the columns ``name``, ``group`` (optional), one column per mode in Hz, and one column per
            covariate; see `fmu.formats.modes.csv`. If a test missed a mode, the cell is empty or ``nan``, and the
            mode is left out of that test. A covariate that was not measured is empty, ``nan`` or ``missing``.
        labels : sequence of str
            Names of the frequency columns, in mode order.
        masses, springs, known
            The class attributes with these names, the same for all tests.
        **options
            Other arguments of `fmu.ModalData` for all modes, such as ``sd_hz`` or ``sensors``.

        Raises
        ------
        ValueError
            If the table is invalid (the message lists every error with its line and column), `labels` is empty, or
            an option is invalid.
        FileNotFoundError
            If the file does not exist.
        """
        if len(labels) == 0:
            raise ArgumentError("labels", "must name the columns with frequencies, one at least", "none")
        campaign = read_campaign(Path(path), labels)
        modes = ModalData(np.ones(len(labels)), labels=tuple(labels), **options)
        given = masses or {}, springs or {}, known or {}
        rows = zip(campaign.names, campaign.groups, campaign.covariates, campaign.frequencies_hz, strict=True)
        return [cls(name, modes.with_frequencies(f), group, by, *given) for name, group, by, f in rows]

    @property
    def configuration(self) -> tuple[Any, ...]:
        """Known changes and sensors of this test. Tests with equal values have the same matrices and sensors."""
        changes = (tuple(sorted(part.items(), key=str)) for part in (self.masses, self.springs, self.known))
        return (*changes, tuple(self.data.sensors))

    def known_covariate(self, name: str) -> float | None:
        """Return the value of a covariate, or None if the test does not have it or its value is inferred."""
        given = self.covariates.get(name)
        return None if given is None or isinstance(given, Prior) else float(given)

    def as_dict(self) -> dict[str, Plain]:
        """Return the test's name, group, covariates and known changes as a dict of plain Python types."""
        springs: list[list[Plain]] = [
            [str(place), direction, float(k)] for (place, direction), k in self.springs.items()
        ]
        inferred: dict[str, Plain] = {
            name: None if (prior := prior_in(x)) is None else prior.as_dict()
            for name, x in self.covariates.items()
            if self.known_covariate(name) is None
        }
        known = {name: x for name in self.covariates if (x := self.known_covariate(name)) is not None}
        return {
            "name": self.name,
            "group": self.group,
            "covariates": known,
            **({"inferred_covariates": inferred} if inferred else {}),
            "masses": {str(place): float(m) for place, m in self.masses.items()},
            "springs": springs,
            "known": {name: float(x) for name, x in self.known.items()},
        }
