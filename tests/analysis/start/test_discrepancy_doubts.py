"""What the check of a problem says about its discrepancies."""

import numpy as np
import pytest

import fmu
from tests.shear_building import frequencies_hz, shear_building, storey

NAMES = ("k1", "k2", "k3")
FREQUENCIES = np.array([0.07, 0.2, 0.29])


def doubts_of(discrepancy, model=None, errors=None, names=NAMES):
    parameters = [fmu.Parameter(name, 1.0, 0.3, 3.0) for name in names]
    problem = fmu.UpdatingProblem(
        shear_building(NAMES) if model is None else model,
        fmu.ModalData(FREQUENCIES),
        parameters,
        pairing="index",
        error=errors or fmu.FrequencyErrors("relative", sd=0.01),
        discrepancy=discrepancy,
    )
    return fmu.check(problem, draws=10).discrepancy


@pytest.mark.parametrize(
    "discrepancy",
    [(), fmu.Discrepancy(), fmu.Discrepancy(by="group"), (fmu.Discrepancy(), fmu.Discrepancy(kind="modes"))],
    ids=["none", "common", "by group", "both kinds"],
)
def test_nothing_is_said_about_what_the_data_tell(discrepancy):
    assert doubts_of(discrepancy) == ()


def test_a_parameter_that_changes_no_mode():
    """An element of two free nodes without mass has no effect on the modes of the building."""
    K = {name: storey(j, 3) for j, name in enumerate(NAMES)}
    terms = [(K[name], name) for name in NAMES] + [(1e-14 * K["k1"], "idle")]
    model = fmu.SeparableModel.from_terms([*NAMES, "idle"], terms, [np.eye(3)])
    (said,) = doubts_of(fmu.Discrepancy(tau=0.1), model, names=(*NAMES, "idle"))
    assert "idle changes no mode" in said


def test_two_that_give_the_same_errors():
    sigma = fmu.Parameter("sigma", 0.02, 1e-4, 0.2)
    (said,) = doubts_of(
        fmu.Discrepancy(kind="modes", correlation=0.0), errors=fmu.FrequencyErrors("relative", sd=sigma)
    )
    assert "sigma and model error cannot be told apart" in said
    twice = (fmu.Discrepancy(groups=("k1",)), fmu.Discrepancy(groups=("k1",), name="other"))
    (said,) = doubts_of(twice)
    assert "tau and other cannot be told apart" in said


def test_a_length_without_coordinates_or_shapes_has_no_effect():
    given = fmu.Discrepancy(kind="modes", sd=0.02, correlation=0.3, shape_sd=0.05, length=3.0)
    (said,) = doubts_of(given)
    assert "length has no effect, as no mode shapes are compared" in said
    dofs = [(i, "x") for i in range(3)]
    model = shear_building(NAMES, dofs=dofs)
    f, shapes = frequencies_hz(model, np.ones(3))
    data = fmu.ModalData(f, sd_hz=0.01 * f, shapes=shapes, sensors=tuple(dofs))
    parameters = [fmu.Parameter(name, 1.0, 0.3, 3.0) for name in NAMES]
    errors = [fmu.FrequencyErrors(), fmu.ShapeErrors(sd=0.02)]
    problem = fmu.UpdatingProblem(model, data, parameters, error=errors, discrepancy=given)
    (said,) = fmu.check(problem, draws=10).discrepancy
    assert "length has no effect, as the model has no coordinates of two sensors" in said


def test_errors_that_are_not_gaussian_are_named():
    with pytest.raises(ValueError, match=r"needs Gaussian errors .* \(got StudentErrors\)"):
        doubts_of(fmu.Discrepancy(), errors=fmu.StudentErrors("relative", sd=0.01))
