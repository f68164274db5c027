"""Errors in measured frequency response functions: errors in H or in log H, and channel errors."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Self

import numpy as np

from fmu.arguments import ArgumentError, as_list, check_arguments
from fmu.fem.frf.model import FRFModel
from fmu.fem.frf.training import TOLERANCE, Lines
from fmu.fem.modes.separable import SeparableModel
from fmu.numbers import significant, typed
from fmu.posterior.data.frf_data import FRFData
from fmu.posterior.data.held_out_lines import held_out
from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.discrepancy.embedded import Discrepancy
from fmu.posterior.errors.quantities import QuantityErrors
from fmu.posterior.frf.channels import Channels
from fmu.posterior.frf.damping import DampingModel, bind_damping, damping_as_dict, inferred_in
from fmu.posterior.frf.scattered import ModeScatter, ScatteredTerm
from fmu.posterior.frf.term import GAUSSIAN, FRFTerm
from fmu.posterior.frf.window import MOST_PER_LINE, Window
from fmu.posterior.parameters import Parameter, parameter_in, value_and_parameter, value_or_name
from fmu.posterior.reduction.region import training_box
from fmu.posterior.reduction.train_reduced import ReductionWarning
from fmu.types import Dof, NotNegative, Plain

CHANNEL_ERRORS = {"gain_sd": "response channels", "force_gain_sd": "forces", "delay_sd": "response channels"}
"""Settings of channel errors, and the channels to which each setting applies."""
_LESS_DAMPED = 0.5
"""Factor on the starting values of inferred damping parameters with which smoothing must still be exact."""
_TOO_SHORT = (
    "with {} damping, the impulse response lasts so many segments of the window that the model's FRFs cannot be "
    "smoothed exactly; {} with a more likely damping, or measure longer segments"
)


@check_arguments
@dataclass(frozen=True, eq=False)
class FRFErrors(QuantityErrors):
    """Errors in measured frequency response functions (FRFs), independent from line to line and from FRF to FRF.

    The measured FRF for response j and drive k is d = (1 + γ_j) (1 + γ_k) exp(−iωτ_j) H_jk + e, with the computed
    FRF H_jk, the gain error γ_j and the delay τ_j of the response channel, and the gain error γ_k of the force,
    which all FRFs of the drive have in common. The error e has a real and an imaginary part, each with the
    variance V = s² + σ² |H|². Here s is the data's standard deviation and σ a relative model error.

    If s was estimated from few hits or averages, the error at a single line has Student's t distribution with ν
    degrees of freedom (`FRFData.freedom`). This is only approximate with the estimator H2: at four averages and
    γ² = 0.8, 95 % intervals hold the truth in 92.5 % of the cases. If many lines determine a parameter together,
    the slope of this log-density has a larger variance than its curvature implies. Intervals would be too narrow,
    by 11 % for five hits. The density used is therefore (1 + |e|²/(ν V))^(−ν/2), which is Student's t with ν − 2
    degrees of freedom and the squared scale V ν/(ν − 2). Its curvature equals its slope's variance (Godambe 1960,
    *Ann. Math. Statist.* 31, 1208–1211), and its slope is proportional to the slope of Student's t with ν. From
    ν = 500 on, the density is Gaussian. The ν degrees of freedom belong to s². With a model error, V has ν (V/s²)²
    degrees of freedom instead (Satterthwaite 1946, *Biometrics Bulletin* 2, 110–114), because σ is the same at all
    lines. With 3 or 5 hits, an inferred σ that is below the noise is overestimated.

    Attributes
    ----------
    data : FRFData
    damping : damping model, or sequence of damping models that are added up
        `fmu.ModalDamping`, `fmu.RayleighDamping`, `fmu.StructuralDamping`, `fmu.Dashpot`, `fmu.DampingMatrix`.
    scale : {"linear", "log"}
        ``"linear"``: errors in H. ``"log"``: errors in log H, that is, in log amplitude and phase, with the
        variance V = s²/|d|² + σ²; resonances then have less weight.
    model_sd : float or Parameter
        σ, the model error relative to |H|, known or inferred; 0 by default.
    gain_sd : float, or mapping of (place, direction) to float
        Standard deviation of the relative gain error γ_j in each response channel, or in the named channels. The
        gain errors are inferred if the data's standard deviations come from hits or a coherence. Otherwise they
        are integrated out exactly; with ``"log"``, the factor is then exp(γ_j).
    force_gain_sd : float, or mapping of (place, direction) to float
        Standard deviation of the relative gain error γ_k of the force at each drive, or at the named drives, which
        is inferred.
    delay_sd : float, or mapping of (place, direction) to float, s
        Standard deviation of the delay τ_j in each response channel, or in the named channels. Delays are
        inferred.
    test : str, optional
        With `fmu.JointProblem`, the name of the test in which the FRFs were measured. They are computed with that
        test's parameters. Damping parameters and an inferred `model_sd` that have the same name in several tests
        are the same quantity. Gain errors and delays belong to their test.
    places : mapping of str to node, optional
        Maps place names in the data and the damping to nodes of the model.

    Raises
    ------
    ValueError
        If a known `model_sd`, or a `gain_sd`, `force_gain_sd` or `delay_sd`, is negative or not finite, a named
        channel has no FRF, the standard deviations were estimated from at most two hits or averages, or an
        inferred `model_sd` has a negative lower bound.
    """

    data: FRFData
    damping: DampingModel | Sequence[DampingModel]
    scale: Literal["linear", "log"] = "linear"
    model_sd: NotNegative | Parameter = 0.0
    gain_sd: NotNegative | Mapping[Any, NotNegative] = 0.0
    force_gain_sd: NotNegative | Mapping[Any, NotNegative] = 0.0
    delay_sd: NotNegative | Mapping[Any, NotNegative] = 0.0
    test: str | None = None
    places: Mapping[str, int | str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._of_channels()
        if self.data.freedom <= 2.0:
            rule = "must have standard deviations from three hits or averages at least"
            raise ArgumentError("data", rule, significant(1.0 + self.data.freedom / 2.0))
        inferred = parameter_in(self.model_sd)
        if inferred is not None and inferred.lower < 0.0:
            raise ArgumentError(f"model_sd.{inferred.name}.lower", "must be at least 0", inferred.lower)

    def at_places(self, places: Mapping[str, Any]) -> Self:
        """Return the same settings with more place names in `places`; names that it already has keep their nodes.

        The names in the data do not change, and are still used in labels.
        """
        return replace(self, places={**places, **self.places})

    def n_errors(self, data: ModalData) -> int:
        """Return the number of real and imaginary parts of the used FRF values; the modes, `data`, are ignored."""
        return 2 * int(self.data.used.sum())

    def data_give_sd(self, data: ModalData) -> bool:
        """Return True if the FRFs have standard deviations or a coherence; the modes, `data`, are ignored."""
        return self.data.sd is not None or self.data.coherence is not None

    def _of_channels(self) -> dict[str, dict[Any, float]]:
        """Return the positive standard deviations of channels, by setting and (place, direction)."""
        return {key: _by_channel(key, getattr(self, key), self.data) for key in CHANNEL_ERRORS}

    def _nodes(self, points: Sequence[Dof]) -> list[Dof]:
        return [(self.places.get(str(place), place), direction) for place, direction in points]

    def bind_frfs(
        self, model: SeparableModel, parameters: Sequence[Parameter], discrepancy: Discrepancy | None = None
    ) -> FRFTerm:
        """Bind the errors to a structure. This trains a reduced model of the structure's FRFs.

        Parameters
        ----------
        model : SeparableModel
        parameters : sequence of Parameter
            Parameters of the model.
        discrepancy : Discrepancy, optional
            Model discrepancy in the modes. If it is given, the result is a `ScatteredTerm`.

        Raises
        ------
        ValueError
            If a drive or a response has no free degree of freedom, the damping does not fit the model (see
            `bind_damping`), a used value has neither a standard deviation nor a model error, or a discrepancy
            cannot be combined with these errors.

        Warns
        -----
        ReductionWarning
            If the reduced model does not meet its tolerance, or smoothing by a window cannot be exact.
        """
        data = self.data
        if discrepancy is not None:
            self._check_discrepancy(discrepancy)
        responses, drives = self._nodes(data.responses), self._nodes(data.drives)
        for key, named, points in (("responses", data.responses, responses), ("drives", data.drives, drives)):
            for k, point in enumerate(points):
                if not model.sees(point):
                    rule = "must be a place and a direction of the model that are free to move"
                    raise ArgumentError(f"data.{key}.{k}", rule, " ".join(map(str, named[k])))
        inferred = inferred_in(self.damping)
        damping = bind_damping(self.damping, model, [p.name for p in parameters], self.places)
        start = np.array([p.start for p in parameters])
        lower, upper = training_box(parameters)
        values = np.array([p.start for p in inferred])
        omega = 2.0 * np.pi * np.asarray(data.frequencies_hz)
        used = data.used
        needed = used | held_out(data)
        receptance = data.as_receptance()
        model_sd, inferred_sd = value_and_parameter(self.model_sd)
        with np.errstate(invalid="ignore"):
            size = np.abs(receptance.values)
            sd = np.zeros(size.shape) if receptance.sd is None else receptance.sd
            unit = np.where(needed, np.sqrt(sd**2 + (model_sd * size) ** 2), np.inf)
        if not np.all(unit[used] > 0.0):
            rule = "must have standard deviations; give sd or coherence to FRFData, or model_sd to FRFErrors"
            raise ArgumentError("data", rule, "none")
        lines = needed.any(axis=0)
        window = Window(omega[lines], data.power, data.window)
        while True:
            of = FRFModel(
                model, responses, drives, damping, start, lower, upper, values,
                Lines(window.omega, window.unit(unit[:, lines])),
            )  # fmt: skip
            if window.weights is None:
                break
            finer = window.twice()
            if window.agrees(finer, of.at(start[None], _LESS_DAMPED * values[None]), unit[:, lines]):
                break
            if window.per_line == MOST_PER_LINE:
                words = ("half the inferred", "start") if len(values) else ("this", "compute")
                warnings.warn(_TOO_SHORT.format(*words), ReductionWarning, stacklevel=2)
                break
            window = finer
        if not of.is_confirmed:
            warnings.warn(
                f"the reduced model of the FRFs has an error of {significant(of.error, 2)} standard deviations of "
                f"all lines together (asked for: {typed(TOLERANCE)}) after {of.n_solves} points; narrow bounds "
                "of parameters, or the band",
                ReductionWarning,
                stacklevel=2,
            )
        if discrepancy is not None:
            if damping.couples_modes:
                rule = (
                    "needs modal ratios, Rayleigh damping or one loss factor beside frequency response functions"
                )
                raise ArgumentError("discrepancy", rule, "damping that couples the modes")
            scatter = ModeScatter.of(discrepancy, of, start, float(omega[lines][-1]) / (2.0 * np.pi))
            right = Channels.of(data, {}, 0, integrates=True)
            return ScatteredTerm(data, of, right, inferred, self.as_dict(), scatter, window.per_line)
        first, of_test = len(parameters) + len(inferred), "" if self.test is None else f"{self.test}: "
        channels = Channels.of(data, self._of_channels(), first, np.isinf(data.freedom), of_test)
        inferred += channels.parameters
        if inferred_sd is not None:
            inferred.append(inferred_sd)
        own = model_sd if inferred_sd is None else None
        is_log = self.scale == "log"
        settings = self.as_dict()
        return FRFTerm(data, of, channels, tuple(inferred), is_log, own, settings, of_test, window.per_line)

    def _check_discrepancy(self, discrepancy: Discrepancy) -> None:
        """Raise ArgumentError if the discrepancy and the errors cannot be combined.

        The discrepancy must be of kind "modes", with known `sd` and `correlation` and without `length`. The errors
        must be Gaussian errors in H, without model or channel errors.
        """
        rule = 'of frequency response functions must be of kind "modes": errors of frequencies and residues'
        if discrepancy.kind != "modes" or discrepancy.length is not None:
            raise ArgumentError("discrepancy", rule, discrepancy.kind if discrepancy.length is None else "length")
        if discrepancy.sd is None or discrepancy.correlation in (None, "inferred"):
            rule = (
                "of frequency response functions needs sd and correlation; a band has too few modes to infer them"
            )
            raise ArgumentError("discrepancy", rule, "none")
        given = {
            "scale": self.scale == "log",
            "model_sd": self.model_sd != 0.0,
            **{key: bool(given) for key, given in self._of_channels().items()},
            "standard deviations from few hits or averages": self.data.freedom < GAUSSIAN,
        }
        wrong = next((key for key, is_given in given.items() if is_given), None)
        if wrong is not None:
            rule = (
                "of frequency response functions needs Gaussian errors of H with known standard deviations alone"
            )
            raise ArgumentError("discrepancy", rule, wrong)

    def as_dict(self) -> dict[str, Plain]:
        """Return the data, the damping and the settings as a dict of plain Python types."""
        return {
            "error": "frf",
            **({} if self.test is None else {"test": self.test}),
            "data": self.data.as_dict(),
            "points": [str(one) for one in self._nodes((*self.data.responses, *self.data.drives))],
            "damping": [damping_as_dict(one) for one in as_list(self.damping)],
            "scale": self.scale,
            "model_sd": value_or_name(self.model_sd),
            **{
                key: {f"{place} {direction}": sd for (place, direction), sd in given.items()}
                for key, given in self._of_channels().items()
            },
        }


def points_of(key: str, data: FRFData) -> tuple[tuple[Any, str], ...]:
    """Return the drives of all FRFs if the setting `key` of `CHANNEL_ERRORS` is for forces, else the responses."""
    return data.drives if CHANNEL_ERRORS[key] == "forces" else data.responses


def _by_channel(key: str, given: float | Mapping[Any, float], data: FRFData) -> dict[Any, float]:
    """Return the positive standard deviations of all or of the named channels of a setting, keyed by channel.

    Raise ValueError if a named channel has no FRF.
    """
    channels = list(dict.fromkeys(points_of(key, data)))
    if not isinstance(given, Mapping):
        return dict.fromkeys(channels, float(given)) if given else {}
    unknown = next((name for name in given if tuple(name) not in channels), None)
    if unknown is not None:
        known = ", ".join(f"{place} {direction}" for place, direction in channels)
        raise ArgumentError(key, f"must name {CHANNEL_ERRORS[key]} among {known}", repr(unknown))
    return {tuple(name): float(sd) for name, sd in given.items() if sd}
