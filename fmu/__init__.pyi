"""The public names, each imported from its home when it is first used: a line here is all that a new one takes."""

from . import cases as cases
from .analysis.check import check as check
from .analysis.convergence.diagnosis import compare as compare
from .analysis.convergence.diagnosis import diagnose as diagnose
from .analysis.convergence.diagnostics import summary as summary
from .analysis.evidence import evidence as evidence
from .analysis.held_out.modes import leave_one_out as leave_one_out
from .analysis.identifiability import identifiability as identifiability
from .analysis.information import information as information
from .analysis.maxima.search import find_map as find_map
from .analysis.pairing_changes import pairing_changes as pairing_changes
from .analysis.prediction import expectation as expectation
from .analysis.trace.conversion import load_trace as load_trace
from .analysis.trace.conversion import save_trace as save_trace
from .config import load as load
from .engines import engine as engine
from .fem.black_box import BlackBoxModel as BlackBoxModel
from .fem.condensation import craig_bampton as craig_bampton
from .fem.condensation import guyan as guyan
from .fem.frame.components import ElementGroup as ElementGroup
from .fem.frame.components import JointSpring as JointSpring
from .fem.frame.components import Material as Material
from .fem.frame.components import PointMass as PointMass
from .fem.frame.components import Section as Section
from .fem.frame.frame import Frame as Frame
from .fem.frame.updates import Factor as Factor
from .fem.modes.separable import RigidArm as RigidArm
from .fem.modes.separable import SeparableModel as SeparableModel
from .fem.modes.separable import Term as Term
from .posterior.data.modal_data import ModalData as ModalData
from .posterior.errors.frequency import FrequencyErrors as FrequencyErrors
from .posterior.errors.mac import MACErrors as MACErrors
from .posterior.errors.shape import ShapeErrors as ShapeErrors
from .posterior.parameters import Parameter as Parameter
from .posterior.priors.base import Normal as Normal
from .posterior.priors.base import Uniform as Uniform
from .posterior.priors.one_sided import HalfNormal as HalfNormal
from .posterior.priors.one_sided import LogNormal as LogNormal
from .posterior.priors.scipy_distributions import ScaledBeta as ScaledBeta
from .posterior.priors.scipy_distributions import ScipyPrior as ScipyPrior
from .posterior.problem import UpdatingProblem as UpdatingProblem
from .report.export import export as export
from .report.pages import write_report as write_report
from .runs import Checkpoint as Checkpoint
from .samplers.ensemble import Ensemble as Ensemble
from .samplers.hmc import HamiltonianMonteCarlo as HamiltonianMonteCarlo
from .samplers.metropolis import MetropolisHastings as MetropolisHastings
from .samplers.metropolis import RandomWalk as RandomWalk
from .samplers.mixture.mixture import MixtureSampler as MixtureSampler
from .samplers.slice import Slice as Slice
from .samplers.tempering.tempering import Tempering as Tempering
from .sampling import StoppedRun as StoppedRun
from .sampling import sample as sample

__version__: str
__all__: list[str]
