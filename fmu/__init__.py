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
    from fmu.analysis.comparison import compare as compare
    from fmu.analysis.diagnosis import diagnose as diagnose
    from fmu.analysis.diagnostics import summary as summary
    from fmu.analysis.evidence import evidence as evidence
    from fmu.analysis.identifiability import identifiability as identifiability
    from fmu.analysis.pairing_changes import pairing_changes as pairing_changes
    from fmu.analysis.prediction import expectation as expectation
    from fmu.analysis.search import find_map as find_map
    from fmu.analysis.trace import load_trace as load_trace
    from fmu.analysis.trace import save_trace as save_trace
    from fmu.checkpoints.settings import Checkpoint as Checkpoint
    from fmu.config import load as load
    from fmu.engines.engine import engine as engine
    from fmu.fem.black_box import BlackBoxModel as BlackBoxModel
    from fmu.fem.frame import ElementGroup as ElementGroup
    from fmu.fem.frame import Frame as Frame
    from fmu.fem.joints import JointSpring as JointSpring
    from fmu.fem.joints import PointMass as PointMass
    from fmu.fem.section import Material as Material
    from fmu.fem.section import Section as Section
    from fmu.fem.separable import RigidArm as RigidArm
    from fmu.fem.separable import SeparableModel as SeparableModel
    from fmu.fem.terms import Term as Term
    from fmu.fem.updates import Factor as Factor
    from fmu.posterior.errors import FrequencyErrors as FrequencyErrors
    from fmu.posterior.errors import MACErrors as MACErrors
    from fmu.posterior.errors import ShapeErrors as ShapeErrors
    from fmu.posterior.measurement import ModalData as ModalData
    from fmu.posterior.one_sided_priors import HalfNormal as HalfNormal
    from fmu.posterior.one_sided_priors import LogNormal as LogNormal
    from fmu.posterior.parameters import Parameter as Parameter
    from fmu.posterior.priors import Normal as Normal
    from fmu.posterior.priors import Uniform as Uniform
    from fmu.posterior.problem import UpdatingProblem as UpdatingProblem
    from fmu.posterior.scipy_priors import ScaledBeta as ScaledBeta
    from fmu.posterior.scipy_priors import ScipyPrior as ScipyPrior
    from fmu.report.export import export as export
    from fmu.report.html import write_report as write_report
    from fmu.samplers.ensemble import Ensemble as Ensemble
    from fmu.samplers.hamiltonian import HamiltonianMonteCarlo as HamiltonianMonteCarlo
    from fmu.samplers.metropolis import MetropolisHastings as MetropolisHastings
    from fmu.samplers.proposals import RandomWalk as RandomWalk
    from fmu.samplers.slice import Slice as Slice
    from fmu.samplers.tempering import Tempering as Tempering
    from fmu.sampling import StoppedRun as StoppedRun
    from fmu.sampling import sample as sample

    __version__: str

_HOME = {
    "BlackBoxModel": "fmu.fem.black_box",
    "Checkpoint": "fmu.checkpoints.settings",
    "ElementGroup": "fmu.fem.frame",
    "Ensemble": "fmu.samplers.ensemble",
    "Factor": "fmu.fem.updates",
    "Frame": "fmu.fem.frame",
    "FrequencyErrors": "fmu.posterior.errors",
    "HalfNormal": "fmu.posterior.one_sided_priors",
    "HamiltonianMonteCarlo": "fmu.samplers.hamiltonian",
    "JointSpring": "fmu.fem.joints",
    "LogNormal": "fmu.posterior.one_sided_priors",
    "MACErrors": "fmu.posterior.errors",
    "ShapeErrors": "fmu.posterior.errors",
    "Material": "fmu.fem.section",
    "MetropolisHastings": "fmu.samplers.metropolis",
    "ModalData": "fmu.posterior.measurement",
    "Normal": "fmu.posterior.priors",
    "Parameter": "fmu.posterior.parameters",
    "PointMass": "fmu.fem.joints",
    "RandomWalk": "fmu.samplers.proposals",
    "RigidArm": "fmu.fem.separable",
    "ScaledBeta": "fmu.posterior.scipy_priors",
    "ScipyPrior": "fmu.posterior.scipy_priors",
    "Section": "fmu.fem.section",
    "SeparableModel": "fmu.fem.separable",
    "Slice": "fmu.samplers.slice",
    "StoppedRun": "fmu.sampling",
    "Tempering": "fmu.samplers.tempering",
    "Term": "fmu.fem.terms",
    "Uniform": "fmu.posterior.priors",
    "UpdatingProblem": "fmu.posterior.problem",
    "check": "fmu.analysis.check",
    "compare": "fmu.analysis.comparison",
    "diagnose": "fmu.analysis.diagnosis",
    "engine": "fmu.engines.engine",
    "evidence": "fmu.analysis.evidence",
    "expectation": "fmu.analysis.prediction",
    "export": "fmu.report.export",
    "find_map": "fmu.analysis.search",
    "identifiability": "fmu.analysis.identifiability",
    "load": "fmu.config",
    "load_trace": "fmu.analysis.trace",
    "pairing_changes": "fmu.analysis.pairing_changes",
    "sample": "fmu.sampling",
    "save_trace": "fmu.analysis.trace",
    "summary": "fmu.analysis.diagnostics",
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
    "diagnose",
    "engine",
    "evidence",
    "expectation",
    "export",
    "find_map",
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
