"""Cheap models with known errors that replace slow models."""

from __future__ import annotations

from collections.abc import Sequence

from fmu.fem.certificates import Certificate
from fmu.fem.pairing.modal_model import ModalModel
from fmu.fem.pairing.prediction import ModalPrediction
from fmu.fem.programs.solves import Failure
from fmu.types import FloatArray


class Approximation(ModalModel):
    """A cheap model used in place of a true model that is too slow to solve often.

    There are two kinds. Gaussian processes (`fmu.fem.surrogate.surrogate_model.SurrogateModel`) predict
    everywhere; a structure's reduced basis (`fmu.fem.reduced.reduced_structure.ReducedStructure`) is valid in a
    parameter box. The object never changes during use, except that a reduced basis counts the true model's solves.

    Parameters
    ----------
    truth : ModalModel
    cheap : ModalModel
        A model with the same parameters and modes.
    certificate : Certificate, optional
        The cheap model's errors in the region of high posterior probability, if they are known before a run
        (`fmu.fem.certificates.SurrogateCertificate`).

    Attributes
    ----------
    full_solves : int
        Number of points at which the true model was solved in place of the cheap model; always 0 for Gaussian
        processes.
    """

    def __init__(self, truth: ModalModel, cheap: ModalModel, certificate: Certificate | None = None) -> None:
        self._truth, self.cheap, self.certificate = truth, cheap, certificate
        self.n_parameters, self.n_modes, self.name = truth.n_parameters, truth.n_modes, cheap.name
        self.structure, self.by_shape, self.is_soft = truth.structure, truth.by_shape, truth.is_soft
        self.gives_shapes, self.is_uncertain = cheap.gives_shapes, cheap.is_uncertain
        self.gives_shape_curvature = cheap.gives_shape_curvature
        self.has_exact_curvature = cheap.has_exact_curvature

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.cheap!r})"

    @property
    def truth(self) -> ModalModel:
        """The true model, which the cheap model approximates."""
        return self._truth

    @property
    def reasons(self) -> Sequence[Failure]:
        """The first failures of the true model, each with its theta and reason."""
        return self._truth.reasons

    def frequencies(self, theta: FloatArray) -> FloatArray:
        """Return the cheap model's frequencies in Hz, shape (n, n_modes), with NaN where it fails."""
        return self.cheap.frequencies(theta)

    def frequencies_and_gradient(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the cheap model's frequencies in Hz, shape (n, n_modes), and their exact gradients.

        The gradients have shape (n, n_modes, n_parameters).
        """
        return self.cheap.frequencies_and_gradient(theta)

    def observed(self, theta: FloatArray, gradient: bool = False) -> ModalPrediction:
        """Return predicted frequencies and sensor shapes, with derivatives if `gradient`.

        Variances are included if the cheap model is uncertain.
        """
        return self.cheap.observed(theta, gradient)

    def configuration(self) -> dict[str, object]:
        """Return the data that identify the true and the cheap model, as plain Python types."""
        return {"surrogate of": self._truth.configuration(), **self.cheap.configuration()}
