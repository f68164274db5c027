"""Errata and recomputed frequencies come out of the tables and the model, not out of the text."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import scipy.linalg as sl

from fmu import cases
from fmu.paper import spectrum
from fmu.paper.errata import (
    computed_errata,
    conclusions,
    count_reproduced,
    errata_page,
    recompute,
    recomputed_page,
)
from fmu.paper.published import EXPERIMENTS
from fmu.paper.run import separated_modes
from tests import cantilever


@pytest.fixture(scope="module")
def by_number():
    return {case: cases.load(case, "index") for case in EXPERIMENTS}


@pytest.fixture(scope="module")
def by_shape():
    return {case: cases.load(case, "shape") for case in EXPERIMENTS}


@pytest.fixture(scope="module")
def errata(by_number, by_shape):
    return computed_errata(by_number, by_shape, 2**10)


def found(errata, place):
    (erratum,) = (e for e in errata if e.place == place)
    return erratum


def test_mode_pairing(errata):
    erratum = found(errata, "Table 2, mode 4")
    assert "1237.2 Hz" in erratum.printed
    assert "14.32 %" in erratum.printed
    model = cantilever.beam(1, 2.4e11).separable()
    here = [i for i, (_, direction) in enumerate(model.dofs) if direction in ("z", "ry")]
    K, M = (matrix([]).toarray()[np.ix_(here, here)] for matrix in (model.K, model.M))
    fourth = np.sqrt(sl.eigh(K, M, eigvals_only=True)[3]) / (2 * np.pi)
    assert f"W4 ({fourth:.2f} Hz, error {100 * (fourth / 1082.2 - 1):.2f} %)" in erratum.found
    assert "S2 (1237.16 Hz)" in erratum.found
    assert "W1 S1 W2 T1 W3 W4 S2 T2 W5" in erratum.evidence


def test_numbers_that_are_more_than_one_mode(errata):
    places = [e.place for e in errata if e.place.startswith("Section 5.2, mode")]
    assert places == [f"Section 5.2, mode {k}" for k in (2, 3, 4, 5)]
    seventh = found(errata, "Section 5.2, mode 4")
    assert "S2 in 5" in seventh.found
    assert "W4 in 4" in seventh.found
    assert "M-H Method: W4, Slice Sampling Method: S2, HMC Method: W4" in seventh.evidence


def test_shares_over_the_box(by_number):
    shares = spectrum.shares_over_the_box(by_number["cantilever-section"], 2**12)
    assert shares[0] == {"W1": 1.0}
    assert shares[1]["S1"] == pytest.approx(0.167, abs=0.005)
    assert shares[3]["S2"] == pytest.approx(0.59, abs=0.02)
    assert shares[3]["W4"] == pytest.approx(0.41, abs=0.02)
    assert sum(shares[4].values()) == pytest.approx(1.0)
    young = spectrum.shares_over_the_box(by_number["cantilever-young"], 2**12)
    assert young[3] == {"S2": 1.0}
    assert young[1]["S1"] == pytest.approx(0.004, abs=0.003)


def test_table_3_as_printed_and_as_meant(errata):
    erratum = found(errata, "Table 3, Initial")
    assert erratum.printed == "Ix1 = 5e-9, Ix2 = 5e-9"
    assert erratum.found == "Ix1 = 7e-9, Ix2 = 7e-9"
    assert "32.00, 203.55, 575.69, 1136.80, 1889.59 Hz" in erratum.evidence
    assert "27.05, 172.05" in erratum.evidence


def test_parameter_outside_its_bounds(errata):
    erratum = found(errata, "Table 3, Slice Sampling Method, Ix1")
    assert erratum.printed == "7.88e-9"
    assert "[3.5e-9, 7.5e-9]" in erratum.found


def test_misprints_of_table_4(errata):
    frequency = found(errata, "Table 4, Slice Sampling Method, mode 2")
    assert frequency.printed == "183.3 Hz, error 7.1 %"
    assert frequency.found == "183.85 Hz"
    assert "183.90 Hz" in frequency.evidence
    error = found(errata, "Table 4, Initial, error of mode 2")
    assert (error.printed, error.found) == ("2.58 %", "2.830 %")
    assert "2.804 to 2.855" in error.evidence
    assert found(errata, "Table 4, Initial, error of mode 5").found == "6.068 %"
    assert len([e for e in errata if "error of mode" in e.place]) == 2


@pytest.mark.parametrize(
    ("case", "mean"), [("cantilever-young", (2.83, 2.97, 3.58)), ("cantilever-section", (1.13, 2.40, 1.11))]
)
def test_conclusions_depend_on_the_measure(errata, case, mean):
    """Both measures are of the numbers printed, of which one frequency is a misprint."""
    experiment = EXPERIMENTS[case]
    erratum = found(errata, f"Section {experiment.section}, abstract and section 6, results of the samplers")
    for k, name in enumerate(("mh", "slice", "hmc")):
        column = experiment.columns[name]
        assert np.mean([float(e.digits) for e in column.errors]) == pytest.approx(mean[k], abs=0.005)
        assert f"{column.title} {mean[k]:.2f} %" in erratum.evidence
        sum_hz2 = np.sum((column.meant_hz - np.array([31.9, 197.9, 553.0, 1082.2, 1781.5])) ** 2)
        assert f"{column.title} {sum_hz2:.0f} Hz²" in erratum.evidence
    contradicted = erratum.found.split(": ")[1].split("; ")
    if case == "cantilever-young":
        assert contradicted == ["HMC is not better than slice sampling by the mean error"]
    else:
        assert contradicted == ["MH is not better than slice sampling by Σ(f − f_m)²"]


def test_a_conclusion_that_every_measure_confirms_is_no_erratum():
    experiment = EXPERIMENTS["cantilever-section"]
    columns = {**experiment.columns, "slice": experiment.columns["initial"]}
    assert list(conclusions(replace(experiment, columns=columns))) == []


def test_the_prior_as_printed_contradicts_its_constant():
    """Equation (7) is the integral of Σ α_i E_i²/2, not of Σ α_i ‖E‖²/2."""
    alpha, x = np.array([1.0, 4.0]), np.linspace(-10, 10, 801)
    a, b = np.meshgrid(x, x)
    area = (x[1] - x[0]) ** 2
    constant = 2 * np.pi / np.sqrt(alpha.prod())
    by_component = np.sum(np.exp(-(alpha[0] * a**2 + alpha[1] * b**2) / 2)) * area
    as_printed = np.sum(np.exp(-alpha.sum() * (a**2 + b**2) / 2)) * area
    assert by_component == pytest.approx(constant)
    assert as_printed == pytest.approx(2 * np.pi / alpha.sum())
    assert as_printed < 0.5 * constant


def test_errata_follow_the_model(by_number, by_shape, monkeypatch):
    """With another model the findings are others: nothing of them is typed in."""
    problem = cases.load("cantilever-young", "shape")
    monkeypatch.setattr(problem, "frequencies", lambda theta: np.array([1.0, 2.0, 3.0, 1000.0, 5.0]))
    changed = computed_errata(by_number, {**by_shape, "cantilever-young": problem}, 2**4)
    assert "W4 (1000.00 Hz, error 7.60 %)" in found(changed, "Table 2, mode 4").found


def test_page(errata):
    page = errata_page(errata, "so many")
    assert page.count("\n| ") >= len(errata)
    for words in ("step 3", "step 4", "Section 4.3", "(15)", "(9)", "(3)", "(6) to (8)", "(2π/Σα_i)^(n/2)"):
        assert words in page


def test_separated_modes_are_an_erratum_of_the_comparison(findings):
    columns = {"log_prob": [-40.4, -107.9, -9e4], "modes": ["S1", "W2", "T1"], "starts": [1, 9, 2]}
    maxima = pd.DataFrame(columns, index=[1, 2, 3]).assign(share=[1.0, 0.0, 0.0])
    run = findings.one_start._replace(rhat=1.0004, off=219.6)
    by_number = replace(findings, pairing="index", maxima=maxima, one_start=run)
    (erratum,) = separated_modes(by_number)
    assert "2 separated maxima" in erratum.found
    assert "67.5 lower" in erratum.found
    assert "12 points" in erratum.evidence
    assert "R-hat 1.0004, worst mean 219.6 posterior standard deviations off" in erratum.evidence
    assert list(separated_modes(findings)) == []


def test_all_forty_frequencies_recomputed(by_number):
    table = recompute(by_number)
    assert len(table) == 40
    assert table["within"].all()
    row = table[(table["table"] == 2) & (table["column"] == "HMC Method") & (table["mode"] == "4")].iloc[0]
    theta = np.array([1.727, 2.344, 1.838, 2.052, 2.004]) * 1e11
    expected = by_number["cantilever-young"].frequencies(theta)[3]
    assert row["model_hz"] == pytest.approx(expected)
    assert row["difference_hz"] == pytest.approx(expected - 1099.99)
    assert row["tolerance_hz"] == pytest.approx(0.005 + 1.09999)
    misprint = table[table["remark"].str.contains("misprint")].iloc[0]
    assert (misprint["printed_hz"], misprint["meant_hz"]) == ("183.3", 183.85)
    assert count_reproduced(table) in recomputed_page(table)


def test_what_is_reproduced_only_with_a_correction_is_told(by_number):
    """The misprint and the column whose inputs are misprinted: none of the six agrees as printed."""
    assert count_reproduced(recompute(by_number)) == (
        "34 of 40 published frequencies come out of one model as printed; 5 more from corrected inputs (Table 4, "
        "Initial: Ix1 = 7e-9, printed 5e-9, Ix2 = 7e-9, printed 5e-9); 1 more against the frequency that its "
        "error column means (Table 4, Slice Sampling Method, mode 2: 183.85 Hz, printed 183.3 Hz)"
    )


def test_a_wrong_model_fails_the_recomputation(by_number, monkeypatch):
    problem = cases.load("cantilever-section", "index")
    right = problem.frequencies
    monkeypatch.setattr(problem, "frequencies", lambda theta: 1.005 * right(theta))
    table = recompute({**by_number, "cantilever-section": problem})
    assert not table["within"].all()
    assert table["within"][table["table"] == 2].all()
    page = recomputed_page(table)
    assert "**no**" in page
    failed = int((~table["within"]).sum())
    assert f"**{failed} not**" in page
    assert "34 of 40" not in page


def test_names_need_planes_that_do_not_couple(by_number):
    with pytest.raises(ValueError, match="structure of beam elements"):
        spectrum.paired_names(SimpleNamespace(model=SimpleNamespace(truth=None, name="f")), np.zeros((1, 1)))
