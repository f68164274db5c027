"""Tables 1 to 4 of the paper as data: the printed digits, and the values meant by misprints.

Boulkaibet, Marwala, Mthembu, Friswell & Adhikari, *Sampling Techniques in Bayesian Finite Element Model
Updating*, section 5: Tables 1 and 3 hold the updated parameters, Tables 2 and 4 the frequencies that the model has
there and their errors |f − f_m|/f_m against the measured ones.

A number is kept as the digits on the page (`Printed`), because the digits say how far it was rounded. Where
a cell is a misprint that other cells expose, what it must have meant is kept beside what it says: `Column.theta`
and `Column.meant_hz` are corrected, `Column.printed_theta` and `Column.printed_hz` are not.
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
        The mantissa with the decimals that were printed, trailing zeros included.
    exponent : int
        Exponent of the power of ten printed after the mantissa.
    """

    digits: str
    exponent: int = 0

    def __str__(self) -> str:
        return f"{self.digits}e{self.exponent}" if self.exponent else self.digits

    @property
    def value(self) -> float:
        """The number."""
        return float(f"{self.digits}e{self.exponent}")

    @property
    def decimals(self) -> int:
        """How many decimals the mantissa has."""
        return len(self.digits.partition(".")[2])

    @property
    def half_unit(self) -> float:
        """Half a unit of the last digit: how far the number before rounding may lie from `value`."""
        return float(f"0.5e{self.exponent - self.decimals}")

    def allows(self, value: float, slack: float = 0.0) -> bool:
        """Return whether `value`, give or take `slack`, may have been rounded to this number.

        A tie, rounded up or down, is allowed: hence a hair beyond half a unit.
        """
        return bool(abs(value - self.value) <= self.half_unit * (1.0 + 1e-9) + slack)


@dataclass(frozen=True)
class Column:
    """One column of a pair of tables: a parameter vector and the modes of the model there.

    Attributes
    ----------
    name : str
        One of `COLUMNS`.
    title : str
        The column's heading.
    parameters : tuple of Printed
        As in Table 1 or 3, SI units.
    frequencies : tuple of Printed
        As in Table 2 or 4, Hz.
    errors : tuple of Printed
        The error column beside them, %.
    corrected_parameters : mapping of int to float
        What a misprinted parameter (by position) must have been for the frequencies to come out.
    corrected_frequencies : mapping of int to float
        What a misprinted frequency (by position) must have been for its own error column to come out, Hz.
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
        """The parameters as printed, SI units, shape (ndim,)."""
        return _values(self.parameters)

    @property
    def theta(self) -> FloatArray:
        """The parameters that reproduce the frequency table, SI units, shape (ndim,)."""
        return _values(self.parameters, self.corrected_parameters)

    @property
    def printed_hz(self) -> FloatArray:
        """The frequencies as printed, Hz, shape (n_modes,)."""
        return _values(self.frequencies)

    @property
    def meant_hz(self) -> FloatArray:
        """The frequencies with misprints corrected, Hz, shape (n_modes,)."""
        return _values(self.frequencies, self.corrected_frequencies)

    @property
    def half_unit_hz(self) -> FloatArray:
        """Half a unit of the last printed digit of each frequency, Hz, shape (n_modes,)."""
        return np.array([f.half_unit for f in self.frequencies])

    @property
    def printed_errors(self) -> FloatArray:
        """The error column as printed, %, shape (n_modes,)."""
        return _values(self.errors)


@dataclass(frozen=True)
class Experiment:
    """One of the paper's two updating exercises.

    Attributes
    ----------
    case : str
        Name of the built-in case that recomputes it.
    section : str
        Where the paper describes it.
    parameter_table, frequency_table : int
        Numbers of its two tables.
    parameter_names : tuple of str
        In the order of theta, as in the built-in case.
    measured : tuple of Printed
        The measured frequencies, Hz.
    columns : mapping of str to Column
        Keyed and ordered by `COLUMNS`.
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
        """The measured frequencies, Hz, shape (n_modes,)."""
        return _values(self.measured)

    def error_percent(self, frequencies: ArrayLike) -> FloatArray:
        """Return the paper's error |f − f_m|/f_m of frequencies in Hz, in %, of the same shape (..., n_modes)."""
        return 100.0 * np.abs(np.asarray(frequencies, dtype=float) - self.measured_hz) / self.measured_hz

    def inconsistent_errors(self, column: str) -> tuple[int, ...]:
        """Return the modes (from 0) whose printed error cannot follow from the frequency printed beside it.

        Every frequency that rounds to the printed one is allowed, and so is every error that rounds to the
        printed error: only what rounding cannot explain is returned.
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
