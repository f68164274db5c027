"""A generator of wrong calls: from a valid call of every public name, one argument at a time is made wrong."""

import ast
import inspect
import math
import re
import traceback
from collections.abc import Callable, Iterator
from copy import copy
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import emcee
import numpy as np
import scipy.sparse as sp
import scipy.stats

import fmu
from fmu.formats.models.exported import ExportedModel
from fmu.formats.modes.measured_modes import MeasuredModes
from tests.plain_traces import trace_of

WRONG = {
    "None": None,
    "x": "x",
    "empty text": "",
    "NUL": "a\x00b",
    "bytes": b"x",
    "NaN": math.nan,
    "inf": math.inf,
    "-inf": -math.inf,
    "-1": -1,
    "-0.5": -0.5,
    "0": 0,
    "1e9": 10**9,
    "1e400": 10**400,
    "1e300": 1e300,
    "True": True,
    "complex": 1j,
    "[]": [],
    "{}": {},
    "()": (),
    "object": object(),
    "class": int,
    "[None]": [None],
    "['x!']": ["x!"],
    "[nan]": [math.nan],
    "ragged": [[1.0], [1.0, 2.0]],
    "cube": np.zeros((2, 3, 4)),
    "words": np.array(["a", "b"]),
    "{'x': None}": {"x": None},
}
"""Values that few arguments may have."""


class Reached(BaseException):
    """The arguments were accepted, and the work has begun."""


class Call(NamedTuple):
    """A valid call of a public name."""

    name: str
    door: Callable[..., Any]
    given: dict[str, Any]


def chain(factor=1.0):
    """Return the exported matrices of a chain of three masses."""
    K = np.array([[3.0e4 + 2e4 * factor, -3e4, 0.0], [-3e4, 7e4, -4e4], [0.0, -4e4, 4e4]])
    dofs = ((1, "x"), (2, "x"), (3, "x"))
    nothing = np.zeros(0, dtype=np.int64)
    return ExportedModel(
        sp.csr_array(K), sp.csr_array(np.diag([2.0, 3.0, 2.5])), dofs, nothing, np.zeros((0, 3)), (), ()
    )


def stop(*_: Any, **__: Any) -> Any:
    raise Reached


def at_the_door(problem):
    """Return a problem whose first solve is noticed."""
    other = copy(problem)
    for name in ("log_prob", "log_prob_and_grad", "frequencies", "sample_prior", "_terms", "_posterior"):
        setattr(other, name, stop)
    return other


def at_the_door_of(plan):
    """Return a plan whose first simulated test, or page, is noticed."""
    other = replace(plan, before=replace(plan.before, problem=at_the_door(plan.problem)))
    vars(other)["parameters"] = stop
    return other


@cache
def material() -> dict[str, Any]:
    """Return what the calls are made of."""
    constant = chain(0.0).stiffness
    stiffness = [constant, chain(1.0).stiffness - constant]
    model = fmu.SeparableModel.from_terms(["k"], stiffness, [chain().mass], dofs=chain().dofs)
    sensors = tuple((i, "x") for i in (1, 2, 3))
    shapes = np.array([[0.5, 1.0], [0.8, -0.3], [1.0, -0.7]])
    data = fmu.ModalData([10.0, 24.0], numbers=(1, 2), sensors=sensors, shapes=shapes)
    parameter = fmu.Parameter("k", 1.0, 0.5, 2.0)
    errors = [fmu.FrequencyErrors(sd=0.02)]
    problem = fmu.UpdatingProblem(model, data, [parameter], pairing="index", error=errors)
    trace = fmu.sample(problem, "mh", draws=6, warmup=6, chains=2, init="start")
    plan = fmu.plan(problem, 2, draws=2)
    return {"model": model, "data": data, "parameter": parameter, "errors": errors, "problem": problem} | {
        "trace": trace, "sensors": sensors, "shapes": shapes, "plan": plan
    }  # fmt: skip


@cache
def walked():
    """Return a short run of plain emcee."""
    sampler = emcee.EnsembleSampler(4, 1, lambda theta: -0.5 * float(theta[0] - 1.0) ** 2)
    sampler.run_mcmc(np.linspace(0.6, 1.4, 4)[:, None], 12)
    return sampler


def spring(theta):
    return np.array([10.0, 24.0]) * np.sqrt(theta[0])


def calls(folder: Path) -> Iterator[Call]:
    """Yield a valid call of every public name; files are in an empty folder."""
    made = material()
    problem, trace, model, data, parameter = (
        made[key] for key in ("problem", "trace", "model", "data", "parameter")
    )
    watched = at_the_door(problem)
    prior, steel = fmu.Normal(0.1, mean=1.0), fmu.Material(2.1e11, 0.3, 7850.0)
    section = fmu.Section.rectangle(0.02, 0.04)
    nodes, group = [[0.0, 0, 0], [1.0, 0, 0]], fmu.ElementGroup("beam", [[0, 1]], section, steel)
    frame = fmu.Frame(nodes, [group], {0: ("x", "y", "z", "rx", "ry", "rz")})
    (folder / "tests.csv").write_text("name,a,b\nx,10.0,24.0\n")
    (folder / "f.csv").write_text("frequency\n10.0\n24.0\n")
    (folder / "frf.csv").write_text("frequency_hz,1 x / 1 x re,1 x / 1 x im\n1.0,2.0,3.0\n")
    deck = folder / "beam.inp.in"
    deck.write_text("{k}\n")
    saved = fmu.save_trace(trace, folder / "trace.nc")
    exports = [fmu.Export({"k": f}, chain(f)) for f in (1.0, 1.2)]
    states = [fmu.Test("before", data, "intact"), fmu.Test("after", data, "damaged")]
    K, M = chain().stiffness, chain().mass
    black_box = fmu.BlackBoxModel(spring, 1)
    slow = at_the_door(
        fmu.UpdatingProblem(black_box, fmu.ModalData([10.0, 24.0]), [parameter], error=made["errors"])
    )
    numbers = {"low": 0.0, "high": 2.0}
    found = fmu.FoundFrequencies("output.txt", r"f=(.*)")

    yield Call(
        "BlackBoxModel",
        fmu.BlackBoxModel,
        {"function": spring, "n_parameters": 1, "batched": False, "step": 1e-4, "name": "f", "store": None},
    )
    yield Call("Checkpoint", fmu.Checkpoint, {"directory": folder / "c", "draws": 10, "seconds": 1.0})
    yield Call(
        "CommandModel",
        fmu.CommandModel,
        {
            "names": ["k"],
            "template": deck.name,
            "command": ["true", "{deck}"],
            "frequencies": found,
            "reader": None,
            "inputs": [],
            "timeout": 1.0,
            "retries": 0,
            "keep": False,
            "store": "solves",
            "step": 1e-3,
            "folder": folder,
        },
    )
    yield Call("Damage", fmu.Damage, {"prior": fmu.HalfNormal(0.1), "scatter": fmu.Population()})
    yield Call(
        "ElementGroup",
        fmu.ElementGroup,
        {"name": "g", "elements": [[0, 1]], "section": section, "material": steel, "y_direction": (0.0, 1.0, 0.0)},
    )
    yield Call("Ensemble", fmu.Ensemble, {"walkers": 16, "moves": "stretch"})
    yield Call("Export", fmu.Export, {"values": {"k": 1.0}, "model": chain(), "check": False, "name": "first"})
    yield Call("Factor", fmu.Factor, {"targets": [("E", "beam")]})
    yield Call("FoundFrequencies", fmu.FoundFrequencies, {"file": "output.txt", "pattern": "f=(.*)"})
    yield Call(
        "Frame",
        fmu.Frame,
        {
            "nodes": nodes,
            "groups": [group],
            "supports": {0: ("x", "y")},
            "masses": [fmu.PointMass(1, 2.0)],
            "arms": {"tip": fmu.RigidArm(1, (0.0, 0.1, 0.0))},
            "springs": [fmu.JointSpring("s", (1, None), {"x": 1e5})],
        },
    )
    yield Call("Frame.separable", frame.separable, {"updates": {"E": [("E", "beam")]}})
    errors = {
        "kind": "relative",
        "sd": [0.01, 0.02],
        "weights": [1.0, 2.0],
        "model_sd": fmu.Parameter("sd", 0.1, 0.0, 1.0),
    }
    yield Call("FrequencyErrors", fmu.FrequencyErrors, errors)
    yield Call("StudentErrors", fmu.StudentErrors, errors | {"freedom": 4.0})
    yield Call("ShapeErrors", fmu.ShapeErrors, {key: errors[key] for key in ("sd", "weights", "model_sd")})
    yield Call("MACErrors", fmu.MACErrors, {"sd": 0.01, "weights": [1.0, 2.0], "together": [["1", "2"]]})
    yield Call(
        "Geometry",
        fmu.Geometry,
        {"nodes": nodes, "elements": [[0, 1]], "masses": [1], "springs": [(0, None)], "ids": [3, 4], "mesh": None},
    )
    yield Call("Geometry.of_mesh", fmu.Geometry.of_mesh, {"mesh": chain()})
    yield Call("HalfNormal", fmu.HalfNormal, {"sd": 1.0, "at": 0.0})
    yield Call(
        "HamiltonianMonteCarlo",
        fmu.HamiltonianMonteCarlo,
        {
            "step_size": 0.1,
            "n_steps": 5,
            "jitter": 0.2,
            "inverse_mass": [1.0],
            "first_mass": [1.0],
            "gradient": "exact",
            "delta": 1.0,
            "h": 1e-5,
            "max_bounces": 10,
            "target_accept": 0.8,
            "length": 2.0,
        },
    )
    yield Call(
        "JointProblem",
        fmu.JointProblem,
        {
            "model": model,
            "tests": states,
            "parameters": [parameter],
            "varies": {"k": "group"},
            "slopes": None,
            "reference": "intact",
            "correlation": None,
            "pairing": "index",
            "beta": None,
            "error": made["errors"],
            "reduction": False,
            "engine": None,
            "name": "joint",
        },
    )
    yield Call(
        "JointSpring", fmu.JointSpring, {"name": "s", "nodes": (0, 1), "stiffness": {"x": 1e5}, "tied": ("y",)}
    )
    yield Call("LogNormal", fmu.LogNormal, {"median": 1.0, "sigma": 0.1})
    yield Call("LogNormal.from_mean", fmu.LogNormal.from_mean, {"mean": 1.0, "sd": 0.1})
    yield Call("LogNormal.from_mode", fmu.LogNormal.from_mode, {"mode": 1.0, "sd": 0.1})
    yield Call("Material", fmu.Material, {"E": 1e9, "nu": 0.3, "rho": 1e3})
    yield Call("MetropolisHastings", fmu.MetropolisHastings, {"proposal": fmu.RandomWalk(0.1)})
    yield Call(
        "MixtureSampler",
        fmu.MixtureSampler,
        {
            "components": None,
            "weights": None,
            "bent": None,
            "wide": 0.1,
            "local": fmu.Slice(),
            "local_steps": 1,
            "jumps": 9,
            "adapt": True,
        },
    )
    yield Call(
        "ModalData",
        fmu.ModalData,
        {
            "frequencies_hz": [10.0, 24.0],
            "numbers": (1, 2),
            "sensors": made["sensors"],
            "labels": ("a", "b"),
            "shapes": made["shapes"],
            "sd_hz": [0.1, 0.2],
            "covariance_hz2": None,
            "shapes_sd": 0.01,
            "counterparts": (),
            "tests": None,
            "use": (True, False),
            "mpc": [1.0, 1.0],
            "points": None,
        },
    )
    yield Call(
        "ModalData.from_tests",
        fmu.ModalData.from_tests,
        {
            "frequencies": [[10.0, 24.0], [10.1, 24.2], [9.9, 24.1]],
            "shapes": None,
            "scatter": "each",
            "numbers": (1, 2),
            "sensors": (),
            "labels": ("a", "b"),
            "use": (True, False),
        },
    )
    yield Call("ModalData.from_csv", fmu.ModalData.from_csv, {"frequencies": folder / "f.csv", "shapes": None})
    modes = MeasuredModes(np.array([10.0, 24.0]), ("1", "2"))
    yield Call("ModalData.from_modes", fmu.ModalData.from_modes, {"modes": modes})
    yield Call(
        "ModalData.from_pyoma",
        fmu.ModalData.from_pyoma,
        {
            "result": SimpleNamespace(Fn=np.array([10.0, 24.0]), Phi=made["shapes"]),
            "sensors": made["sensors"],
            "modes": [1],
            "least_mpc": 0.8,
        },
    )
    yield Call(
        "ModalData.from_uff", fmu.ModalData.from_uff, {"path": folder / "f.uff", "nodes": {1: 1}, "modes": [1]}
    )
    yield Call("ModalData.to_uff", data.to_uff, {"path": folder / "out.uff", "nodes": None})
    yield Call("MassErrors", fmu.MassErrors, {
        "mass": 7.5, "sd": 0.1, "centre": (0.0, 0.0, 0.0), "centre_sd": 0.1, "at_supports": 0.0,
        "test": None})  # fmt: skip
    yield Call("StaticErrors", fmu.StaticErrors, {
        "force": (3, "x"), "load": 1.0, "displacement": 1e-5, "sd": 1e-6, "at": (2, "x"),
        "test": None})  # fmt: skip
    yield Call("MixtureMove", fmu.MixtureMove, {"density": None, "lower": [0.5], "upper": [2.0]})
    yield Call("from_emcee", fmu.from_emcee, {
        "source": walked(), "problem": None, "names": ["k"], "discard": 0, "thin": 1, "thin_by": 1,
        "hdf_name": "mcmc", "blob_names": None, "maxima": None})  # fmt: skip
    yield Call("Normal", fmu.Normal, {"sd": 1.0, "mean": 0.0})
    yield Call("Normal.from_alpha", fmu.Normal.from_alpha, {"alpha": 1.0, "mean": 0.0})
    yield Call(
        "OpenSeesModel",
        fmu.OpenSeesModel,
        {"build": stop, "start": [1.0], "modes": 2, "step": 1e-4, "store": None},
    )
    yield Call(
        "Parameter",
        fmu.Parameter,
        {"name": "k", "start": 1.0, "lower": 0.5, "upper": 2.0, "prior": prior, "unit": "N/m", "group": "g"},
    )
    yield Call("PiecewiseLinear", fmu.PiecewiseLinear, {"prior": prior, "kinks": [0.0]})
    yield Call("PointMass", fmu.PointMass, {"node": 0, "mass": 1.0, "inertia": (0.0, 0.0, 0.1), "name": "m"})
    yield Call("Polynomial", fmu.Polynomial, {"priors": [prior]})
    yield Call("Outliers", fmu.Outliers, {"share": 0.1, "scale": 4.0})
    yield Call(
        "Population",
        fmu.Population,
        {"distribution": "normal", "sd": prior, "between": prior, "sd_by_group": True},
    )
    yield Call("RandomWalk", fmu.RandomWalk, {"scale": [[0.1]]})
    yield Call("RigidArm", fmu.RigidArm, {"node": 1, "offset": (0.0, 0.0, 0.1)})
    yield Call("ScaledBeta", fmu.ScaledBeta, {"a": 2.0, "b": 3.0, **numbers})
    yield Call("ScaledBeta.from_mean", fmu.ScaledBeta.from_mean, {"mean": 1.0, "sd": 0.1, **numbers})
    yield Call("ScipyPrior", fmu.ScipyPrior, {"distribution": scipy.stats.norm(0.0, 1.0)})
    for name, sides in (("rectangle", ("width", "height")), ("tube", ("diameter", "thickness")),
                        ("i_section", ("height", "width", "web", "flange"))):  # fmt: skip
        size = dict(zip(sides, (0.2, 0.1, 0.01, 0.01), strict=False)) if name != "rectangle" else {}
        yield Call(f"Section.{name}", getattr(fmu.Section, name), size or dict.fromkeys(sides, 0.1))
    yield Call("Section", fmu.Section, {"A": 1e-3, "Iy": 1e-6, "Iz": 1e-6, "J": 1e-6})
    yield Call(
        "SeparableModel",
        fmu.SeparableModel,
        {
            "K_terms": model.K_terms,
            "M_terms": model.M_terms,
            "dofs": chain().dofs,
            "geometry": None,
            "arms": None,
            "ties": None,
            "motions": None,
        },
    )
    yield Call(
        "SeparableModel.from_terms",
        fmu.SeparableModel.from_terms,
        {
            "parameters": ["k"],
            "stiffness": [K, K],
            "mass": [M],
            "dofs": chain().dofs,
            "geometry": None,
            "motions": None,
        },
    )
    yield Call(
        "Slice",
        fmu.Slice,
        {
            "scheme": "hyperrectangle",
            "width": [1.0],
            "max_steps_out": 5,
            "max_shrinks": 50,
            "axes": [[1.0]],
            "spread": 3.0,
        },
    )
    yield Call("SolveStore", fmu.SolveStore, {"folder": folder})
    yield Call("SpikeAndSlab", fmu.SpikeAndSlab, {"share": 0.1, "sd": 0.3, "spike": 0.01, "mean": 0.0})
    yield Call(
        "Discrepancy",
        fmu.Discrepancy,
        {"kind": "embedded", "tau": 0.05, "prior_sd": 0.1, "by": "common", "groups": ("a",), "name": "tau"},
    )
    yield Call(
        "Discrepancy",
        fmu.Discrepancy,
        {"kind": "modes", "prior_sd": 0.1, "sd": 0.02, "correlation": 0.5, "shape_sd": 0.1, "length": 2.0},
    )
    frf = {"drives": ((1, "x"),), "responses": ((1, "x"),), "kind": "mobility"}
    yield Call("FRFData", fmu.FRFData, frf | {
        "frequencies_hz": [5.0, 10.0], "values": [[1j, 2.0]], "sd": 0.1, "coherence": [[0.9, 0.8]], "averages": 5,
        "use": None, "band": (4.0, 8.0), "hits": None, "notes": ()})  # fmt: skip
    yield Call("FRFData.from_hits", fmu.FRFData.from_hits, frf | {
        "frequencies_hz": [5.0, 10.0], "values": [[[1j, 2.0]], [[1.1j, 2.0]]]})  # fmt: skip
    yield Call("FRFData.from_records", fmu.FRFData.from_records, frf | {
        "force": np.sin(np.arange(64.0) ** 2), "response": np.arange(64.0)[None], "sampling_hz": 100.0,
        "window": "hann", "segment": 16, "overlap": 0.5})  # fmt: skip
    yield Call("pick_modes", fmu.pick_modes, {
        "data": fmu.FRFData(np.arange(1.0, 9.0), [1.0 / (1.0 - (np.arange(1.0, 9.0) / 4.1) ** 2 + 0.05j)],
                            ((1, "x"),), ((1, "x"),), "receptance", 1e-3),
        "numbers": (1,), "n": 1, "sd": 0.01})  # fmt: skip
    yield Call("ModalDamping", fmu.ModalDamping, {"ratios": [0.01, 0.02]})
    yield Call("RayleighDamping", fmu.RayleighDamping, {"alpha": 0.1, "beta": 1e-4})
    yield Call("StructuralDamping", fmu.StructuralDamping, {"loss": 0.01, "of": {"k": 0.02}})
    yield Call("Dashpot", fmu.Dashpot, {"at": (0, "x"), "coefficient": 5.0, "to": (1, "x")})
    yield Call("DampingMatrix", fmu.DampingMatrix, {"matrix": K, "coefficient": 1.0})
    yield Call("FRFErrors", fmu.FRFErrors, {
        "data": fmu.FRFData([5.0, 10.0], [[1j, 2.0]], ((1, "x"),), ((1, "x"),), sd=0.1), "scale": "log",
        "damping": fmu.ModalDamping(0.01), "model_sd": 0.1, "gain_sd": 0.02, "force_gain_sd": 0.02,
        "delay_sd": 1e-4})  # fmt: skip
    yield Call("GibbsSampler", fmu.GibbsSampler, {"step_size": 0.5})
    yield Call("Change", fmu.Change, {"masses": {"a": 1.0}, "springs": {("a", "x"): 1.0}})
    yield Call(
        "Tempering", fmu.Tempering, {"kernel": "slice", "temperatures": [1.0, 0.0], "rungs": None, "swap_every": 1}
    )
    yield Call("Term", fmu.Term, {"matrix": K, "powers": (1.0,)})
    yield Call(
        "Test",
        fmu.Test,
        {
            "name": "t",
            "data": data,
            "group": "g",
            "covariates": {"T": 1.0},
            "masses": {1: 0.1},
            "springs": {(1, "x"): 10.0},
            "known": {"k": 1.0},
        },
    )
    yield Call("Test.from_csv", fmu.Test.from_csv, {
        "path": folder / "tests.csv", "labels": ["a", "b"], "masses": {1: 0.1}, "springs": {(1, "x"): 10.0},
        "known": {"k": 1.0}})  # fmt: skip
    posed = {
        "model": model,
        "data": data,
        "parameters": [parameter],
        "pairing": "soft",
        "softness": 0.02,
        "beta": None,
        "error": made["errors"],
        "name": "p",
    }
    yield Call(
        "UndatedDamage",
        fmu.UndatedDamage,
        {"prior": prior, "by": "day", "grows": True, "date": prior, "event": "flood", "scatter": fmu.Population()},
    )
    yield Call("UpdatingProblem", fmu.UpdatingProblem, posed)
    yield Call(
        "UpdatingProblem.reduced", fmu.UpdatingProblem.reduced, {"reduction": False, "engine": None, **posed}
    )
    yield Call("UpdatingProblem.using", problem.using, {"labels": ["1"]})
    yield Call("UpdatingProblem.coarser", problem.coarser, {"share": 0.5})
    for name in ("log_prob", "log_prob_and_grad", "log_prior", "log_prior_and_grad", "log_likelihood",
                 "log_likelihood_terms", "frequencies"):  # fmt: skip
        yield Call(f"UpdatingProblem.{name}", getattr(problem, name), {"theta": [1.0]})
    case = {"name": "cantilever-young"}
    yield Call("cases.path", fmu.cases.path, case)
    yield Call("cases.describe", fmu.cases.describe, case)
    yield Call("cases.load", fmu.cases.load, {"pairing": "none", "beta": 1.0, "engine": None, **case})
    yield Call("check", fmu.check, {"problem": watched, "draws": 100, "seed": 1})
    yield Call("compare", fmu.compare, {"traces": {"a": trace}, "problem": watched})
    yield Call("compare_models", fmu.compare_models, {"models": {"a": trace}, "until_ess": 100.0, "seed": 1})
    yield Call(
        "expected_modes",
        fmu.expected_modes,
        {"model": model, "parameters": [parameter], "n_modes": 1, "frequency_sd": 0.01},
    )
    yield Call("plan", fmu.plan, {"problem": watched, "sensors": 1, "draws": 2, "seed": 1})
    yield Call("DamageTarget", fmu.DamageTarget, {"of": ["k"], "beyond": 0.1, "prior": prior})
    planned = at_the_door_of(made["plan"])
    yield Call("simulate_plan", fmu.simulate_plan, {"plan": planned, "tests": 1, "draws": 4})
    yield Call("write_plan", fmu.write_plan, {"plan": planned, "directory": folder / "plan", "simulated": None})
    yield Call("craig_bampton", fmu.craig_bampton, {"K": K, "M": M, "boundary": [0], "n_modes": 1})
    yield Call("guyan", fmu.guyan, {"K": K, "M": M, "masters": [0]})
    yield Call("damage", fmu.damage, {"trace": trace, "beyond": (0.05, 0.1)})
    yield Call("damage_by_test", fmu.damage_by_test, {"trace": trace, "beyond": (0.05, 0.1)})
    yield Call(
        "delayed_acceptance",
        fmu.delayed_acceptance,
        {"problem": slow, "trace": trace, "until_ess": 400, "max_solves": None, "engine": None},
    )
    yield Call("diagnose", fmu.diagnose, {"trace": trace, "problem": watched, "others": ()})
    yield Call("engine", fmu.engine, {"workers": 1, "cluster": None})
    yield Call("evidence", fmu.evidence, {"trace": trace, "method": None})
    varied = fmu.JointProblem(
        model, states, [parameter], varies={"k": fmu.Population()}, pairing="index", error=made["errors"]
    )
    known = trace_of(varied, np.tile([1.0, 0.1, 0.0, 0.0], (50, 1)))
    yield Call("predict_tests", fmu.predict_tests, {
        "trace": known, "problem": varied, "tests": [fmu.Test("next", data)], "like": "before",
        "draws": 40})  # fmt: skip
    yield Call("predict_modes", fmu.predict_modes, {
        "trace": known, "problem": varied, "modes": 1, "change": fmu.Change(), "factors": {}, "test": "before",
        "draws": 5, "seed": 1})  # fmt: skip
    yield Call("expectation", fmu.expectation, {"trace": trace, "G": "k"})
    yield Call(
        "export", fmu.export, {"run_directory": folder, "sampler": None, "at": "mean", "out": None, "model": None}
    )
    yield Call("find_map", fmu.find_map, {"problem": watched, "starts": 4, "seed": 1})
    yield Call("from_exports", fmu.from_exports, {"exports": exports, "bounds": {"k": (0.5, 2.0)}})
    yield Call(
        "from_opensees",
        fmu.from_opensees,
        {"build": stop, "names": ["k"], "start": [1.0], "lower": [0.5], "upper": [2.0]},
    )
    yield Call("identifiability", fmu.identifiability, {"problem": watched, "theta": None})
    yield Call("information", fmu.information, {"trace": trace})
    yield Call("leave_one_out", fmu.leave_one_out, {"trace": trace, "problem": watched})
    yield Call("load", fmu.load, {"path": folder / "no.toml", "pairing": "index", "beta": 1.0, "engine": None})
    yield Call("load_trace", fmu.load_trace, {"path": saved})
    yield Call(
        "match_points",
        fmu.match_points,
        {"points": {"A": [0.0, 0.0, 0.0]}, "model": frame.separable(), "unit": "m", "known": {"A": 1}},
    )
    yield Call("pairing_changes", fmu.pairing_changes, {"trace": trace})
    yield Call("read_mesh", fmu.read_mesh, {"path": folder / "no.inp"})
    yield Call("read_frf", fmu.read_frf, {
        "path": folder / "frf.csv", "kind": "mobility", "drives": ((1, "x"),), "responses": ((1, "x"),),
        "nodes": None, "variables": None, "frfs": [1], "scale": 1.0, "sd": 0.1, "band": (0.5, 2.0)})  # fmt: skip
    yield Call(
        "read_model",
        fmu.read_model,
        {
            "path": folder / "no.mtx",
            "mass": folder / "no.mtx",
            "mesh": None,
            "dofs": None,
            "variables": None,
            "tied_modes": None,
        },
    )
    yield Call(
        "sample",
        fmu.sample,
        {
            "problem": watched,
            "sampler": "mh",
            "draws": 4,
            "warmup": 4,
            "chains": 2,
            "seed": 1,
            "init": "start",
            "jumps": False,
            "groups": 1,
            "until_ess": 400.0,
            "max_draws": 8,
            "max_solves": 100,
            "maxima": None,
            "checkpoint": None,
            "workers": 1,
            "on_draws": None,
            "max_failure_rate": 0.5,
            "progress": None,
        },
    )
    yield Call("save_trace", fmu.save_trace, {"trace": trace, "path": folder / "again.nc"})
    yield Call("summary", fmu.summary, {"trace": trace, "ci_prob": 0.9})
    yield Call(
        "surrogate",
        fmu.surrogate,
        {
            "problem": slow,
            "seed": 1,
            "tolerance": 0.05,
            "batch": 2,
            "checks": 12,
            "max_solves": 40,
            "engine": None,
        },
    )
    yield Call("write_report", fmu.write_report, {"run_directory": folder})


def _with_defaults(call: Call) -> Call:
    """Return a call that gives every argument, with its default if need be."""
    taken = inspect.signature(call.door).parameters.values()
    named = [one for one in taken if one.kind not in (one.VAR_POSITIONAL, one.VAR_KEYWORD)]
    return call._replace(given={one.name: one.default for one in named} | call.given)


_FUNCTIONS = {"function", "build", "G"}
"""A class is a function: what it raises when it is called is its own affair."""


def wrong_calls(folder: Path) -> Iterator[tuple[Call, str, str]]:
    """Yield a valid call, the argument that is made wrong, and the key of its wrong value."""
    for call in map(_with_defaults, calls(folder)):
        for name in call.given:
            for key in WRONG:
                if not (key == "class" and name in _FUNCTIONS):
                    yield call, name, key


def outcome(call: Call, name: str, key: str) -> str:
    """Return how a wrong call ended: "accepted", "refused" in words of fmu's, or what it said instead."""
    try:
        call.door(**call.given | {name: WRONG[key]})
    except Reached:
        return "accepted"
    except (ValueError, TypeError, OSError) as error:
        frame, text = traceback.extract_tb(error.__traceback__)[-1], str(error)
        ours = Path(fmu.__file__).parent in Path(frame.filename).parents and _raises(frame.filename, frame.lineno)
        if ours and text == reason_of(call):  # for which the call is refused without anything wrong
            return "accepted"
        if ours and _names(text, call, name, WRONG[key]) and _RULE.search(text):
            return "refused"
        return f"{type(error).__name__}: {text}"
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return "accepted"


_RULE = re.compile(r"\b(must|needs?|has no|no such file|takes|contains no|is not valid)\b")
_ALIASES = {
    "match_points": {"known": "nodes"},
    "cases": {"name": "case"},
    "Test": {"labels": "tests"},  # tests.csv, which lacks the column
    "SeparableModel": {"stiffness": "K_terms", "mass": "M_terms"},
}
_REASONS: dict[str, str] = {}


def reason_of(call: Call) -> str:
    """Return why the valid call is refused, as for want of a file or a library; empty if it is not."""
    if call.name not in _REASONS:
        _REASONS[call.name] = ""
        try:
            call.door(**call.given)
        except Reached:
            pass
        except (ValueError, OSError) as error:
            _REASONS[call.name] = str(error)
    return _REASONS[call.name]


def _names(text: str, call: Call, name: str, value: Any) -> bool:
    """Return whether a refusal begins with the argument, or with another that does not fit it."""
    called = {*call.given, _ALIASES.get(call.name.partition(".")[0], {}).get(name, name), "path"}
    return (
        re.split(r"[:., ]", text)[0] in called
        or name in re.split(r"\W", text)
        or text.startswith(("x: ", "SimpleNamespace: ", f"{type(value).__name__}: "))
    )


def _raises(file: str, line: int) -> bool:
    """Return whether a line is of a ``raise`` statement."""
    return line in _raising_lines(file)


@cache
def _raising_lines(file: str) -> set[int]:
    nodes = ast.walk(ast.parse(Path(file).read_text(encoding="utf-8")))
    return {i for one in nodes if isinstance(one, ast.Raise) for i in range(one.lineno, one.end_lineno + 1)}


_FREE = {"at", "mean", "low", "lower", "nu", "load", "displacement"}
"""Arguments that may be negative."""
_ZERO = {"seconds", "retries", "jitter", "max_bounces", "max_steps_out", "mass", "n_modes", "seed", "warmup"}
_ZERO |= {
    "max_failure_rate",
    "node",
    "least_mpc",
    "discard",
    "at_supports",
    "correlation",
    "drift",
    "min_distance",
    "overlap",
}
_ZERO |= {"ratios", "alpha", "beta", "loss", "coefficient", "model_sd", "gain_sd", "force_gain_sd", "delay_sd"}


def may_be_accepted(call: Call, name: str, key: str) -> bool:
    """Say by rule, from the published annotation, whether a value of `WRONG` is a legitimate one of an argument.

    None where it is optional, True for a switch, text for text, large numbers for numbers and those of at most 0
    where they mean something, and nothing for a collection.
    """
    published = inspect.signature(call.door).parameters
    if name not in published:  # of those that are passed on
        published = inspect.signature(fmu.UpdatingProblem).parameters
    annotation = str(published[name].annotation)
    is_path = "Path" in annotation
    kinds = re.findall(r"\w+", annotation)
    if "Target" in kinds and key in ("x", "empty text", "['x!']", "words", "class", "[]", "()", "{}"):
        return True  # names and functions, which are looked up when the model is solved
    if key in ("None", "True"):
        is_optional = published[name].annotation == "Any" and published[name].default is None
        return {"None": "None", "True": "bool"}[key] in kinds or (key == "None" and is_optional)
    if key in ("x", "empty text"):
        return ("str" in kinds and (key == "x" or not is_path)) or "Place" in kinds or (is_path and key == "x")
    if key in ("1e9", "1e300", "-1", "-0.5", "0", "inf", "-inf"):
        if not {"float", "int", "Positive", "NotNegative", "Count", "Seed", "Draws", "Bound", "ArrayLike", "Any",
                "Place", "Length", "Scale"} & set(kinds):  # fmt: skip
            return False
        if key in ("inf", "-inf"):
            return "Bound" in kinds or (name in ("lower", "upper") and "ArrayLike" in kinds)
        return key.startswith("1e") or name in _FREE or (key == "0" and name in _ZERO) or "Place" in kinds
    if key in ("[]", "()", "{}", "['x!']", "words"):
        empty = {"Sequence", "tuple", "Iterable", "ArrayLike", "IntArray"} if key in ("[]", "()") else {"Mapping"}
        return (
            (bool({"Sequence", "tuple"} & set(kinds)) and bool({"str", "Place"} & set(kinds)))
            or bool(empty & set(kinds))
            or (key == "words" and "Place" in kinds)
        )
    if key == "[None]":  # a place where nothing is
        return "Sequence" in kinds and "None" in kinds and name == "spring_parameters"
    if key == "{'x': None}":  # a covariate that was not measured
        return "Mapping" in kinds and "None" in kinds and name == "covariates"
    if key == "class":
        return "Callable" in kinds or name == "build"
    return key == "[nan]" and name == "theta"
