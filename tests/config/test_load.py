"""Files give the problems that Python gives."""

from pathlib import Path

import numpy as np
import pytest
import scipy.sparse as sp
from numpy.testing import assert_allclose

import fmu
from fmu import cases
from fmu.config import ConfigurationError, load
from fmu.fem.frame.components import DIRECTIONS, ElementGroup, Material, PointMass, Section
from fmu.fem.frame.frame import Frame
from fmu.posterior.parameters import Parameter
from fmu.posterior.priors.base import Normal
from fmu.posterior.reduction.tolerance import Tolerance
from tests import cantilever
from tests.shear_building import shear_building


@pytest.mark.parametrize(
    ("name", "build", "pairing"), [("young", cantilever.young, "shape"), ("section", cantilever.section, "index")]
)
def test_the_paper_as_files(name, build, pairing):
    path = Path(cases.__file__).parent / f"cantilever-{name}.toml"
    from_file, built = load(path, pairing), build(pairing)
    theta = built.sample_prior(np.random.default_rng(1), 100)
    assert_allclose(from_file.log_prob(theta), built.log_prob(theta), rtol=1e-9)
    assert (from_file.name, from_file.names, from_file.units) == (built.name, built.names, built.units)
    for key in ("lower", "upper", "start", "scale"):
        np.testing.assert_array_equal(getattr(from_file, key), getattr(built, key))


def portal():
    """The frame of the file, in Python."""
    tube = Section(
        A=np.pi * (0.05**2 - 0.045**2),
        Iy=np.pi / 4 * (0.05**4 - 0.045**4),
        Iz=np.pi / 4 * (0.05**4 - 0.045**4),
        J=np.pi / 2 * (0.05**4 - 0.045**4),
    )
    nodes = [(0, 0, z) for z in np.linspace(0, 2, 4)]
    nodes += [(3, 0, z) for z in np.linspace(2, 0, 4)]
    nodes += [(x, 0, 2) for x in (0.75, 1.5, 2.25)]
    steel = Material(E=2.1e11, nu=0.3, rho=7850.0)
    legs = [(0, 1), (1, 2), (2, 3), (4, 5), (5, 6), (6, 7)]
    beam = Section(A=3e-3, Iy=4e-6, Iz=9e-6, J=7e-6)
    frame = Frame(
        np.array(nodes, dtype=float),
        [
            ElementGroup("legs", legs, tube, steel),
            ElementGroup("beam", [(3, 8), (8, 9), (9, 10), (10, 4)], beam, steel),
        ],
        {0: DIRECTIONS, 7: ("x", "y", "z")},
        [PointMass(3, 20.0)],
    )
    model = frame.separable({"E legs": [("E", "legs")], "rho beam": [("rho", "beam")]})
    data = fmu.ModalData([9.5, 12.1], sensors=((3, "x"), (4, "y")))
    parameters = [
        Parameter("E legs", 2.1e11, 1.5e11, 2.5e11, unit="N/m²"),
        Parameter("rho beam", 7850.0, 5000.0, 9000.0, Normal(500.0, mean=7850.0)),
    ]
    beta = 0.5 / np.array([0.1, 0.2]) ** 2
    return fmu.UpdatingProblem(model, data, parameters, pairing="index", beta=beta)


def test_a_frame(frame_text, tmp_path):
    (tmp_path / "portal.toml").write_text(frame_text)
    from_file, built = load(tmp_path / "portal.toml"), portal()
    theta = built.sample_prior(np.random.default_rng(2), 30)
    assert_allclose(from_file.log_prob(theta), built.log_prob(theta), rtol=1e-9)
    assert_allclose(from_file.model.structure.geometry.nodes, built.model.structure.geometry.nodes, atol=1e-15)
    assert from_file.data.sensors == ((3, "x"), (4, "y"))


@pytest.mark.parametrize(
    ("value", "tolerance"), [("true", Tolerance()), ("1e-3", Tolerance(1e-3, 0.1)), ("false", None)]
)
def test_how_good_the_reduced_model_must_be(matrices_text, folder, value, tolerance):
    (folder / "two.toml").write_text(matrices_text.replace("reduction = false", f"reduction = {value}"))
    assert load(folder / "two.toml").tolerance == tolerance


@pytest.mark.parametrize(
    ("value", "rule"),
    [
        ("0.02", r"less than or equal to 0\.01 \(got 0\.02\)"),
        ("0", r"greater than 0 \(got 0\)"),
        ('"yes"', r"true, false or a number \(got 'yes'\)"),
    ],
)
def test_a_reduction_that_is_none_is_a_mistake(frame_text, tmp_path, value, rule):
    (tmp_path / "portal.toml").write_text(frame_text.replace("reduction = false", f"reduction = {value}"))
    with pytest.raises(ConfigurationError, match=rf"reduction: must be {rule}"):
        load(tmp_path / "portal.toml")


def test_matrices(matrices_text, folder):
    (folder / "two.toml").write_text(matrices_text)
    from_file = load(folder / "two.toml")
    model = shear_building(["k1", "k2"], mass=[16.5e3, 16.1e3], dofs=[("first", "x"), ("second", "x")])
    data = fmu.ModalData([3.1, 9.8], sensors=[("first", "x"), ("second", "x")], shapes=[[0.6, 1.0], [1.0, -0.6]])
    parameters = [fmu.Parameter(name, 2.97e7, 1e7, 6e7) for name in ("k1", "k2")]
    built = fmu.UpdatingProblem(model, data, parameters, beta=0.5 / 0.05**2)
    theta = built.sample_prior(np.random.default_rng(3), 30)
    assert_allclose(from_file.log_prob(theta), built.log_prob(theta), rtol=1e-12)


def test_the_beam_exported_as_matrices(tmp_path):
    built = cantilever.young("index")
    structure = built.model.structure
    built = built.with_model(built.model.truth)
    text = ['name = "exported"', 'pairing = "index"', "reduction = false", "[model]", 'type = "matrices"']
    text.append(f"dofs = {[list(dof) for dof in structure.dofs]}")
    for key, terms in (("stiffness", structure.K_terms), ("mass", structure.M_terms)):
        for k, term in enumerate(terms):
            sp.save_npz(tmp_path / f"{key}{k}.npz", term.matrix)
            powers = ", ".join(f"{n} = {p:g}" for n, p in zip(built.names, term.powers, strict=True) if p)
            text += [f"[[model.{key}]]", f'file = "{key}{k}.npz"', f"powers = {{ {powers} }}"]
    text += ["[measurement]", "frequencies = [31.9, 197.9, 553.0, 1082.2, 1781.5]", "numbers = [1, 3, 5, 7, 9]"]
    text += ["beta = 1.0", 'sensors = [[49, "z"]]']
    for name in built.names:
        text += ["[[parameters]]", f'name = "{name}"', "start = 2.4e11", "lower = 1.7e11", "upper = 2.5e11"]
        text.append('prior = { distribution = "normal", sd = 2e11 }')
    (tmp_path / "exported.toml").write_text("\n".join(text))
    from_file = load(tmp_path / "exported.toml")
    theta = built.sample_prior(np.random.default_rng(4), 10)
    assert_allclose(from_file.log_prob(theta), built.log_prob(theta), rtol=1e-9)


def test_pairing_and_trust_instead_of_those_of_the_file(frame_text, tmp_path):
    (tmp_path / "portal.toml").write_text(frame_text)
    problem = load(tmp_path / "portal.toml", pairing="shape", beta=3.0)
    assert problem.name == "portal, by shape"
    np.testing.assert_array_equal(problem.likelihood.beta, [3.0, 3.0])
    np.testing.assert_allclose(load(tmp_path / "portal.toml").likelihood.beta, [50.0, 12.5])
