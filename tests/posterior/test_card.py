"""What a problem shows of itself in a notebook."""

import re
from dataclasses import replace

import numpy as np
import pytest

import fmu
from fmu.fem.modes.separable import SeparableModel


@pytest.fixture(scope="module")
def young():
    return fmu.cases.load("cantilever-young")


def cells(html):
    rows = re.findall(r"<tr>(.*?)</tr>", html)
    return [
        [re.sub(r"<[^>]*>|&#9632;", "", cell).strip() for cell in re.findall(r"<t[hd]>(.*?)</t[hd]>", r)]
        for r in rows
    ]


def test_parameters_with_bounds_and_priors(young):
    table = cells(young._repr_html_())
    assert table[0] == ["parameter", "unit", "start", "lower", "upper", "prior, cut off at the bounds"]
    assert table[1] == ["E1", "GPa", "240", "170", "250", "normal, mean 0, sd 200"]
    assert [row[0] for row in table[1:6]] == list(young.names)


def test_measured_modes_beside_the_initial_ones(young):
    table = cells(young._repr_html_())
    assert table[6] == ["mode", "measured, Hz", "its sd, Hz", "at the start, Hz", "error"]
    initial = young.frequencies(young.start)
    assert table[7] == ["1", "31.9", "0.707", f"{initial[0]:.2f}", f"{100 * (initial[0] / 31.9 - 1):+.2f} %"]
    assert len(table) == 12


def test_size_and_drawing(young):
    html = young._repr_html_()
    assert "300 degrees of freedom in 4 decoupled blocks; modes are paired by shape (MAC)." in html
    assert re.search(r"A reduced model with \d+ unknowns is used within the bounds", html)
    assert html.count("<svg") == 1
    assert html.count("&#9632;") == 5


def test_matrices_without_a_place_are_not_drawn(young):
    whole = young.model.structure
    bare = SeparableModel(whole.K_terms, whole.M_terms, whole.dofs)
    problem = fmu.UpdatingProblem(bare, young.data, young.parameters, pairing="index")
    html = problem._repr_html_()
    assert "<svg" not in html
    assert "&#9632;" not in html
    assert "paired by number in the spectrum." in html
    assert "reduced" not in html


class Spectrum:
    """A model that is not made of matrices."""

    n_parameters, n_modes = 1, 2

    def frequencies(self, theta):
        return np.sqrt(theta) * [1.0, 2.0]


def test_names_are_shown_and_not_run():
    parameter = fmu.Parameter("<script>alert(1)", start=4.0, lower=1.0, upper=9.0, unit="<b>")
    data = fmu.ModalData([2.0, 4.2], labels=("<i>", "&"))
    problem = fmu.UpdatingProblem.reduced(Spectrum(), data, [parameter], name="<img src=x>")
    html = problem._repr_html_()
    assert not re.search(r"<(script|b|i|img)\b", html)
    assert "&lt;script&gt;" in html
    assert "Model: Spectrum, 2 modes." in html
    assert ["&lt;i&gt;", "2", "0.707", "2.00", "0 %"] in cells(html)
    assert "uniform" in html


def test_unbounded_parameters(young):
    free = [replace(p, lower=-np.inf, upper=np.inf) for p in young.parameters]
    problem = fmu.UpdatingProblem(young.model.structure, young.data, free)
    assert cells(problem._repr_html_())[1][3:5] == ["-∞", "∞"]


def test_inferred_errors_come_after_what_is_drawn(young):
    data = replace(young.data, sd_hz=0.1 * np.arange(1, 6))
    scatter = fmu.Parameter("scatter", 0.01, 1e-4, 0.1, fmu.LogNormal(0.01, 0.5))
    errors = [fmu.FrequencyErrors(model_sd=scatter)]
    model = young.model.structure
    problem = fmu.UpdatingProblem(model, data, young.parameters, error=errors)
    html = problem._repr_html_()
    table = cells(html)
    assert [row[0] for row in table[1:7]] == [*young.names, "scatter"]
    assert html.count("&#9632;") == 5
    assert [row[2] for row in table[8:]] == ["0.1", "0.2", "0.3", "0.4", "0.5"]
