"""Reader for modes that pyOMA_2 identified from ambient vibrations.

pyOMA_2 is not needed to read its results, which are recognised by their attributes: ``Fn`` (n_modes,) in Hz and
``Phi`` (n_channels, n_modes), complex. Subspace identification with ``calc_unc=True`` adds ``Fn_std`` (n_modes,)
in Hz and ``Phi_std`` (n_channels, n_modes). These are standard deviations estimated from the scatter between parts
of the record (Döhler & Mevel 2013, Mechanical Systems and Signal Processing 38, 346), which the documentation of
pyOMA_2 1.4 calls "covariance".

``Phi_std`` is conservative: in pyOMA_2 1.4.3 it includes the error of a shape's scale, which is common to all
components and does not affect a comparison of shapes. For 24 simulated records of the frame in
tests/formats/modes/ambient.py, ``Phi_std`` is 6 to 65 times the scatter of shapes of unit length; ``Fn_std`` is
0.9 to 1.1 times the scatter of the two lower frequencies.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from fmu.arguments import ArgumentError
from fmu.formats.modes.measured_modes import (
    LEAST_MPC,
    MOST_MODES,
    Collinearity,
    Computed,
    MeasuredModes,
    ModeNumber,
    ModesError,
    ModesFormat,
    Sensors,
    checked_file,
    real_shapes,
)
from fmu.formats.shown import in_words, quote
from fmu.plain_data import mapping_in
from fmu.types import AnyArray, FloatArray

_KEPT = ("Fn", "Phi", "Fn_std", "Phi_std", "Xi")
FIXED = 1e-3
"""Standard deviation assigned to the component that scales its shape, relative to the smallest of the others."""


def pyoma_modes(
    result: object,
    sensors: Sensors,
    modes: Sequence[int] | None = None,
    least_mpc: float = LEAST_MPC,
) -> MeasuredModes:
    """Convert a pyOMA_2 result to measured modes.

    Parameters
    ----------
    result : object
        ``setup["name"].result`` after ``mpe``, an object with the same attributes, or a mapping with their names.
    sensors : sequence of (place, direction)
        Sensor of each channel, in order; a minus sign before the direction reverses the sign of a channel.
    modes : sequence of int, optional
        Mode numbers in the result, counted from 1; all by default.
    least_mpc : float
        Smallest phase collinearity of complex shapes; see `fmu.formats.modes.measured_modes.real_shapes`.

    Raises
    ------
    ModesError
        If the result has too many modes or none, as before ``mpe``; if `modes` is empty or contains a number that
        the result does not have; if there is not one sensor per channel; if the standard deviations do not have
        the shapes of the frequencies and mode shapes; if a frequency or a standard deviation is not positive and
        finite (each mode shape may have one standard deviation of zero); or if a mode shape is zero or not finite,
        or its phase collinearity is below `least_mpc`.

    Notes
    -----
    If several setups were merged after the identification, ``Fn_std`` is the scatter between setups and not the
    uncertainty of their mean. ``Fn_std`` and ``Phi_std`` are then ignored.
    """
    source = type(result).__name__
    given = _parts(result)
    if given["Fn"] is None or given["Phi"] is None:
        raise ModesError(source, ["must have frequencies Fn and shapes Phi (got none: was mpe called?)"])
    frequencies = np.asarray(given["Fn"], dtype=float).reshape(-1)
    phi = np.asarray(given["Phi"], dtype=complex)
    if len(frequencies) > MOST_MODES:
        raise ModesError(source, [f"Fn: must be at most {MOST_MODES} frequencies (got {len(frequencies)})"])
    found = []
    if phi.shape != (len(sensors), len(frequencies)):
        expected = (len(sensors), len(frequencies))
        found.append(
            f"Phi: must have shape {expected}, a sensor a channel, and a mode a frequency (got {phi.shape})"
        )
    chosen = list(range(1, len(frequencies) + 1)) if modes is None else [int(number) for number in modes]
    if not chosen or any(not 1 <= number <= len(frequencies) for number in chosen):
        found.append(f"modes: must lie in 1..{len(frequencies)} (got {quote(chosen)})")
    sd = None if given["Fn_std"] is None else np.array(given["Fn_std"], dtype=float).reshape(-1)
    if sd is not None and len(sd) != len(frequencies):
        found.append(f"Fn_std: must be {len(frequencies)}, one per mode (got {len(sd)})")
    phi_std = None if given["Phi_std"] is None else np.array(given["Phi_std"], dtype=float)
    if not found and phi_std is not None and phi_std.shape != phi.shape:
        found.append(f"Phi_std: must have the shape of Phi, {phi.shape} (got {phi_std.shape})")
    if found:
        raise ModesError(source, found)
    columns = np.array(chosen) - 1
    for name, values in {"Fn": frequencies, **({} if sd is None else {"Fn_std": sd})}.items():
        found += [
            f"{name}: mode {k + 1} must be positive and finite (got {values[k]} Hz)"
            for k in columns
            if not (np.isfinite(values[k]) and values[k] > 0)
        ]
    if found:
        raise ModesError(source, found)
    try:
        shapes, mpc = real_shapes(phi[:, columns], least_mpc)
        shapes_sd = None if phi_std is None else _unit_sd(shapes, phi_std[:, columns])
    except ValueError as error:
        raise ModesError(source, [str(error)]) from None
    labels = tuple(map(str, chosen))
    return MeasuredModes(
        frequencies[columns],
        labels,
        None if sd is None else sd[columns],
        tuple((place, str(direction)) for place, direction in sensors),
        shapes,
        mpc=mpc if np.iscomplexobj(given["Phi"]) else None,
        shapes_sd=shapes_sd,
    )


def _unit_sd(shapes: FloatArray, phi_std: FloatArray) -> FloatArray | None:
    """Return standard deviations for shapes scaled to unit length, shape (n_sensors, n_modes).

    Return None if there is only one sensor. The component that scales a shape has a standard deviation of zero in
    `phi_std`. It is given `FIXED` times the smallest standard deviation of the other components. This changes the
    variance of any ratio by at most a fraction `FIXED`². Raise ArgumentError if a standard deviation is negative
    or not finite, or several in a mode are zero.
    """
    if not np.all(np.isfinite(phi_std)) or np.any(phi_std < 0.0):
        raise ArgumentError("Phi_std", "must be finite and not negative")
    if len(shapes) < 2:
        return None
    sd = phi_std / np.linalg.norm(shapes, axis=0)
    for column in sd.T:
        if np.sum(column == 0.0) > 1:
            raise ArgumentError("Phi_std", "must be positive but at one channel, which scales the shape")
        column[column == 0.0] = FIXED * np.min(column[column > 0.0])
    return sd


def read_pyoma(
    file: Path,
    sensors: Sensors,
    modes: Sequence[ModeNumber] | None = None,
    least_mpc: Collinearity = LEAST_MPC,
) -> MeasuredModes:
    """Read the modes in a pyOMA_2 result that `save_pyoma` wrote.

    Parameters
    ----------
    file : Path
    sensors, modes, least_mpc :
        See `pyoma_modes`.

    Raises
    ------
    FileNotFoundError, ModesError
        See `load_pyoma` and `pyoma_modes`.
    """
    return pyoma_modes(load_pyoma(file), sensors, modes, least_mpc)


def save_pyoma(path: Path, result: object) -> None:
    """Write the result attributes that `pyoma_modes` needs to an ``.npz`` file that a problem file can name."""
    arrays: dict[str, Any] = {name: np.asarray(part) for name, part in _parts(result).items() if part is not None}
    with path.open("wb") as file:
        np.savez(file, **arrays)


def load_pyoma(path: Path) -> dict[str, AnyArray]:
    """Return the arrays that `save_pyoma` wrote, keyed by name. Nothing is unpickled.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ModesError
        If the file is too large, or not a file of pyOMA_2 results.
    """
    from fmu.formats.matrices.limits import RefusedError
    from fmu.formats.matrices.numpy_files import shapes_in_archive

    checked_file(path)
    try:
        shapes = shapes_in_archive(path)
        with np.load(path, allow_pickle=False) as file:
            found = {name: file[name] for name in _KEPT if name in shapes}
    except RefusedError as refused:
        raise ModesError(path.name, [str(refused)]) from None
    except Exception as error:  # whatever a broken file makes zipfile and NumPy raise
        raise ModesError(
            path.name, [f"must be a file of fmu.formats.modes.pyoma.save_pyoma ({in_words(error)})"]
        ) from error
    wrong = [
        f"{name}: must be numbers (got {part.dtype})"
        for name, part in found.items()
        if part.dtype.kind not in "fiuc"
    ]
    wrong += [
        f"{name}: must be real numbers (got complex ones)"
        for name in ("Fn", "Fn_std", "Phi_std")
        if name in found and found[name].dtype.kind == "c"
    ]
    if wrong:
        raise ModesError(path.name, wrong)
    return found


def _parts(result: object) -> dict[str, ArrayLike | None]:
    """Return the result attributes that fmu uses, keyed by name.

    A missing attribute is None, and so are the standard deviations of merged setups.
    """
    given = {name: _attribute(result, name) for name in _KEPT}
    if _attribute(result, "setups_used") is not None:
        given["Fn_std"] = given["Phi_std"] = None
    return given


def _attribute(result: object, name: str) -> ArrayLike | None:
    table = mapping_in(result)
    return getattr(result, name, None) if table is None else table.get(name)


def computed_pyoma(path: Path, sensors: Sensors, _deck: Path | None = None) -> Computed:
    """Read all modes in a file; see `fmu.formats.modes.measured_modes.ModesFormat`.

    If sensors are given, there must be one per channel. Without sensors, only the frequencies are read. Raise the
    same errors as `read_pyoma`.
    """
    if len(sensors):
        modes = read_pyoma(path, sensors=sensors)
        return modes.frequencies_hz, modes.shapes
    frequencies = np.asarray(load_pyoma(path).get("Fn", ()), dtype=float).reshape(-1)
    if not 0 < len(frequencies) <= MOST_MODES or not np.all(np.isfinite(frequencies) & (frequencies > 0)):
        rule = f"Fn: must be 1 to {MOST_MODES} positive frequencies"
        raise ModesError(path.name, [f"{rule} (got {quote(frequencies.tolist())})"])
    return frequencies, None


FORMAT = ModesFormat(read_pyoma, "{job}.npz", computed_pyoma, has_numbers=False)
