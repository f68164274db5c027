"""Tables 1 to 4 in the paper as data: the printed digits, and corrections of misprints.

Boulkaibet, Marwala, Mthembu, Friswell & Adhikari, *Sampling Techniques in Bayesian Finite Element Model
Updating*, section 5: Tables 1 and 3 contain the updated parameters. Tables 2 and 4 contain the model frequencies f
at these parameters, and their errors |f − f_m|/f_m relative to the measured frequencies f_m.

A number is stored as its printed digits (`Printed`), because the digits show how it was rounded. If other cells
expose a cell as a misprint, the corrected value is stored beside the printed one: `Column.theta` and
`Column.meant_hz` are corrected, `Column.printed_theta` and `Column.printed_hz` are not.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike

from fmu.types import FloatArray

COLUMNS = ("initial", "mh", "slice", "hmc")
N_SAMPLES = 1000


@dataclass(frozen=True)
class Printed:
    """A number as printed: ``digits × 10**exponent``.

    Attributes
    ----------
    digits : str
        The mantissa as printed, trailing zeros included.
    exponent : int
        Exponent of the power of ten that multiplies the mantissa.
    """

    digits: str
    exponent: int = 0

    def __str__(self) -> str:
        return f"{self.digits}e{self.exponent}" if self.exponent else self.digits

    @property
    def value(self) -> float:
        """Numerical value."""
        return float(f"{self.digits}e{self.exponent}")

    @property
    def decimals(self) -> int:
        """Number of decimals in the mantissa."""
        return len(self.digits.partition(".")[2])

    @property
    def half_unit(self) -> float:
        """Half a unit in the last digit: the largest rounding error of `value`."""
        return float(f"0.5e{self.exponent - self.decimals}")

    def allows(self, value: float, slack: float = 0.0) -> bool:
        """Return True if rounding can turn some number within `slack` of `value` into the printed number.

        A tie may have been rounded up or down, so the limit is slightly more than half a unit.
        """
        return bool(abs(value - self.value) <= self.half_unit * (1.0 + 1e-9) + slack)


@dataclass(frozen=True)
class Column:
    """One column of a pair of tables: a parameter vector, and the model frequencies there.

    Attributes
    ----------
    name : str
        One of `COLUMNS`.
    title : str
        The column's heading in the paper.
    parameters : tuple of Printed
        Parameters as printed in Table 1 or 3, SI units.
    frequencies : tuple of Printed
        Frequencies as printed in Table 2 or 4, Hz.
    errors : tuple of Printed
        Errors printed beside the frequencies, %.
    corrected_parameters : mapping of int to float
        Values of misprinted parameters that reproduce the printed frequencies, keyed by index, SI units.
    corrected_frequencies : mapping of int to float
        Values of misprinted frequencies that reproduce the printed errors, keyed by index, Hz.
    """

    name: str
    title: str
    parameters: tuple[Printed, ...]
    frequencies: tuple[Printed, ...]
    errors: tuple[Printed, ...]
    corrected_parameters: Mapping[int, float] = field(default_factory=dict)
    corrected_frequencies: Mapping[int, float] = field(default_factory=dict)

    @property
    def printed_theta(self) -> FloatArray:
        """Parameters as printed, SI units, shape (ndim,)."""
        return _values(self.parameters)

    @property
    def theta(self) -> FloatArray:
        """Parameters that reproduce the printed frequencies, with misprints corrected, SI units, shape (ndim,)."""
        return _values(self.parameters, self.corrected_parameters)

    @property
    def printed_hz(self) -> FloatArray:
        """Frequencies as printed, Hz, shape (n_modes,)."""
        return _values(self.frequencies)

    @property
    def meant_hz(self) -> FloatArray:
        """Frequencies with misprints corrected, Hz, shape (n_modes,)."""
        return _values(self.frequencies, self.corrected_frequencies)

    @property
    def half_unit_hz(self) -> FloatArray:
        """Half a unit in each frequency's last printed digit, Hz, shape (n_modes,)."""
        return np.array([f.half_unit for f in self.frequencies])

    @property
    def printed_errors(self) -> FloatArray:
        """Error column as printed, %, shape (n_modes,)."""
        return _values(self.errors)


@dataclass(frozen=True)
class Experiment:
    """One of the paper's two updating experiments.

    Attributes
    ----------
    case : str
        Name of the built-in case that repeats the experiment.
    section : str
        The section of the paper that describes the experiment.
    parameter_table, frequency_table : int
        Numbers of the two tables in the paper.
    parameter_names : tuple of str
        Names of the parameters in theta order, as in the built-in case.
    measured : tuple of Printed
        Measured frequencies, Hz.
    columns : mapping of str to Column
        The table columns, keyed by name and in the order of `COLUMNS`.
    """

    case: str
    section: str
    parameter_table: int
    frequency_table: int
    parameter_names: tuple[str, ...]
    measured: tuple[Printed, ...]
    columns: Mapping[str, Column]

    @property
    def measured_hz(self) -> FloatArray:
        """Measured frequencies, Hz, shape (n_modes,)."""
        return _values(self.measured)

    def error_percent(self, frequencies: ArrayLike) -> FloatArray:
        """Return the paper's errors |f − f_m|/f_m, in %, for frequencies (..., n_modes) in Hz."""
        return 100.0 * np.abs(np.asarray(frequencies, dtype=float) - self.measured_hz) / self.measured_hz

    def mean_error(self, column: str) -> float:
        """Return the mean of a column's printed errors |f − f_m|/f_m over the modes, %."""
        return float(np.mean(self.columns[column].printed_errors))

    def misfit(self, column: str) -> float:
        """Return Σ(f − f_m)² in Hz² of a column's frequencies, with misprints corrected.

        It is the sum in the likelihood, eq. (4) of the paper.
        """
        return float(np.sum((self.columns[column].meant_hz - self.measured_hz) ** 2))

    def inconsistent_errors(self, column: str) -> tuple[int, ...]:
        """Return the indices of the modes whose printed error is inconsistent with the printed frequency.

        An error is inconsistent if rounding of the frequency and the error cannot explain the difference.
        """
        table = self.columns[column]
        recomputed = self.error_percent(table.printed_hz)
        slack = 100.0 * table.half_unit_hz / self.measured_hz
        return tuple(i for i, e in enumerate(table.errors) if not e.allows(float(recomputed[i]), float(slack[i])))


def _values(cells: tuple[Printed, ...], corrections: Mapping[int, float] | None = None) -> FloatArray:
    corrections = corrections or {}
    return np.array([corrections.get(i, cell.value) for i, cell in enumerate(cells)])


def _cells(text: str, exponents: tuple[int, ...] | None = None) -> tuple[Printed, ...]:
    digits = text.split()
    return tuple(Printed(d, e) for d, e in zip(digits, exponents or (0,) * len(digits), strict=True))


def _columns(*columns: Column) -> Mapping[str, Column]:
    return MappingProxyType({column.name: column for column in columns})


_MEASURED = _cells("31.9 197.9 553 1082.2 1781.5")
_PA = (11,) * 5
_M4_M2 = (-9, -9, -4, -4)

_YOUNG = Experiment(
    case="cantilever-young",
    section="5.1",
    parameter_table=1,
    frequency_table=2,
    parameter_names=("E1", "E2", "E3", "E4", "E5"),
    measured=_MEASURED,
    columns=_columns(
        Column(
            "initial",
            "Initial",
            _cells("2.4 2.4 2.4 2.4 2.4", _PA),
            _cells("32.7 209.4 594.8 1237.2 1961.7"),
            _cells("2.51 5.83 7.55 14.32 10.12"),
        ),
        Column(
            "mh",
            "M-H Method",
            _cells("2.177 2.151 1.944 1.785 2.036", _PA),
            _cells("30.8 190.3 541.1 1123.6 1798.2"),
            _cells("3.38 3.85 2.15 3.83 0.93"),
        ),
        Column(
            "slice",
            "Slice Sampling Method",
            _cells("2.387 1.851 1.849 1.853 1.864", _PA),
            _cells("30.8 190.9 535.2 1127.6 1772.4"),
            _cells("3.44 3.51 3.21 4.2 0.51"),
        ),
        Column(
            "hmc",
            "HMC Method",
            _cells("1.727 2.344 1.838 2.052 2.004", _PA),
            _cells("29 186.2 548 1099.99 1773.6"),
            _cells("9 5.92 0.9 1.64 0.45"),
        ),
    ),
)

_SECTION = Experiment(
    case="cantilever-section",
    section="5.2",
    parameter_table=3,
    frequency_table=4,
    parameter_names=("Ix1", "Ix2", "Ax1", "Ax2"),
    measured=_MEASURED,
    columns=_columns(
        Column(
            "initial",
            "Initial",
            _cells("5 5 8 8", _M4_M2),
            _cells("32 203.5 575.7 1136.8 1889.6"),
            _cells("0.32 2.58 4.1 5.04 6.06"),
            corrected_parameters={0: 7e-9, 1: 7e-9},
        ),
        Column(
            "mh",
            "M-H Method",
            _cells("7.05 6.36 8.28 8.46", _M4_M2),
            _cells("31.3 195.2 552 1087.6 1811.2"),
            _cells("1.97 1.34 0.19 0.5 1.67"),
        ),
        Column(
            "slice",
            "Slice Sampling Method",
            _cells("7.88 3.67 5.62 8.09", _M4_M2),
            _cells("32.9 183.3 556.4 1084 1799.4"),
            _cells("3.14 7.1 0.62 0.16 1.00"),
            corrected_frequencies={1: 183.85},
        ),
        Column(
            "hmc",
            "HMC Method",
            _cells("6.96 6.41 8.92 8.13", _M4_M2),
            _cells("31.6 193.8 545.3 1077 1790.7"),
            _cells("1.08 2.06 1.4 0.48 0.51"),
        ),
    ),
)

EXPERIMENTS: Mapping[str, Experiment] = MappingProxyType({e.case: e for e in (_YOUNG, _SECTION)})
