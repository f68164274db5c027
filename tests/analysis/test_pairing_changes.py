"""How the pairing changed over a run: counted again from the model, and told in words."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import fmu
from fmu.analysis.trace.conversion import save_trace
from fmu.analysis.trace.reading import parameter_draws
from fmu.report.run import runs_of
from fmu.report.sections import structure
from tests.veering import veering_problem


def crossing_problem(pairing):
    """Two masses without any link: their frequencies cross, their shapes stay."""
    e = np.eye(2)
    K = [fmu.Term(1e3 * np.outer(e[k], e[k]), tuple(e[k])) for k in range(2)]
    model = fmu.SeparableModel(K, [fmu.Term(np.eye(2), (0.0, 0.0))])
    data = fmu.ModalData([5.0, 5.1], sensors=((0, "x"), (1, "x")), labels=("A", "B"), sd_hz=0.1)
    parameters = [fmu.Parameter(f"k{k}", start, 0.8, 1.3) for k, start in ((1, 0.9), (2, 1.0))]
    return fmu.UpdatingProblem.reduced(model, data, parameters, pairing=pairing)


def sampled(problem, **options):
    return fmu.sample(problem, "slice", chains=2, **({"draws": 300, "warmup": 100} | options))


@pytest.fixture(scope="module")
def veering():
    problem = veering_problem()
    return problem, sampled(problem)


def test_jumps_are_those_of_the_model(veering):
    problem, trace = veering
    theta = parameter_draws(trace).reshape(-1, 2)
    rank = problem.model.truth.modes(theta).rank
    best = rank[np.argmax(trace["sample_stats"]["lp"].to_numpy())]
    found = fmu.pairing_changes(trace)
    assert found.rule == "shape"
    assert not found.constant
    assert found.project == len(theta)
    assert 0 < found.jumps == np.sum(np.any(rank != best, axis=1)) < len(theta)
    assert_allclose(found.changed, np.mean(rank != best, axis=0))
    f = problem.frequencies(theta)
    assert_allclose(found.swapped[0, 1], np.mean(f[:, 1] < f[:, 0]))
    assert_array_equal(found.swapped, found.swapped.T)


def test_the_nearest_candidate_is_searched_among_all(veering):
    problem, trace = veering
    theta = parameter_draws(trace).reshape(-1, 2)
    links = np.array([[0.02, -0.02, 0], [-0.02, 0.12, -0.1], [0, -0.1, 0.1]])
    matrices = [1e3 * (links + np.diag([*point, 9.0])) for point in theta]
    f = np.sqrt(np.linalg.eigvalsh(matrices)) / (2 * np.pi)
    first = np.isclose(problem.frequencies(theta)[:, 0], f[:, 0], rtol=1e-9)
    own, other = np.where(first, f[:, 0], f[:, 1]), np.where(first, f[:, 1], f[:, 0])
    gap = np.minimum(np.abs(other / own - 1), f[:, 2] / own - 1).min()
    assert_allclose(fmu.pairing_changes(trace).gap[0], gap, rtol=1e-5)


def test_in_words_and_in_the_verdict_on_the_model(veering):
    found = fmu.pairing_changes(veering[1])
    share = f"{100 * found.changed[0]:.2g} %"
    assert found.sentences()[0] == (
        f"Mode 1 is not paired with the same computed mode as at the most probable draw in {share} of 600 draws "
        "examined: the log-probability jumps there if the two modes veer, but not if they cross without mixing."
    )
    assert any(sentence.startswith("Modes 1 and 2 are in reversed order in ") for sentence in found.sentences())
    assert list(found.table()["swapped_with"]) == ["2", "1"]
    assert "<li>Mode 1 is not paired with the same computed mode" in found._repr_html_()
    warnings = fmu.diagnose(veering[1]).warnings
    assert any(warning.startswith("the pairing by MAC changes in ") for warning in warnings)


def test_a_file_and_a_report_keep_it(veering, tmp_path):
    trace = fmu.load_trace(save_trace(veering[1], tmp_path / "trace.nc"))
    assert fmu.pairing_changes(trace).sentences() == fmu.pairing_changes(veering[1]).sentences()
    section = structure.pairing(runs_of({"slice": trace})["slice"])
    assert section.parts[0].items == fmu.pairing_changes(trace).sentences()
    assert section.parts[1].parts[0].rows[0][2] == "2"


def test_frequencies_that_cross_are_no_change_of_the_mode():
    """Each block has its mode; they swap their order, and nothing jumps."""
    trace = sampled(crossing_problem("shape"), draws=100, warmup=50)
    found = fmu.pairing_changes(trace)
    assert found.constant
    assert found.jumps == 0
    assert_array_equal(found.changed, [0.0, 0.0])
    assert 0.05 < found.swapped[0, 1] < 0.95
    assert trace["pairing"].sizes["sample"] == 1
    f = trace["posterior_predictive"]["model_frequency"].to_numpy().reshape(-1, 2)
    assert_allclose(found.gap[0], np.min(np.abs(f[:, 1] / f[:, 0] - 1)))
    assert not any("pairing" in warning for warning in fmu.diagnose(trace).warnings)


def test_by_number_the_order_stays_and_the_mode_changes():
    found = fmu.pairing_changes(sampled(crossing_problem("index"), draws=50, warmup=20))
    assert found.swapped[0, 1] == 0
    assert found.jumps > 0
    assert "the log-probability has a kink there" in found.sentences()[0]


def test_at_most_so_many_draws_are_looked_at(monkeypatch):
    monkeypatch.setattr("fmu.analysis.pairing_changes.MOST_DRAWS", 50)
    trace = sampled(veering_problem(), draws=50, warmup=20)
    kept = trace["pairing"]
    assert kept.sizes["sample"] in (50, 51)
    lp = trace["sample_stats"]["lp"].to_numpy()
    highest = np.unravel_index(np.argmax(lp), lp.shape)
    at = kept.attrs["most_probable"]
    assert (int(kept["chain"][at]), int(kept["draw"][at])) == highest


def test_a_model_that_does_not_tell_its_modes(problem):
    trace = fmu.sample(problem, "slice", draws=40, warmup=20, chains=2)
    found = fmu.pairing_changes(trace)
    assert found.rule is None
    assert np.all(np.isnan(found.changed))
    assert len(found.sentences()) == 2


def test_what_is_no_trace_of_an_updating_problem(make_trace):
    with pytest.raises(ValueError, match=r"^trace: must be of an updating problem"):
        fmu.pairing_changes(make_trace(np.random.default_rng(1).standard_normal((2, 10, 2))))
