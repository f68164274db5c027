"""Bayesian finite-element model updating.

Measured vibration modes and a finite-element model give a posterior over the model's uncertain parameters; several
Markov-chain samplers draw from it, and the diagnostics say how far each of them can be trusted::

    problem = fmu.cases.load("cantilever-young")
    trace = fmu.sample(problem, "hmc", draws=1000, warmup=1000, chains=4, seed=1)
    print(fmu.summary(trace))

Names are imported when they are first used, so that importing the package costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fmu import cases as cases
    from fmu.analysis.check import check as check
    from fmu.analysis.convergence.comparison import compare as compare
    from fmu.analysis.convergence.diagnosis import diagnose as diagnose
    from fmu.analysis.convergence.diagnostics import summary as summary
    from fmu.analysis.data.identifiability import identifiability as identifiability
    from fmu.analysis.data.prediction import expectation as expectation
    from fmu.analysis.evidence.estimate import evidence as evidence
    from fmu.analysis.maxima.search import find_map as find_map
    from fmu.analysis.modes.pairing_changes import pairing_changes as pairing_changes
    from fmu.analysis.trace.conversion import load_trace as load_trace
    from fmu.analysis.trace.conversion import save_trace as save_trace
    from fmu.config import load as load
    from fmu.engines import engine as engine
    from fmu.fem.black_box import BlackBoxModel as BlackBoxModel
    from fmu.fem.condensation import craig_bampton as craig_bampton
    from fmu.fem.condensation import guyan as guyan
    from fmu.fem.frame.frame import ElementGroup as ElementGroup
    from fmu.fem.frame.frame import Frame as Frame
    from fmu.fem.frame.joints import JointSpring as JointSpring
    from fmu.fem.frame.joints import PointMass as PointMass
    from fmu.fem.frame.section import Material as Material
    from fmu.fem.frame.section import Section as Section
    from fmu.fem.frame.updates import Factor as Factor
    from fmu.fem.modes.separable import RigidArm as RigidArm
    from fmu.fem.modes.separable import SeparableModel as SeparableModel
    from fmu.fem.modes.terms import Term as Term
    from fmu.posterior.data.modal_data import ModalData as ModalData
    from fmu.posterior.errors.models import FrequencyErrors as FrequencyErrors
    from fmu.posterior.errors.models import MACErrors as MACErrors
    from fmu.posterior.errors.models import ShapeErrors as ShapeErrors
    from fmu.posterior.parameters import Parameter as Parameter
    from fmu.posterior.priors.base import Normal as Normal
    from fmu.posterior.priors.base import Uniform as Uniform
    from fmu.posterior.priors.one_sided import HalfNormal as HalfNormal
    from fmu.posterior.priors.one_sided import LogNormal as LogNormal
    from fmu.posterior.priors.scipy_distributions import ScaledBeta as ScaledBeta
    from fmu.posterior.priors.scipy_distributions import ScipyPrior as ScipyPrior
    from fmu.posterior.problem import UpdatingProblem as UpdatingProblem
    from fmu.report.export import export as export
    from fmu.report.html import write_report as write_report
    from fmu.runs.settings import Checkpoint as Checkpoint
    from fmu.samplers.ensemble import Ensemble as Ensemble
    from fmu.samplers.hmc.hmc import HamiltonianMonteCarlo as HamiltonianMonteCarlo
    from fmu.samplers.metropolis import MetropolisHastings as MetropolisHastings
    from fmu.samplers.proposals import RandomWalk as RandomWalk
    from fmu.samplers.slice import Slice as Slice
    from fmu.samplers.tempering.tempering import Tempering as Tempering
    from fmu.sampling import StoppedRun as StoppedRun
    from fmu.sampling import sample as sample

    __version__: str

_HOME = {
    "BlackBoxModel": "fmu.fem.black_box",
    "Checkpoint": "fmu.runs.settings",
    "ElementGroup": "fmu.fem.frame.frame",
    "Ensemble": "fmu.samplers.ensemble",
    "Factor": "fmu.fem.frame.updates",
    "Frame": "fmu.fem.frame.frame",
    "FrequencyErrors": "fmu.posterior.errors.models",
    "HalfNormal": "fmu.posterior.priors.one_sided",
    "HamiltonianMonteCarlo": "fmu.samplers.hmc.hmc",
    "JointSpring": "fmu.fem.frame.joints",
    "LogNormal": "fmu.posterior.priors.one_sided",
    "MACErrors": "fmu.posterior.errors.models",
    "ShapeErrors": "fmu.posterior.errors.models",
    "Material": "fmu.fem.frame.section",
    "MetropolisHastings": "fmu.samplers.metropolis",
    "ModalData": "fmu.posterior.data.modal_data",
    "Normal": "fmu.posterior.priors.base",
    "Parameter": "fmu.posterior.parameters",
    "PointMass": "fmu.fem.frame.joints",
    "RandomWalk": "fmu.samplers.proposals",
    "RigidArm": "fmu.fem.modes.separable",
    "ScaledBeta": "fmu.posterior.priors.scipy_distributions",
    "ScipyPrior": "fmu.posterior.priors.scipy_distributions",
    "Section": "fmu.fem.frame.section",
    "SeparableModel": "fmu.fem.modes.separable",
    "Slice": "fmu.samplers.slice",
    "StoppedRun": "fmu.sampling",
    "Tempering": "fmu.samplers.tempering.tempering",
    "Term": "fmu.fem.modes.terms",
    "Uniform": "fmu.posterior.priors.base",
    "UpdatingProblem": "fmu.posterior.problem",
    "check": "fmu.analysis.check",
    "compare": "fmu.analysis.convergence.comparison",
    "craig_bampton": "fmu.fem.condensation",
    "diagnose": "fmu.analysis.convergence.diagnosis",
    "engine": "fmu.engines",
    "evidence": "fmu.analysis.evidence.estimate",
    "expectation": "fmu.analysis.data.prediction",
    "export": "fmu.report.export",
    "find_map": "fmu.analysis.maxima.search",
    "guyan": "fmu.fem.condensation",
    "identifiability": "fmu.analysis.data.identifiability",
    "load": "fmu.config",
    "load_trace": "fmu.analysis.trace.conversion",
    "pairing_changes": "fmu.analysis.modes.pairing_changes",
    "sample": "fmu.sampling",
    "save_trace": "fmu.analysis.trace.conversion",
    "summary": "fmu.analysis.convergence.diagnostics",
    "write_report": "fmu.report.html",
}

__all__ = [
    "BlackBoxModel",
    "Checkpoint",
    "ElementGroup",
    "Ensemble",
    "Factor",
    "Frame",
    "FrequencyErrors",
    "HalfNormal",
    "HamiltonianMonteCarlo",
    "JointSpring",
    "LogNormal",
    "MACErrors",
    "Material",
    "MetropolisHastings",
    "ModalData",
    "Normal",
    "Parameter",
    "PointMass",
    "RandomWalk",
    "RigidArm",
    "ScaledBeta",
    "ScipyPrior",
    "Section",
    "SeparableModel",
    "ShapeErrors",
    "Slice",
    "StoppedRun",
    "Tempering",
    "Term",
    "Uniform",
    "UpdatingProblem",
    "__version__",
    "cases",
    "check",
    "compare",
    "craig_bampton",
    "diagnose",
    "engine",
    "evidence",
    "expectation",
    "export",
    "find_map",
    "guyan",
    "identifiability",
    "load",
    "load_trace",
    "pairing_changes",
    "sample",
    "save_trace",
    "summary",
    "write_report",
]


def __getattr__(name: str) -> Any:
    """Import the public name `name` when it is first used."""
    if name in _HOME:
        value = getattr(import_module(_HOME[name]), name)
    elif name == "cases":
        value = import_module("fmu.cases")
    elif name == "__version__":
        from importlib.metadata import version

        value = version("fmu")
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """List the public names, imported or not."""
    return sorted(__all__)
