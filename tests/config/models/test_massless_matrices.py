"""A structure whose rotations have no mass, as structural programs export it: from the file to the certificate."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import fmu
from tests.fem.modes.massless_bridge import LOWER, START, UPPER, bridge, condensed
from tests.matrix_files import write_matrix

TRUE = np.array([1.95e11, 2.1e11, 1.1])


@pytest.fixture
def problem(tmp_path, monkeypatch):
    monkeypatch.setenv("FMU_CACHE_DIR", str(tmp_path / "cache"))
    model = bridge(7)
    tables = []
    for kind, terms in (("stiffness", model.K_terms), ("mass", model.M_terms)):
        for i, term in enumerate(terms):
            write_matrix(tmp_path / f"{kind}{i}.mtx", term.matrix)
            powers = ", ".join(f"p{j} = {power}" for j, power in enumerate(term.powers) if power)
            tables.append(f'[[model.{kind}]]\nfile = "{kind}{i}.mtx"\npowers = {{ {powers} }}')
    parameters = [
        f'[[parameters]]\nname = "p{j}"\nstart = {START[j]}\nlower = {LOWER[j]}\nupper = {UPPER[j]}\n'
        f'prior = {{ distribution = "normal", mean = {START[j]}, sd = {0.05 * START[j]} }}'
        for j in range(3)
    ]
    measured = np.sqrt(condensed(model, TRUE, 5)[0]) / (2 * np.pi)
    dofs = ", ".join(f'[{node}, "{direction}"]' for node, direction in model.dofs)
    text = [
        'name = "bridge"\npairing = "index"',
        f'[model]\ntype = "matrices"\ndofs = [{dofs}]',
        *tables,
        *parameters,
        f"[measurement]\nfrequencies = {measured.tolist()}\nsd = {(0.003 * measured).tolist()}",
    ]
    path = tmp_path / "bridge.toml"
    path.write_text("\n\n".join(text), encoding="utf-8")
    return fmu.load(path)


@pytest.mark.usefixtures("certified")
def test_from_the_file_to_the_certificate(problem):
    exact = np.sqrt(condensed(bridge(7), START, 5)[0]) / (2 * np.pi)
    assert_allclose(problem.frequencies(START), exact, rtol=1e-6)
    assert problem.model.sizes
    trace = fmu.sample(problem, "hmc", draws=60, warmup=60, chains=2, seed=1)
    assert trace.attrs["certificate_draws"] >= 16
    assert 0 < trace.attrs["certificate_frequency_error"] <= 1e-6
    assert trace.attrs["certificate_log_prob_error"] <= 1e-3
    assert_allclose(trace["posterior"]["p0"].mean() / TRUE[0], 1.0, atol=0.05)
