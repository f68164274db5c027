"""A model restricted to some of its modes and some of its sensors."""

from __future__ import annotations

from collections.abc import Sequence

from fmu.fem.pairing.modal_model import ModalModel
from fmu.fem.pairing.prediction import ModalPrediction
from fmu.types import FloatArray


class PartialModel(ModalModel):
    """Some modes of a model at some of its sensors.

    Parameters
    ----------
    whole : ModalModel
        A model that gives shapes.
    modes, rows : sequence of int
        Indices of the modes and of the sensors.
    """

    gives_shapes = True

    def __init__(self, whole: ModalModel, modes: Sequence[int], rows: Sequence[int]) -> None:
        self.whole, self.name, self.structure = whole, whole.name, whole.structure
        self.functions, self.by_shape = whole.functions, whole.by_shape
        self.n_parameters, self.n_modes = whole.n_parameters, len(modes)
        self.solves_per_gradient = whole.solves_per_gradient
        self.solves_per_shape_gradient = whole.solves_per_shape_gradient
        self._modes, self._rows = list(modes), list(rows)

    def frequencies(self, theta: FloatArray) -> FloatArray:
        """Return frequencies in Hz, shape (n, n_modes); NaN where a solve failed."""
        return self.whole.frequencies(theta)[:, self._modes]

    def frequencies_and_gradient(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return frequencies (n, n_modes) and their gradients (n, n_modes, n_parameters)."""
        frequencies, gradient = self.whole.frequencies_and_gradient(theta)
        return frequencies[:, self._modes], gradient[:, self._modes]

    def observed(self, theta: FloatArray, gradient: bool = False) -> ModalPrediction:
        """Return frequencies and shapes at the sensors at theta (n, n_parameters), with optional derivatives."""
        seen = self.whole.observed(theta, gradient)
        f, df = seen.frequencies[:, self._modes], seen.frequency_slopes
        phi, dphi = seen.shapes[:, self._rows][:, :, self._modes], seen.shape_slopes
        if df is None or dphi is None:
            return ModalPrediction(f, phi)
        return ModalPrediction(f, phi, df[:, self._modes], dphi[:, self._rows][:, :, self._modes])

    def configuration(self) -> dict[str, object]:
        """Return a dict that identifies the model, in plain Python types."""
        return {"whole": self.whole.configuration(), "modes": self._modes, "rows": self._rows}
