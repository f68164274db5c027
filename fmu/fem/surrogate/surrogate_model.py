"""Surrogate models: Gaussian processes that predict the paired modes of a slow model."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from fmu.engines.blas import single_thread
from fmu.fem.pairing.modal_model import ModalModel
from fmu.fem.pairing.prediction import ModalPrediction
from fmu.fem.surrogate.close_pairs import ClosePairs
from fmu.fem.surrogate.coordinates import Coordinates
from fmu.fem.surrogate.feasibility import Feasibility
from fmu.fem.surrogate.process import Process
from fmu.types import BoolArray, FloatArray

_GROWN = 1.15
"""Factor by which the number of successful solves must grow before hyper-parameters are searched for again."""


@dataclass(frozen=True, eq=False)
class Design:
    """Design points theta of a surrogate, and the slow model's paired modes there.

    Attributes
    ----------
    theta : ndarray, shape (N, n_parameters)
    frequencies : ndarray, shape (N, n_modes), Hz
        NaN where a solve failed.
    shapes : ndarray, shape (N, n_sensors, n_modes)
        Shapes at the sensors; n_sensors = 0 if shapes are not needed.
    """

    theta: FloatArray
    frequencies: FloatArray
    shapes: FloatArray

    @property
    def failed(self) -> BoolArray:
        """Mask of failed solves, shape (N,). A frequency of zero has no logarithm, so it counts as a failure."""
        return ~(np.isfinite(self.frequencies) & (self.frequencies > 0.0)).all(axis=1)

    def join(self, other: Design) -> Design:
        """Return a design with this design's points followed by another's."""
        return Design(
            np.concatenate([self.theta, other.theta]),
            np.concatenate([self.frequencies, other.frequencies]),
            np.concatenate([self.shapes, other.shapes]),
        )


class SurrogateModel(ModalModel):
    """Gaussian processes for the logarithms of a slow model's paired eigenvalues, and for its shapes if needed.

    The modes are paired at each design point before the processes are fitted, so that a process follows its mode
    even where modes cross. If modes are paired by number, the eigenvalues of two close modes are replaced by
    smooth functions of both (`fmu.fem.surrogate.close_pairs`). Before the fit, each shape is scaled to unit length
    at the sensors, and its sign is chosen to agree with the reference shape.

    Parameters
    ----------
    truth : ModalModel
        The slow model, with paired modes.
    design : Design
        Solves to which the processes are fitted; at least two must have succeeded.
    coordinates : Coordinates
        Map from theta to the inputs of the processes.
    reference : ndarray, shape (n_sensors, n_modes), optional
        Measured shapes, which determine the signs. If they are not given, shapes are not predicted.
    before : SurrogateModel, optional
        A surrogate with a smaller design, which must also predict shapes if `reference` is given. Its
        hyper-parameters are kept until there are 15 % more successful solves than at their last search; a new
        search then begins at their values. `before` is ignored if it has other close pairs than this design.

    Attributes
    ----------
    is_uncertain : bool
        True: `observed` returns variances.
    """

    is_uncertain = True

    def __init__(
        self,
        truth: ModalModel,
        design: Design,
        coordinates: Coordinates,
        reference: FloatArray | None = None,
        before: SurrogateModel | None = None,
    ) -> None:
        self.design, self.coordinates, self._reference = design, coordinates, reference
        self.n_parameters, self.n_modes = truth.n_parameters, truth.n_modes
        self.name, self.by_shape = f"surrogate of {truth.name}", truth.by_shape
        self.gives_shapes = reference is not None
        good = ~design.failed
        x = coordinates.to_x(design.theta)
        self.feasibility = Feasibility(x, design.failed)
        log = 2.0 * np.log(design.frequencies[good])
        self.pairs = ClosePairs() if truth.by_shape else ClosePairs.of(log)
        if before is not None and before.pairs != self.pairs:
            before = None  # its hyper-parameters belong to other quantities
        shapes = None if reference is None else orient_shapes(design.shapes[good], reference)
        n_searched: int = 0 if before is None else before._n_searched
        search = np.sum(good) >= _GROWN * n_searched
        self._n_searched: int = int(np.sum(good)) if search else n_searched
        with single_thread():
            self.of_frequencies: list[Process] = fitted_together(
                x[good], self.pairs.learnt(log), None if before is None else before.of_frequencies, bool(search)
            )
            self.of_shapes: list[Process] = []
            for i in range(self.n_modes if shapes is not None else 0):
                earlier = None if before is None else before.of_shapes[i]
                self.of_shapes.append(Process(x[good], shapes[:, :, i], earlier, bool(search)))  # type: ignore[index]

    def __repr__(self) -> str:
        return f"{self.name}, {len(self.design.theta)} solves"

    def frequencies(self, theta: FloatArray) -> FloatArray:
        """Return expected frequencies in Hz, shape (n, n_modes), with NaN where a solve would probably fail."""
        x = self.coordinates.to_x(theta)
        if self.pairs.first:  # the expected frequencies of a close pair depend on the variances
            z, _ = self.pairs.values(*self._learnt(x))
        else:
            with single_thread():
                z = np.concatenate([p.values(x) for p in self.of_frequencies], axis=1)
        return self._where_feasible(x, np.exp(0.5 * z))

    def frequencies_and_gradient(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return expected frequencies in Hz, (n, n_modes), and exact gradients, (n, n_modes, n_parameters).

        Frequencies are NaN where a solve would probably fail.
        """
        seen = self.observed(theta, gradient=True)
        assert seen.frequency_slopes is not None  # narrowed for the type checker: requested above
        return seen.frequencies, seen.frequency_slopes

    def observed(self, theta: FloatArray, gradient: bool = False) -> ModalPrediction:
        """Return the predicted frequencies, the shapes if they were fitted, and the variances of both.

        If `gradient`, the derivatives with respect to theta are included. Frequencies are NaN where a solve would
        probably fail.
        """
        x = self.coordinates.to_x(theta)
        by_theta = self.coordinates.slope(theta)[:, None] if gradient else None
        with single_thread():
            parts = [_predict(p, x, by_theta) for p in (*self.of_frequencies, *self.of_shapes)]
        n = len(self.of_frequencies)
        y, v, dy, dv = (_join_parts(c, np.concatenate, 1) for c in zip(*parts[:n], strict=True))
        z, z_variance = self.pairs.values(y, v)
        f = np.exp(0.5 * z)
        f_hz, v_hz2 = self._where_feasible(x, f), 0.25 * f**2 * z_variance
        empty = np.empty((len(x), 0, self.n_modes))
        s, sv, ds, dsv = empty, empty, np.empty((*empty.shape, self.n_parameters)), None
        if self.of_shapes:
            s, sv, ds, dsv = (_join_parts(c, np.stack, 2) for c in zip(*parts[n:], strict=True))
        if not gradient:
            return ModalPrediction(f_hz, s, frequency_variance=v_hz2, shape_variance=sv)
        dz, dz_variance = self.pairs.slopes(y, v, dy, dv)
        df = 0.5 * f[..., None] * dz
        dv_hz2 = 0.25 * f[..., None] ** 2 * dz_variance + 0.5 * (f * z_variance)[..., None] * df
        return ModalPrediction(f_hz, s, df, ds, v_hz2, sv, dv_hz2, ds if dsv is None else dsv)

    def limit_variance(self, theta: FloatArray) -> None:
        """Limit the variances of each process to its largest variance at posterior draws theta (n, n_parameters).

        See `Process.limit`.
        """
        x = self.coordinates.to_x(theta)
        with single_thread():
            for process in (*self.of_frequencies, *self.of_shapes):
                process.limit(x)

    def variances(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the variances of frequencies (n, n_modes) in Hz², and of shapes (n, n_sensors, n_modes).

        They are computed as in `observed`, but the variances of the processes are not limited to `Process.most`.
        """
        x = self.coordinates.to_x(theta)
        z, v = self.pairs.values(*self._learnt(x, limited=False))
        with single_thread():
            of_shapes = [p.predict(x, limited=False)[1] for p in self.of_shapes]
        empty = np.empty((len(x), 0, self.n_modes))
        return 0.25 * np.exp(z) * v, np.stack(of_shapes, axis=2) if of_shapes else empty

    def weights_of_learnt(self, theta: FloatArray, of_frequency: FloatArray) -> FloatArray:
        """Convert weights for frequency variances, in 1/Hz², to weights for the variances of the processes.

        Both have shape (n, n_modes), and give the same weighted sum of variances.
        """
        y, v = self._learnt(self.coordinates.to_x(theta))
        z, _ = self.pairs.values(y, v)
        return self.pairs.weights(y, v, 0.25 * np.exp(z) * of_frequency)

    @property
    def scatter(self) -> FloatArray:
        """Standard deviations (n_modes,) of the solver's scatter in the values of the frequency processes."""
        return np.concatenate([p.scatter for p in self.of_frequencies])

    def configuration(self) -> dict[str, object]:
        """Return a dict with a hash of the design."""
        digest = hashlib.sha256()
        for part in (self.design.theta, self.design.frequencies, self.design.shapes):
            digest.update(np.ascontiguousarray(part).tobytes())
        return {"design": digest.hexdigest()}

    def _learnt(self, x: FloatArray, limited: bool = True) -> tuple[FloatArray, FloatArray]:
        """Return the frequency processes' expected values and variances at x, (n, n_modes) each."""
        with single_thread():
            parts = [p.predict(x, limited) for p in self.of_frequencies]
        y, v = (np.concatenate(one, axis=1) for one in zip(*parts, strict=True))
        return y, v

    def _where_feasible(self, x: FloatArray, frequencies: FloatArray) -> FloatArray:
        return np.where(self.feasibility(x)[:, None], frequencies, np.nan)


def _join_parts(parts: Sequence[Any], join: Any, axis: int) -> Any:
    """Join the arrays along an axis with `join`. Return None if the first array is None."""
    return None if parts[0] is None else join(parts, axis=axis)


def _predict(process: Process, x: FloatArray, by_theta: FloatArray | None) -> Any:
    """Return the expected values and variances of a process at x, and their derivatives with respect to theta.

    `by_theta` contains the derivatives of x with respect to theta, shape (n, 1, n_parameters). If it is None, the
    two derivatives that are returned are None too.
    """
    if by_theta is None:
        return *process.predict(x), None, None
    value, variance, slopes, by_variance = process.predict_with_slopes(x)
    return value, variance, slopes * by_theta, by_variance * by_theta


def fitted_together(x: FloatArray, y: FloatArray, before: Sequence[Process] | None, search: bool) -> list[Process]:
    """Fit one shared process, or q separate ones, to q quantities y (N, q) at x (N, d); return them in a list.

    A few points can determine common length scales, but not separate ones for every quantity. Separate processes
    are used if they have the better Bayesian information criterion (Schwarz 1978, *Ann. Stat.* 6, 461–464). If
    `search` is False and `before` is given, the processes are shared or separate as in `before`, and keep its
    hyper-parameters.
    """
    if not search and before is not None:
        if len(before) == 1:
            return [Process(x, y, before[0], False)]
        return [Process(x, y[:, [i]], p, False) for i, p in enumerate(before)]
    shared = Process(x, y, before[0] if before is not None and len(before) == 1 else None)
    single = [
        Process(x, y[:, [i]], shared if before is None or len(before) == 1 else before[i])
        for i in range(y.shape[1])
    ]
    cost = 0.5 * shared.n_hyper * np.log(len(x)) * (y.shape[1] - 1)
    return single if sum(p.log_likelihood for p in single) - shared.log_likelihood > cost else [shared]


def solve_design(truth: ModalModel, theta: FloatArray, with_shapes: bool) -> Design:
    """Return a design: the slow model's modes at theta (n, n_parameters), with shapes if `with_shapes`."""
    if with_shapes:
        seen = truth.observed(theta)
        return Design(theta, seen.frequencies, seen.shapes)
    frequencies = truth.frequencies(theta)
    return Design(theta, frequencies, np.empty((len(theta), 0, frequencies.shape[1])))


def orient_shapes(shapes: FloatArray, reference: FloatArray) -> FloatArray:
    """Return shapes (n, n_sensors, n_modes) of unit length, with the signs of the reference shapes."""
    along = np.sum(shapes * reference, axis=1, keepdims=True)
    return shapes / np.linalg.norm(shapes, axis=1, keepdims=True) * np.where(along < 0.0, -1.0, 1.0)
