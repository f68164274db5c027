"""Black-box models whose modes are paired with measured modes, and their gradients."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from fmu.arguments import ArgumentError, first_repeated
from fmu.differences import both_sides
from fmu.fem.black_box import BlackBoxModel
from fmu.fem.modes.modal import assign, mac
from fmu.fem.pairing.modal_model import ModalModel
from fmu.fem.pairing.paired_structure import PAIRINGS
from fmu.fem.pairing.prediction import ModalPrediction
from fmu.fem.programs.answers import Answer, AnswerError
from fmu.fem.programs.solves import Failure
from fmu.fem.programs.store import Solve
from fmu.numbers import significant
from fmu.types import FloatArray, IntArray

_PROBES = 50
_WIDEST = 0.02
"""Largest step of central differences, relative to a parameter's scale, if a deck has few digits."""


class PairedBlackBox(ModalModel):
    """A black-box model whose modes are paired with the measured modes; `of` builds one.

    Parameters
    ----------
    black_box : BlackBoxModel
    answer : Answer
        Function result at the starting point, which shows which arrays the function returns.
    pairing : {"shape", "index"}
        ``"shape"``: one to one by MAC, if shapes were measured and the function returns shapes, otherwise by
        number. ``"index"``: by number.
    numbers : tuple of int
        Number (from 1) of each measured mode in the order in which the function returns modes.
    shapes : ndarray, shape (n_sensors, n_modes), optional
        Measured shapes.
    measured_hz : ndarray, shape (n_modes,)
        Measured frequencies, which decide between modes that have the same shape at the sensors.
    lower, upper, scale : ndarray, shape (n_parameters,)
        Bounds that central differences stay within, and the scale of each parameter.

    Attributes
    ----------
    by_shape : bool
        Whether modes are paired by MAC.
    gives_shapes : bool
        Whether the function gives shapes at the measured sensors.
    solves_per_gradient : int
        Solves needed for the frequencies and their gradient: 1, or 2 n_parameters + 1 with central differences.
    """

    def __init__(
        self,
        black_box: BlackBoxModel,
        answer: Answer,
        *,
        pairing: str,
        numbers: tuple[int, ...],
        shapes: FloatArray | None,
        measured_hz: FloatArray,
        lower: FloatArray,
        upper: FloatArray,
        scale: FloatArray,
    ) -> None:
        self.black_box, self.functions = black_box, (black_box,)
        self.name = black_box.name
        self.n_parameters, self.n_modes = black_box.n_parameters, len(numbers)
        self.numbers, self.measured_hz = numbers, measured_hz
        self.lower, self.upper, self.scale = lower, upper, scale
        self.step = black_box.step * scale
        self.reference = shapes if pairing == "shape" and answer.shapes is not None else None
        self.by_shape = self.reference is not None
        both = answer.shapes is not None and shapes is not None
        self._n_sensors = len(shapes) if both and len(answer.shapes) == len(shapes) else None  # type: ignore[arg-type]
        self.gives_shapes = self._n_sensors is not None
        self.solves_per_shape_gradient = 2 * self.n_parameters + 1
        self.solves_per_gradient = 1 if answer.gradient is not None else self.solves_per_shape_gradient

    @classmethod
    def of(cls, black_box: BlackBoxModel, *, pairing: str, start: FloatArray, **measured: Any) -> PairedBlackBox:
        """Return the paired model of a function, after a call at `start` (n_parameters,); see `BlackBoxModel.at`.

        The other arguments are the class's parameters.

        Raises
        ------
        ValueError
            If the pairing is unknown, or modes are paired by number and two measured modes have the same number.
            Also if, at the starting point, the function fails, gives too few modes or invalid frequencies, does
            not reproduce a stored result, or gives shapes that are not finite or do not fit the sensors although
            modes are paired by MAC.
        """
        if pairing not in PAIRINGS:
            raise ValueError(f"pairing: must be one of {PAIRINGS} (got {pairing!r})")
        try:
            answer = black_box.at(start)
            paired = cls(black_box, answer, pairing=pairing, **measured)
            paired._columns(answer)
            paired._widen_step(start)
        except AnswerError as error:
            raise ValueError(f"{black_box.place}: {error} at the start {start.tolist()}") from error
        except ValueError as error:
            raise ValueError(f"{black_box.place}: {error}") from error
        if not paired.by_shape and first_repeated(paired.numbers) is not None:
            rule = "must be distinct, one per mode, as modes of the function are paired by number"
            raise ArgumentError("numbers", rule, paired.numbers)
        return paired

    def __repr__(self) -> str:
        return f"PairedBlackBox({self.black_box!r}, by {'MAC' if self.by_shape else 'number'})"

    @property
    def reasons(self) -> list[Failure]:
        """The first failures of the function, each with its theta and reason."""
        return self.black_box.reasons

    def frequencies(self, theta: FloatArray) -> FloatArray:
        """Return frequencies in Hz, shape (n, n_modes), with NaN where the function or the pairing failed."""
        return self._pair_modes(theta)[0]

    def frequencies_and_gradient(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return frequencies in Hz, shape (n, n_modes), and their gradients, shape (n, n_modes, n_parameters).

        If the function returns no gradients, central differences with the perturbations in eq. (15) of Boulkaibet
        et al. (`fmu.paper.published`) are used. They are one-sided at a bound and where the function fails on one
        side, and NaN where it fails on both.
        """
        frequencies, gradient, _ = self._pair_modes(theta)
        missing = np.isnan(gradient).all(axis=(1, 2)) & ~np.isnan(frequencies).any(axis=1)
        if missing.any():
            gradient[missing] = self._differences(
                theta[missing], frequencies[missing], lambda points, _: self.frequencies(points)
            )
        return frequencies, gradient

    def observed(self, theta: FloatArray, gradient: bool = False) -> ModalPrediction:
        """Return the predicted frequencies and sensor shapes at theta (n, n_parameters).

        Derivatives are included if `gradient`. Shape derivatives are central differences. Frequency derivatives
        are the function's own gradients or, if it returns no gradients, central differences.

        Raises
        ------
        ValueError
            If no shapes were measured, or the function gives no shapes at the measured sensors.
        """
        if self._n_sensors is None:
            raise ValueError(f"{self.black_box.place}: must return shapes, as shapes have errors (it gives none)")
        frequencies, slopes, shapes = self._pair_modes(theta)
        if not gradient:
            return ModalPrediction(frequencies, shapes)
        values = np.concatenate([frequencies[:, None], shapes], axis=1)
        n, rows, m = values.shape

        def nearby(points: FloatArray, of: IntArray) -> FloatArray:
            f, _, s = self._pair_modes(points)
            # shapes have either sign: take the sign at the central point
            s = s * np.where(np.sum(s * shapes[of], axis=1, keepdims=True) < 0.0, -1.0, 1.0)
            return np.concatenate([f[:, None], s], axis=1).reshape(len(points), -1)

        all_slopes = self._differences(theta, values.reshape(n, -1), nearby).reshape(n, rows, m, -1)
        own = ~np.isnan(slopes).all(axis=(1, 2))
        return ModalPrediction(
            frequencies, shapes, np.where(own[:, None, None], slopes, all_slopes[:, 0]), all_slopes[:, 1:]
        )

    def configuration(self) -> dict[str, object]:
        """Return data that identify the model, as plain Python types."""
        return {**self.black_box.configuration(), "pairing": "shape" if self.by_shape else "index"}

    def reason_at(self, theta: FloatArray) -> str | None:
        """Return why there are no frequencies at theta (n_parameters,), or None if no reason is known."""
        solve = self.black_box.solved.recall(theta)
        if solve is None or solve.reason:
            return None if solve is None else solve.reason
        try:
            self._columns(solve)
        except AnswerError as error:
            return str(error)
        return None

    def _pair_modes(self, theta: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the paired frequencies, the function's own gradients and the shapes; missing values are NaN.

        A result whose modes cannot be paired is recorded as a failure.
        """
        n, m, p, s = len(theta), self.n_modes, self.n_parameters, self._n_sensors or 0
        f, df, phi = np.full((n, m), np.nan), np.full((n, m, p), np.nan), np.full((n, s, m), np.nan)
        for i, solve in enumerate(self.black_box.solved.of(theta)):
            if solve.reason:
                continue
            try:
                columns = self._columns(solve)
            except AnswerError as error:
                self.black_box.solved.note(solve.theta, str(error))
                continue
            f[i] = solve.frequencies[columns]
            if solve.gradient is not None:
                df[i] = solve.gradient[columns]
            if solve.shapes is not None and len(solve.shapes) == s:
                phi[i] = solve.shapes[:, columns]
        return f, df, phi

    def _columns(self, answer: Answer | Solve) -> IntArray:
        """Return the index of the computed mode paired with each measured mode, shape (n_modes,).

        Raise AnswerError if a paired mode is missing or its frequency is invalid or, when pairing by MAC, the
        shapes are not finite or do not fit the sensors.
        """
        given = len(answer.frequencies)
        if self.reference is None:
            if max(self.numbers) > given:
                raise AnswerError(
                    f"must give the measured modes, numbers {list(self.numbers)} (gave {given} modes)"
                )
            columns = np.array(self.numbers) - 1
        else:
            if answer.shapes is None or len(answer.shapes) != len(self.reference):
                rows = "none" if answer.shapes is None else len(answer.shapes)
                raise AnswerError(f"shapes: must have {len(self.reference)} rows, one per sensor (got {rows})")
            if given < self.n_modes:
                raise AnswerError(f"must give at least the {self.n_modes} measured modes (gave {given} modes)")
            if not np.all(np.isfinite(answer.shapes)):
                raise AnswerError("shapes: must be finite")
            alike = mac(answer.shapes, self.reference)
            columns = assign(alike[None], answer.frequencies[None], self.measured_hz)[0]
        frequencies = answer.frequencies[columns]
        if not np.all(np.isfinite(frequencies) & (frequencies >= 0.0)):
            raise AnswerError(f"frequencies: must be finite and not negative (got {frequencies.tolist()})")
        return columns

    def _widen_step(self, start: FloatArray) -> None:
        """Make the step of each parameter at least four units of the last digit that the function receives.

        The unit is twice the largest rounding error at points around the start (n_parameters,). Raise ValueError
        if a step would be more than `_WIDEST` of the parameter's scale.
        """
        shares = np.arange(_PROBES) * 0.5 * (np.sqrt(5.0) - 1.0) % 1.0  # in no ratio with a unit
        probes = np.clip(start + self.scale * (shares[:, None] - 0.5), self.lower, self.upper)
        unit = 2.0 * np.max(np.abs(self.black_box.round_values(probes) - probes), axis=0)
        self.step = np.maximum(self.step, 4.0 * unit)
        coarse = np.flatnonzero(4.0 * unit > _WIDEST * self.scale)
        if len(coarse):
            k = int(coarse[0])
            multiples, of_scale = significant(unit[k], 1), significant(unit[k] / self.scale[k], 1)
            raise ValueError(
                f"the template must write more digits of parameter {k + 1}, as {{NAME}} or, in a large field of "
                f"Nastran, {{NAME:16}} (it writes multiples of {multiples}, {of_scale} of its scale)"
            )

    def _differences(
        self, theta: FloatArray, here: FloatArray, nearby: Callable[[FloatArray, IntArray], FloatArray]
    ) -> FloatArray:
        """Return the derivatives (n, k, n_parameters) of values `here` (n, k), by central differences.

        ``nearby(points, of)`` returns the values at displaced points; `of` is the index of each point's row in
        theta. Where the function fails on one side, the difference is one-sided; where it fails on both, it is
        NaN. Each difference is divided by the distance between the parameter values that the function receives,
        which an input deck may round.
        """
        n, ndim = theta.shape
        points, _ = both_sides(theta, self.step, self.lower, self.upper)
        of = np.broadcast_to(np.arange(n)[:, None], (2, n, ndim)).ravel()
        values = nearby(points.reshape(-1, ndim), of).reshape(2, n, ndim, -1)
        failed = np.isnan(values).any(axis=3)
        values = np.where(failed[..., None], here[:, None, :], values)
        at = np.where(failed, theta, np.diagonal(points, axis1=2, axis2=3))
        at = self.black_box.round_values(at.reshape(-1, ndim)).reshape(at.shape)
        with np.errstate(invalid="ignore", divide="ignore"):  # failure on both sides: no gradient
            slopes = (values[0] - values[1]) / (at[0] - at[1])[..., None]
        return np.asarray(np.swapaxes(slopes, 1, 2))
