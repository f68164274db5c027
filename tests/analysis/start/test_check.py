"""A problem looked at before sampling: what is right is called right, and what may be wrong is found."""

import re
from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
import scipy.sparse as sp

import fmu
from fmu.analysis.start.check import check
from fmu.analysis.start.gradient_check import check_gradient
from fmu.analysis.start.initial_modes import initial_modes
from fmu.analysis.start.model_words import model_in_words
from fmu.analysis.start.pairing_doubts import unlike
from fmu.analysis.start.prior_prediction import prior_prediction
from fmu.analysis.trace.modal_states import modal_states
from fmu.fem.modes.separable import SeparableModel
from fmu.fem.modes.terms import Term
from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.parameters import Parameter
from fmu.posterior.problem import UpdatingProblem
from tests.linear import LinearModel
from tests.shear_building import shear_building, storey

K1, K2, K3 = (storey(j, 3) for j in range(3))
M = np.eye(3)
SENSORS = ((0, "x"), (1, "x"), (2, "x"))
EXACT = np.sqrt(scipy.linalg.eigh(1e4 * (K1 + K2 + K3), M)[0]) / (2 * np.pi)
SHAPES = scipy.linalg.eigh(1e4 * (K1 + K2 + K3), M)[1]


def storeys(frequencies=EXACT[:2], shapes=None, sensors=(), pairing="shape", stiffness=(K1, K2 + K3), **settings):
    """Three masses in a row on springs of 10 kN/m."""
    n = len(stiffness)
    K_terms = [Term(sp.csr_array(K), tuple(float(i == j) for j in range(n))) for i, K in enumerate(stiffness)]
    model = SeparableModel(K_terms, [Term(sp.csr_array(M), (0.0,) * n)])
    parameters = [Parameter(f"k{i + 1}", 1e4, 5e3, 2e4, unit="N/m") for i in range(n)]
    data = ModalData(frequencies, sensors=sensors, shapes=shapes, **settings)
    return UpdatingProblem(model, data, parameters, pairing=pairing, beta=200.0)


def linear(measured=(103.0, 101.0, 107.0), model=None):
    parameters = [Parameter("a", 1.0, 0.0, 2.0), Parameter("b", 1.0, 0.0, 2.0)]
    return UpdatingProblem(model or LinearModel(), ModalData(measured), parameters)


def test_the_spectrum_is_that_of_the_matrices_and_each_mode_says_what_it_answers_to():
    problem = fmu.cases.load("cantilever-section", pairing="shape")
    found = initial_modes(problem)
    structure = problem.model.structure
    K, mass = (A.toarray() for A in (structure.K(problem.start), structure.M(problem.start)))
    # of the inverse problem, where rounding is relative to the lowest mode and not to the highest
    mu = scipy.linalg.eigh(mass, K, eigvals_only=True)
    exact = 1.0 / np.sqrt(mu[: -len(found.modes) - 1 : -1]) / (2 * np.pi)
    np.testing.assert_allclose([mode.frequency_hz for mode in found.modes], exact, rtol=1e-8)
    assert [found.of(k).number for k in range(5)] == [1, 3, 5, 7, 9]
    np.testing.assert_allclose([found.of(k).frequency_hz for k in range(5)], problem.frequencies(problem.start))
    # section 5.2 of the paper, table 4
    np.testing.assert_allclose([found.error_percent(k) for k in range(5)], [0.32, 2.58, 4.1, 5.04, 6.06], atol=0.3)
    assert {mode.moves for mode in found.modes if mode.measured is not None} == {"z 100 %"}
    assert [mode.seen for mode in found.modes] == [mode.measured is not None for mode in found.modes]
    assert found.doubts == ()
    assert "Computed modes 2, 4, 6, 8 move no sensor." in found.notes


def test_all_is_well_where_the_measured_shapes_are_those_of_the_model():
    found = initial_modes(storeys(shapes=-3.0 * SHAPES[:, :2], sensors=SENSORS))
    assert found.doubts == found.notes == ()
    np.testing.assert_allclose(np.diag(found.mac), 1.0)
    table = found.table()
    np.testing.assert_allclose(table["mac"][:2], 1.0)
    np.testing.assert_allclose(table["error_percent"][:2], 0.0, atol=1e-9)
    assert list(table["mode"]) == ["1", "2", ""]


def test_a_shape_that_no_mode_has():
    found = initial_modes(storeys(shapes=np.array([[0.3, 1.0, 0.4], SHAPES[:, 1]]).T, sensors=SENSORS))
    alike = (np.array([0.3, 1.0, 0.4]) @ SHAPES[:, 0]) ** 2 / 1.25
    assert 0.5 < alike < 0.8
    assert f"Mode 1: MAC {alike:.2f} with computed mode 1, below 0.8." in found.doubts


def test_sensors_that_do_not_tell_modes_apart():
    """One sensor sees no shape at all: every mode is as like the measured one."""
    found = initial_modes(storeys(EXACT[:1], np.ones((1, 1)), SENSORS[2:]))
    assert len(found.doubts) == 1
    assert found.doubts[0].startswith(
        "Mode 1: the sensors can hardly distinguish computed mode 1 (MAC 1.00) from "
    )


def test_a_mode_that_looks_like_another_one():
    """The sensors distinguish the modes perfectly: the number is wrong."""
    said = unlike(("1",), [1], np.array([[0.1, 0.0, 0.96]]))
    assert said[1] == (
        "Mode 1: it looks like computed mode 3 (MAC 0.96), not 2 (MAC 0.00): check its shape and the labels."
    )


def test_modes_in_another_order_than_measured():
    found = initial_modes(storeys(EXACT[:2], SHAPES[:, [1, 0]], SENSORS))
    assert [found.of(k).number for k in (0, 1)] == [2, 1]
    assert any("different orders: 1 is computed mode 2, 2 is computed mode 1" in doubt for doubt in found.doubts)


@pytest.mark.parametrize("pairing", ["index", "shape"])
def test_modes_that_are_hardly_apart(pairing):
    """Two equal masses on springs that hardly differ; by shape the pairing needs a sensor that sees both."""
    springs = (np.diag([1.0, 0.0, 0.0]), np.diag([0.0, 1.005, 9.0]))
    one, two = SENSORS[:1], SENSORS[:2]
    close = "Mode 1: computed modes 1 and 2 are 0.25 % apart"
    first = storeys(EXACT[:1], sensors=one, pairing=pairing, stiffness=springs)
    assert any(doubt.startswith(close) for doubt in initial_modes(first).doubts) == (pairing == "index")
    both = storeys(EXACT[:1], sensors=two, pairing=pairing, stiffness=springs)
    assert any(doubt.startswith(close) for doubt in initial_modes(both).doubts)


def test_shares_of_the_kinetic_energy_are_parts_of_it(tmp_path):
    """Couplings of displacements and rotations in the mass matrix once made 101 % of the tail's torsion."""
    text = fmu.cases.path("garteur").read_text(encoding="utf-8")
    (tmp_path / "garteur.toml").write_text(text.replace("[model]", "reduction = false\n\n[model]", 1), "utf-8")
    modes = initial_modes(fmu.load(tmp_path / "garteur.toml")).modes
    shares = [[float(x) for x in re.findall(r"([\d.]+) %", mode.moves)] for mode in modes]
    assert all(sum(one) <= 100.0 for one in shares)
    assert shares[[mode.number for mode in modes].index(15)] == [95.0]


def test_a_mode_that_was_not_measured_though_a_sensor_moves():
    found = initial_modes(storeys(EXACT[[0, 2]], SHAPES[:, [0, 2]], SENSORS))
    assert found.notes == ("Computed mode 2 moves a sensor, but was not measured.",)
    assert [mode.measured for mode in found.modes] == [0, None, 1]


def test_many_modes_that_no_sensor_sees_are_one_line():
    springs = (np.diag([1.0, 0.0, 0.0, 0.0, 0.0]), np.diag([0.0, 2.0, 3.0, 4.0, 9.0]))
    K_terms = [Term(sp.csr_array(K), tuple(float(i == j) for j in (0, 1))) for i, K in enumerate(springs)]
    model = SeparableModel(K_terms, [Term(sp.csr_array(np.eye(5)), (0.0, 0.0))])
    parameters = [Parameter(name, 1e4, 5e3, 2e4) for name in ("a", "b")]
    data = ModalData([16.0, 48.0], sensors=((0, "x"), (4, "x")))
    found = check(UpdatingProblem(model, data, parameters))
    assert found.modes.notes[-1] == "Computed modes 2–4 move no sensor."
    table = found.mode_table()
    assert list(table["number"]) == ["1", "2–4", "5"]
    assert table["measured mode"][1] == "3 move no sensor"
    assert table["computed, Hz"][1] == "22.51 to 31.83"  # √(2 … 4) · 100 / 2π


def test_the_gradient_is_right_to_rounding():
    found = check_gradient(fmu.cases.load("cantilever-young"))
    assert found.agrees
    assert found.largest < 1e-6
    assert found.sentence().startswith("The gradient agrees with central differences")
    assert found.table().shape == (15, 3)


class Wrong(LinearModel):
    """Its second slope is a hundredth too large."""

    def frequencies_and_gradient(self, theta):
        frequencies, slopes = super().frequencies_and_gradient(theta)
        return frequencies, slopes * [1.0, 1.01]


def test_a_wrong_gradient_is_found_out():
    found = check_gradient(linear(model=Wrong()))
    assert not found.agrees
    assert found.largest == pytest.approx(0.01, rel=0.02)
    assert "disagrees with central differences" in found.sentence()
    assert "for b at" in found.sentence()
    assert check_gradient(linear()).largest < 1e-8
    assert found.sentence() in check(linear(model=Wrong())).doubts


class Holey(LinearModel):
    """It has no gradient, and fails where a > 1.5."""

    def frequencies(self, theta):
        return np.where(theta[:, :1] > 1.5, np.nan, super().frequencies(theta))

    def frequencies_and_gradient(self, theta):
        return self.frequencies(theta), np.full((len(theta), 3, 2), np.nan)


def test_a_gradient_that_is_no_number():
    found = check_gradient(linear(model=Holey()))
    assert not found.agrees
    assert found.sentence() == "The gradient is not finite for a at the start."


def test_a_gradient_that_is_no_number_at_one_point_leaves_the_others_alone():
    """Nor is it blamed for a central difference that is not finite."""
    one = check_gradient(linear(model=Wrong()))
    exact, difference = one.exact.copy(), one.difference.copy()
    exact[1, 1], difference[2, 0] = np.nan, np.inf
    odd = replace(one, exact=exact)
    assert np.isfinite(odd.relative_error).sum() == odd.exact.size - 1
    assert odd.sentence() == f"The gradient is not finite for b at {one.points[1]}."
    odd = replace(one, difference=difference)
    assert odd.sentence() == f"The central difference is not finite for a at {one.points[2]}."


def test_the_prior_expects_what_its_draws_surround():
    problem = linear()
    found = prior_prediction(problem, draws=4000)
    # uniform on [0, 2]: mean 1, variance 1/3; beta = 1 is a noise of variance 1/2
    slopes = np.array([[2.0, 1.0], [0.5, -1.0], [1.0, 3.0]])
    np.testing.assert_allclose(found.mean, 100.0 + slopes.sum(axis=1), atol=0.1)
    np.testing.assert_allclose(found.sd, np.sqrt((slopes**2).sum(axis=1) / 3 + 0.5), rtol=0.03)
    assert not found.is_far.any()
    assert "mode 2 is the farthest" in found.sentences()[0]


def test_a_measurement_that_the_prior_does_not_expect():
    found = prior_prediction(linear(measured=(103.0, 99.5, 120.0)))
    assert found.is_far.tolist() == [False, False, True]
    assert found.sentences()[0].startswith("Mode 3: measured at 120 Hz, ")
    assert "sd above the prior prediction" in found.sentences()[0]


def test_a_factor_of_two_pi_is_taken_for_radians_per_second():
    expected, turn = np.array([102.0, 99.0, 104.0]), 2 * np.pi

    def hints(measured):
        return [one for one in prior_prediction(linear(measured=tuple(measured))).doubts if "rad/s" in one]

    (hint,) = hints(expected / turn)
    assert hint.startswith(
        "The computed frequencies are 6.3 times the measured ones, about 2π: is one of them in rad/s"
    )
    assert hints(expected * turn)[0].startswith(
        "The computed frequencies are 0.16 times the measured ones, about 1/(2π)"
    )
    # another factor, several factors, and a mode that is not far
    for other in (expected / 3.0, expected / [turn, 3.0, turn], expected / [1.0, turn, turn], expected):
        assert hints(other) == []


def test_draws_at_which_the_model_fails_are_counted():
    problem = linear(model=Holey())
    found = prior_prediction(problem, draws=40)
    failed = int(np.sum(problem.sample_prior(np.random.default_rng(1), 40)[:, 0] > 1.5))
    assert 0 < failed == found.failed
    assert found.sentences()[0] == f"The model failed at {failed} of 40 prior draws."
    assert [found.doubts, found.sentences()[1][:16]] == [found.sentences()[:1], "The prior covers"]
    with pytest.raises(ValueError, match=r"draws: must be at least 2 \(got 1\)"):
        prior_prediction(problem, draws=1)


def test_all_of_it_in_words():
    found = check(fmu.cases.load("cantilever-young"))
    text = str(found)
    assert "300 free degrees of freedom, in 4 decoupled blocks of 50, 100, 100 and 50." in text
    assert (
        "the free degrees of freedom carry 2.44 kg in x, y and z"
    ) in text  # 0.5 × 0.06 × 0.01 × 7850 + 0.12, less what the clamp carries
    assert list(found.parameters["changes"]) == ["stiffness of 10 of 50 elements"] * 5
    assert "moves no sensor" in text
    assert "No warnings." in text
    assert found.sentences()[0] in text
    assert found.drawing.startswith("<svg")
    assert len(set(found.colours)) == 5
    assert "<svg" in found._repr_html_()


def test_of_several_tests_a_parameter_changes_what_that_of_the_structure_does():
    """Whatever test it is of, and where one is known in the first test."""
    model = shear_building(["k1", "k2"], mass_name="m")
    uncertain = [fmu.Parameter(name, 1.0, 0.5, 2.0) for name in ("k1", "k2", "m")]
    data = fmu.ModalData([0.1, 0.26], sd_hz=0.01)
    tests = [
        fmu.Test(name, data, known={"k1": 1.0} if name == "first" else {}) for name in ("first", "second", "third")
    ]
    varies = {"k1": "test", "k2": fmu.Population(), "m": fmu.Population()}
    problem = fmu.JointProblem(model, tests, uncertain, varies=varies, correlation=2.0, pairing="index")
    changes = dict(check(problem).parameters["changes"])
    assert list(changes) == [name for name in problem.names if "score" not in name]
    of = {"k1": "stiffness at 1 of 2", "k2": "stiffness at 2 of 2", "m": "mass at 2 of 2"}
    assert changes.pop("k2 m correlation") == ""
    assert changes == {name: f"{of[name.split()[0]]} degrees of freedom" for name in changes}


def test_a_model_without_matrices_and_a_name_that_is_html():
    problem = linear(measured=(103.0, 99.5, 120.0))
    problem.name = "<b>bold</b>"
    found = check(problem)
    assert found.drawing == ""
    assert [mode.number for mode in found.modes.modes] == [None] * 3
    assert len(found.doubts) == 1
    assert "Warnings\n  - Mode 3: measured at 120 Hz" in str(found)
    assert "number" not in found.mode_table()
    page = found._repr_html_()
    assert "&lt;b&gt;bold" in page
    assert "<b>" not in page


def function_of_storeys(theta):
    """The three masses as a function, all modes with their shapes, the highest first."""
    lam, phi = scipy.linalg.eigh(theta[0] * K1 + theta[1] * (K2 + K3), M)
    return {"frequencies": np.sqrt(lam[::-1]) / (2 * np.pi), "shapes": phi[:, ::-1]}


def test_a_function_with_shapes_says_which_of_its_modes_is_which():
    data = ModalData(EXACT[:2], sensors=SENSORS, shapes=SHAPES[:, :2], sd_hz=0.05)
    parameters = [Parameter(name, 1e4, 5e3, 2e4) for name in ("a", "b")]
    problem = UpdatingProblem(fmu.BlackBoxModel(function_of_storeys, 2), data, parameters)
    found = check(problem, draws=5)
    assert [found.modes.of(k).number for k in (0, 1)] == [3, 2]
    np.testing.assert_allclose(found.modes.table()["mac"][1:], 1.0)
    assert any("different orders" in doubt for doubt in found.doubts)  # those of the function, from the highest on
    assert "function_of_storeys" in found.model[0]
    assert found.gradient.agrees


def test_measured_shapes_that_a_function_cannot_use_are_told():
    def frequencies(theta):
        return function_of_storeys(theta)["frequencies"]

    data = ModalData(EXACT[:2], (3, 2), SENSORS, shapes=SHAPES[:, :2], sd_hz=0.05)
    parameters = [Parameter(name, 1e4, 5e3, 2e4) for name in ("a", "b")]
    found = initial_modes(UpdatingProblem(fmu.BlackBoxModel(frequencies, 2), data, parameters))
    assert "The measured shapes are not used: the function returns no shapes." in found.notes


@pytest.mark.parametrize(("factor", "side"), [(0.03, "high"), (30.0, "low")])
def test_one_factor_in_all_frequencies_is_told_as_one_of_units(factor, side):
    measured = EXACT[:2] * factor * np.array([1.05, 1.0])
    (said,) = initial_modes(storeys(measured, SHAPES[:, :2], SENSORS)).doubts
    assert said.startswith("All computed frequencies are ")
    assert f"times too {side}, and the shapes agree: look at the units of stiffness and mass." in said
    for other in (EXACT[:2] * 1.5, EXACT[:2] * [factor, 1.0]):
        assert not any("units" in one for one in initial_modes(storeys(other, SHAPES[:, :2], SENSORS)).doubts)


def test_sensors_have_the_names_of_their_places():
    """Of a frame in a file, whose nodes are numbered by fmu."""
    model = shear_building(["k1", "k2"], mass=[16.5e3, 16.1e3])
    model.place_names = {1: "roof"}
    data = ModalData([3.0, 9.8], sensors=[(0, "x"), (1, "-x")], shapes=[[0.6, 1.0], [-1.0, 0.6]], sd_hz=0.1)
    parameters = [Parameter(name, 3e7, 1e7, 6e7) for name in ("k1", "k2")]
    problem = UpdatingProblem(model, data, parameters, pairing="index")
    assert initial_modes(problem).correlation.sensors == ("0 x", "roof -x")
    assert "roof x" in modal_states(problem, {"start": problem.start})["place"]
    tests = [fmu.Test(name, data, masses={1: mass}) for name, mass in (("empty", 0.0), ("loaded", 3e3))]
    joint = fmu.JointProblem(model, tests, parameters, pairing="index", reduction=False)
    assert "roof -x" in modal_states(joint, {"start": joint.start})["sensor"]


def test_standard_deviations_that_are_inferred_are_parameters_too():
    model = storeys().model.structure
    sd = Parameter("sd", 0.05, 0.01, 0.2, unit="Hz")
    parameters = [Parameter(name, 1e4, 5e3, 2e4) for name in ("a", "b")]
    data = ModalData(EXACT[:2], sensors=SENSORS)
    errors = [fmu.FrequencyErrors("absolute", sd)]
    problem = UpdatingProblem(model, data, parameters, error=errors)
    found = check(problem, draws=200)
    assert list(found.parameters["changes"])[2] == "measurement errors"
    # uniform from 0.01 to 0.2: a mean square of (0.2³ − 0.01³)/(3 · 0.19)
    np.testing.assert_allclose(found.prior.noise_sd, np.sqrt((0.2**3 - 0.01**3) / 0.57), rtol=0.2)
    assert found.gradient.agrees
    assert found.identifiability.names == ("a", "b")


def test_a_problem_whose_gradient_is_no_number_is_doubtful():
    found = check(linear(model=Holey()), draws=20)
    assert found.identifiability is None
    assert "The gradient is not finite for a at the start." in found.doubts


def test_a_prior_that_misses_its_bounds_is_a_warning():
    """A mean left out; with it the warning is gone."""
    data = ModalData([101.0, 99.5, 102.0])
    for prior, is_doubted in ((fmu.Normal(0.1), True), (fmu.Normal(0.1, mean=1.0), False)):
        parameters = [Parameter(name, 1.0, 0.5, 1.5, prior) for name in ("a", "b")]
        found = check(UpdatingProblem(LinearModel(), data, parameters), draws=20)
        assert any("a and b are centred on 0" in doubt for doubt in found.doubts) == is_doubted
        assert ("presses the parameter against" in str(found)) == is_doubted


def test_assumptions_are_part_of_what_is_found():
    parameters = [Parameter(name, 1.0, 0.5, 1.5, fmu.Normal(0.1, mean=1.0)) for name in ("a", "b")]
    problem = UpdatingProblem(LinearModel(), ModalData([101.0, 99.5, 102.0], sd_hz=0.2), parameters)
    found = check(problem, draws=20)
    text = " ".join(str(found).split())
    assert all(sentence in text for sentence in found.assumptions.sentences)
    assert "Assumptions mode measured, Hz σ, Hz σ, % 1 101 0.2 0.2" in text
    assert "The model itself pairs its modes" in text
    assert "<h4>Assumptions</h4>" in found._repr_html_()


def test_what_is_no_problem():
    with pytest.raises(ValueError, match=r"problem: must be an UpdatingProblem \(got 3\)"):
        check(3)
    problem = linear(model=Holey())
    problem.start = np.array([1.8, 1.0])
    with pytest.raises(ValueError, match=r"start: the model must have frequencies there \(got \[1.8, 1.0\]\)"):
        check(problem)


@pytest.mark.parametrize(
    ("dofs", "said"),
    [
        (None, "the diagonal of the mass matrix is 47 kg"),
        (
            [["block", "x"], ["block", "y"], ["block", "z"]],
            "the free degrees of freedom carry 47 kg in x, y and z",
        ),
        ([["low", "x"], ["middle", "x"], ["top", "x"]], "the free degrees of freedom carry 141 kg in x"),
        (
            [["low", "x"], ["low", "y"], ["top", "y"]],
            "the free degrees of freedom carry 47 kg in x, 94 kg in y",
        ),
    ],
    ids=["without names", "one block", "three floors", "guided in x"],
)
def test_masses_of_different_directions_are_not_summed(dofs, said):
    """A block of 47 kg on three springs; three storeys of as much move together in their one direction."""
    named = None if dofs is None else [(node, direction) for node, direction in dofs]
    model = fmu.SeparableModel.from_terms(["k"], [(np.diag([1.0, 2.0, 3.0]), "k")], [47.0 * np.eye(3)], named)
    data = fmu.ModalData([5.0], sd_hz=0.1)
    parameters = [fmu.Parameter("k", 1e5, 1e4, 1e6)]
    problem = fmu.UpdatingProblem(model, data, parameters, pairing="index")
    assert said in " ".join(model_in_words(problem))
