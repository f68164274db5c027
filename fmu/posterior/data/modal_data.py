"""Measured frequencies and mode shapes."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
from annotated_types import Interval
from numpy.typing import ArrayLike

from fmu.arguments import ArgumentError, check_arguments, shown
from fmu.fem.pairing.matching import Matching
from fmu.formats.modes.csv import read_frequencies, read_shapes
from fmu.formats.modes.measured_modes import LEAST_MPC, MeasuredModes, require_shapes
from fmu.formats.modes.pyoma import pyoma_modes
from fmu.formats.modes.uff import read_uff, write_uff
from fmu.posterior.data.covariance import checked_covariance
from fmu.posterior.data.repeated import RepeatedTests, mean_shapes, shapes_sd
from fmu.types import FloatArray, IntArray, Plain


@check_arguments
@dataclass(frozen=True, eq=False)
class ModalData:
    """Frequencies and mode shapes measured in a modal test, and their uncertainty.

    Attributes
    ----------
    frequencies_hz : ndarray, shape (n_modes,)
        Natural frequencies.
    numbers : tuple of int
        For pairing by number: each measured mode's number (from 1) in the model's sorted spectrum. Defaults to
        1, 2, … Pairing by shape does not follow them.
    sensors : tuple of (node, direction)
        Node and direction of each sensor. A mode with no motion at any sensor cannot be measured.
    shapes : ndarray, shape (n_sensors, n_modes), optional
        Measured mode shapes at the sensors, in any scale.
    labels : tuple of str
        Names of the modes. Defaults to ``"1"``, ``"2"``, …
    sd_hz : ndarray, shape (n_modes,), optional
        Standard deviations of independent frequency errors; a scalar applies to all modes.
    covariance_hz2 : ndarray, shape (n_modes, n_modes), optional
        Covariance of correlated frequency errors, instead of `sd_hz`.
    shapes_sd : ndarray, shape (n_sensors, n_modes), optional
        Error standard deviations for the components of shapes scaled to unit length at the sensors. A scalar
        applies to all components; one number per mode applies to all sensors.
    counterparts : tuple of int, optional
        For pairing by shape if no shapes were measured: the mode of the model before updating that corresponds to
        each measured mode. Modes are numbered from 1 among the elastic modes that move a sensor. Defaults to
        the lowest of these modes, in ascending order. Pairing by number does not follow them.
    tests : RepeatedTests, optional
        The tests whose mean is `frequencies_hz`. The likelihood uses only the mean and its uncertainty. The tests
        are used to predict one more test, and to check whether the tests are independent.
    use : tuple of bool, optional
        Whether each mode is used in updating. Defaults to all modes. Unused modes are paired and predicted too,
        but are not in the likelihood, so that they validate the updated model.
    mpc : ndarray, shape (n_modes,), optional
        Modal phase collinearity of measured shapes that were complex, for display.
    points : Matching, optional
        The measurement points matched to the model's nodes by their coordinates (`fmu.match_points`), for display.
    counts_rigid : bool, optional
        Whether `numbers` count the rigid-body modes of a free structure. Defaults to True if `numbers` are given;
        otherwise mode 1 is the first elastic mode.

    Raises
    ------
    ValueError
        If a frequency is not positive and finite, a shape is zero or not finite, the lengths differ, labels are
        repeated, a standard deviation is not positive and finite, the covariance is not symmetric and positive
        definite or is given together with `sd_hz`, `shapes_sd` is given without shapes, or the counterparts are
        not distinct numbers from 1 or are given together with shapes.
    """

    frequencies_hz: ArrayLike
    numbers: tuple[int, ...] = ()
    sensors: tuple[tuple[Any, str], ...] = ()
    labels: tuple[str, ...] = ()
    shapes: ArrayLike | None = None
    sd_hz: ArrayLike | None = None
    covariance_hz2: ArrayLike | None = None
    shapes_sd: ArrayLike | None = None
    counterparts: tuple[int, ...] = ()
    tests: RepeatedTests | None = None
    use: tuple[bool, ...] = ()
    mpc: FloatArray | None = None
    points: Matching | None = None
    counts_rigid: bool | None = None

    def __post_init__(self) -> None:
        frequencies = np.array(self.frequencies_hz, dtype=float)
        if frequencies.ndim != 1 or len(frequencies) == 0:
            raise ArgumentError("frequencies_hz", "must be a list of numbers", f"shape {frequencies.shape}")
        wrong = ~(np.isfinite(frequencies) & (frequencies > 0))
        if np.any(wrong):
            at = int(np.argmax(wrong))
            raise ArgumentError(f"frequencies_hz.{at}", "must be positive and finite", f"{frequencies[at]} Hz")
        frequencies.flags.writeable = False
        object.__setattr__(self, "frequencies_hz", frequencies)
        n = len(frequencies)
        if self.counts_rigid is None:
            object.__setattr__(self, "counts_rigid", bool(self.numbers))
        object.__setattr__(self, "numbers", tuple(self.numbers) or tuple(range(1, n + 1)))
        object.__setattr__(self, "labels", tuple(self.labels) or tuple(str(i + 1) for i in range(n)))
        object.__setattr__(self, "use", tuple(map(bool, self.use)) or (True,) * n)
        for name in ("numbers", "labels", "use"):
            if len(getattr(self, name)) != n:
                raise ArgumentError(name, f"must be {n}, one per mode", len(getattr(self, name)))

        if len(set(self.labels)) < n:
            raise ArgumentError("labels", "must be distinct", self.labels)
        if self.shapes is not None:
            shapes = np.array(self.shapes, dtype=float)
            if shapes.shape != (len(self.sensors), n):
                raise ArgumentError(
                    "shapes", f"must have shape {(len(self.sensors), n)}, sensors x modes", shapes.shape
                )
            require_shapes(shapes, self.labels)
            shapes.flags.writeable = False
            object.__setattr__(self, "shapes", shapes)
        if self.mpc is not None and np.shape(self.mpc) != (n,):
            raise ArgumentError("mpc", f"must be {n}, one per mode", f"shape {np.shape(self.mpc)}")
        self._check_uncertainty(n)
        self._check_counterparts(n)
        if self.tests is not None and np.shape(self.tests.frequencies_hz)[1] != n:
            raise ArgumentError("tests", f"must be of {n} modes", np.shape(self.tests.frequencies_hz)[1])

    def _check_counterparts(self, n: int) -> None:
        given = tuple(self.counterparts)
        object.__setattr__(self, "counterparts", given)
        if given and (len(given) != n or len(set(given)) < n or min(given) < 1):
            raise ArgumentError("counterparts", f"must be {n} distinct numbers from 1, one per mode", given)
        if given and self.shapes is not None:
            raise ArgumentError("counterparts", "must not be given together with shapes, which pair the modes")

    def _check_uncertainty(self, n: int) -> None:
        if self.sd_hz is not None and self.covariance_hz2 is not None:
            raise ArgumentError(
                "sd_hz", "must not be given together with covariance_hz2", shown(self.covariance_hz2)
            )
        if self.sd_hz is not None:
            object.__setattr__(self, "sd_hz", _spread(self.sd_hz, "sd_hz", (n,), "one per mode"))
        if self.covariance_hz2 is not None:
            object.__setattr__(self, "covariance_hz2", checked_covariance(self.covariance_hz2, n))
        if self.shapes_sd is not None:
            if self.shapes is None:
                raise ArgumentError("shapes_sd", "must not be given without shapes")
            full = (len(self.sensors), n)
            object.__setattr__(self, "shapes_sd", _spread(self.shapes_sd, "shapes_sd", full, "sensors x modes"))

    @classmethod
    @check_arguments
    def from_tests(
        cls,
        frequencies: ArrayLike,
        shapes: ArrayLike | None = None,
        *,
        scatter: str | None = None,
        numbers: tuple[int, ...] = (),
        sensors: tuple[tuple[Any, str], ...] = (),
        labels: tuple[str, ...] = (),
        use: tuple[bool, ...] = (),
    ) -> Self:
        """Average several tests, and return the mean as modal data with an uncertainty estimated from the scatter.

        Parameters
        ----------
        frequencies : array_like, shape (n_tests, n_modes), Hz
            NaN where a test missed a mode (not allowed for "joint"); every mode needs at least two values.
        shapes : array_like, shape (n_tests, n_sensors, n_modes), optional
            Measured shapes in any scale and sign, all NaN where a test missed a mode; see
            `fmu.posterior.data.repeated.mean_shapes`. Their scatter gives the standard deviation of the mean
            shapes (`fmu.posterior.data.repeated.shapes_sd`).
        scatter : {"each", "pooled", "joint"}, optional
            "each": independent modes, each with its own scatter (default if all have ten values). "pooled":
            independent modes with one relative scatter (otherwise the default). "joint": a full covariance, which
            needs three tests more than modes. For all three, see `fmu.posterior.data.repeated.RepeatedTests`.
        numbers, sensors, labels, use
            The class attributes with these names.

        Raises
        ------
        ValueError
            If `scatter` is unknown, a mode has too few values or no scatter, the tests are too few for a joint
            scatter or missed a mode, a shape's MAC with the mean is below 0.5, or the class rejects an argument.
        """
        tests = RepeatedTests(frequencies, scatter, shapes)
        mean, sd, covariance = tests.mean()
        average, spread = (None, None) if shapes is None else (mean_shapes(shapes), shapes_sd(shapes))
        return cls(mean, numbers, sensors, labels, average, sd, covariance, spread, tests=tests, use=use)

    @classmethod
    @check_arguments
    def from_csv(cls, frequencies: str | os.PathLike[str], shapes: str | os.PathLike[str] | None = None) -> Self:
        """Read modes from CSV tables: frequencies from one table and, optionally, shapes from another.

        Parameters
        ----------
        frequencies : path-like
            Table with the columns ``mode``, ``frequency`` (Hz) and, if known, ``number``, ``sd`` (Hz) and ``use``.
        shapes : path-like, optional
            Table with the columns ``place``, ``direction``, and a column for each mode, headed by the mode's name;
            see `fmu.formats.modes.csv`.

        Raises
        ------
        ValueError
            If a table is invalid; the message lists every error with its line and column.
        FileNotFoundError
            If a file does not exist.
        """
        modes = read_frequencies(Path(frequencies))
        if shapes is None:
            return cls.from_modes(modes)
        shown = read_shapes(Path(shapes), modes.labels)
        return cls.from_modes(modes, sensors=shown.sensors, shapes=shown.shapes)

    @classmethod
    @check_arguments
    def from_uff(
        cls,
        path: str | os.PathLike[str],
        nodes: Mapping[int, Any] | None = None,
        modes: Sequence[int] | None = None,
        **options: Any,
    ) -> Self:
        """Read modes from a universal file (dataset 55). This needs the package pyuff.

        Parameters
        ----------
        path : path-like
        nodes : mapping of node number to place, optional
            Maps node numbers in the file to model nodes or their names. Nodes that are not in the mapping are
            skipped. By default, the model's nodes have the same numbers as the nodes in the file.
        modes : sequence of int, optional
            Numbers of the modes in the file. Defaults to all modes.
        **options
            ``sensors`` and ``least_mpc`` of `fmu.formats.modes.uff.read_uff`; other arguments of the class, such
            as ``numbers`` or ``sd_hz``, which the file format does not contain.

        Raises
        ------
        ValueError
            If the file is broken or lacks a mode, node or sensor, or a shape is too complex to be treated as real.
        FileNotFoundError, ImportError
            If the file does not exist, or pyuff is not installed.
        """
        reading = {name: options.pop(name) for name in ("sensors", "least_mpc") if name in options}
        return cls.from_modes(read_uff(Path(path), nodes, modes, **reading), **options)

    @classmethod
    @check_arguments
    def from_pyoma(
        cls,
        result: Any,
        sensors: Sequence[tuple[Any, str]],
        modes: Sequence[int] | None = None,
        *,
        least_mpc: Annotated[float, Interval(ge=0.0, le=1.0)] = LEAST_MPC,
        **options: Any,
    ) -> Self:
        """Return the modes identified by pyOMA_2: frequencies, shapes and, if computed, standard deviations.

        Parameters
        ----------
        result : object
            ``setup["name"].result`` after ``mpe``; with ``calc_unc=True`` it contains standard deviations.
        sensors : sequence of (place, direction)
            The sensor of each channel, in channel order.
        modes : sequence of int, optional
            Numbers of the modes in the result, from 1. Defaults to all modes.
        least_mpc : float
            Smallest modal phase collinearity accepted; see `fmu.formats.modes.measured_modes.real_shapes`.
        **options
            Other arguments of the class, such as ``numbers``; ``sd_hz`` or ``covariance_hz2`` replace the result's
            standard deviations.

        Raises
        ------
        ValueError
            If the result lacks modes, its channels do not match `sensors`, a frequency or standard deviation in it
            is invalid, or a shape is too complex to be treated as real.
        """
        return cls.from_modes(pyoma_modes(result, sensors, modes, least_mpc), **options)

    @check_arguments
    def to_uff(self, path: str | os.PathLike[str], nodes: Mapping[int, Any] | None = None) -> None:
        """Write the frequencies and shapes to a universal file, with six significant digits. This needs pyuff.

        Parameters
        ----------
        path : path-like
            An existing file is replaced.
        nodes : mapping of node number to place, optional
            Maps node numbers in the file to model nodes or their names. Needed if the model's nodes are named.

        Raises
        ------
        ValueError
            If there are no shapes, a node has no number, or two sensors have the same node and axis.
        ImportError
            If pyuff is not installed.
        """
        if self.shapes is None:
            raise ArgumentError("shapes", "must have been measured to be written")
        write_uff(Path(path), self.frequencies_hz, self.shapes, self.sensors, self.numbers, nodes)

    @classmethod
    @check_arguments
    def from_modes(cls, modes: MeasuredModes, **options: Any) -> Self:
        """Convert modes read by `fmu.formats.modes` to modal data; raise ValueError if the class rejects them.

        Parameters
        ----------
        modes : MeasuredModes
        **options
            Further arguments of the class, such as ``numbers``; ``sd_hz`` or ``covariance_hz2`` replace the
            standard deviations in `modes`.
        """
        own = {} if "covariance_hz2" not in options else {"sd_hz": None}
        return cls(**(vars(modes) | own | options))

    def with_frequencies(self, frequencies_hz: FloatArray) -> Self:
        """Return the same modes with other frequencies (n_modes,) in Hz; raise ValueError if no frequency is left.

        Modes with frequency NaN are left out, also from `tests`; an uncertainty from `tests` is then estimated
        again. Without shapes, given numbers or counterparts, each mode's position becomes its counterpart.
        """
        at, by_place = np.flatnonzero(~np.isnan(frequencies_hz)), self.shapes is None and not self.counts_rigid

        def of[Part: (int, str, bool)](values: Sequence[Part]) -> tuple[Part, ...]:
            return tuple(values[int(k)] for k in at) if values else ()

        def along_modes(values: ArrayLike | None) -> FloatArray | None:
            return None if values is None else np.asarray(values)[..., at]

        tests, sd, covariance = self.tests, along_modes(self.sd_hz), along_modes(self.covariance_hz2)
        covariance = None if covariance is None else covariance[at]
        if tests is not None and len(at) < self.n_modes:
            is_own, tests = tests.gave(self.sd_hz, self.covariance_hz2), tests.of_modes(at)
            _, sd, covariance = tests.mean() if is_own else (None, sd, covariance)
        return replace(
            self,
            frequencies_hz=frequencies_hz[at],
            numbers=of(self.numbers),
            labels=of(self.labels),
            shapes=along_modes(self.shapes),
            sd_hz=sd,
            covariance_hz2=covariance,
            shapes_sd=along_modes(self.shapes_sd),
            counterparts=of(self.counterparts or range(1, self.n_modes + 1 if by_place else 1)),
            tests=tests,
            use=of(self.use),
            mpc=along_modes(self.mpc),
        )

    @property
    def n_modes(self) -> int:
        """Number of measured modes."""
        return len(np.asarray(self.frequencies_hz))

    @property
    def used(self) -> IntArray | None:
        """Indices (from 0) of the modes used in updating, shape (n_used,); None if all modes are used."""
        return None if all(self.use) else np.flatnonzero(self.use)

    def as_dict(self) -> dict[str, Plain]:
        """Return the data, without `mpc`, `points` and `counts_rigid`, as a dict of plain Python types."""
        optional = ("shapes", "sd_hz", "covariance_hz2", "shapes_sd")
        given = {name: getattr(self, name) for name in optional if getattr(self, name) is not None}
        return {
            "frequencies_hz": np.asarray(self.frequencies_hz).tolist(),
            "numbers": [int(number) for number in self.numbers],
            "sensors": [[_plain(part) for part in sensor] for sensor in self.sensors],
            "labels": list(self.labels),
            **{name: value.tolist() for name, value in given.items()},
            **({"counterparts": [int(number) for number in self.counterparts]} if self.counterparts else {}),
            **({} if self.tests is None else {"tests": self.tests.as_dict()}),
            **({} if all(self.use) else {"use": list(self.use)}),
        }


def _spread(value: ArrayLike, name: str, shape: tuple[int, ...], what: str) -> FloatArray:
    """Return standard deviations as a read-only array of the given shape; raise ValueError if they are invalid."""
    given = np.array(value, dtype=float)
    if given.shape not in ((), shape[-1:], shape):
        raise ArgumentError(name, f"must be a number or have shape {shape}, {what}", given.shape)
    spread = np.broadcast_to(given, shape).copy()
    wrong = ~(np.isfinite(spread) & (spread > 0))
    if wrong.any():
        raise ArgumentError(name, "must be positive and finite", spread[wrong][0])
    spread.flags.writeable = False
    return spread


def _plain(value: Any) -> Any:
    return value.item() if isinstance(value, np.generic) else value
