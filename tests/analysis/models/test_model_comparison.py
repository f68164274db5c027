"""Models of the same data side by side: evidences against quadrature, modes left out, and what is refused."""

import numpy as np
import pytest
from scipy.special import logsumexp

import fmu
from fmu.analysis.models.comparison import NO_ESTIMATE, compare_traces, require_same_data, standard_error
from tests import measured_frfs
from tests.shear_building import frequencies_hz, shear_building

STOREYS = ["k1", "k2", "k3", "k4", "k5"]
RIGHT, WRONG = np.ones(5), np.array([1.0, 1.4, 0.8, 1.2, 0.7])
EMBEDDED = fmu.Discrepancy(prior_sd=0.2)

pytestmark = pytest.mark.usefixtures("refits")


def problem_of(truth, discrepancy=(), kind="relative", sd=0.005, **more):
    """Return a model of equal storeys, updated with frequencies of a structure of stiffnesses `truth`."""
    rng = np.random.default_rng(3)
    measured = frequencies_hz(shear_building(STOREYS), truth)[0] * (1.0 + sd * rng.standard_normal(5))
    return fmu.UpdatingProblem.reduced(
        shear_building(["k"] * 5),
        fmu.ModalData(measured, **more),
        [fmu.Parameter("k", 1.0, 0.2, 3.0)],
        pairing="index",
        error=fmu.FrequencyErrors(kind, sd=sd),
        discrepancy=discrepancy,
    )


def sampled(problem):
    return fmu.sample(problem, draws=100, warmup=60, maxima=fmu.find_map(problem, starts=2))


def log_evidence(problem):
    """Return the logarithm of the evidence by the midpoint rule, where all of the probability is."""
    ends = np.array([[0.6, 1.5], [0.0, 1.5]])[: problem.ndim]
    n = {1: [2000], 2: [150, 100]}[problem.ndim]
    sides = [low + (high - low) * (np.arange(k) + 0.5) / k for (low, high), k in zip(ends, n, strict=True)]
    grid = np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, problem.ndim)
    cell = np.prod(np.diff(ends, axis=1)[:, 0] / n)
    return logsumexp(problem.log_prob(grid)) + np.log(cell)


@pytest.fixture(scope="module")
def wrong():
    """Return both models of a wrong structure, and their traces."""
    problems = {"rigid": problem_of(WRONG), "embedded": problem_of(WRONG, EMBEDDED)}
    return problems, {name: sampled(one) for name, one in problems.items()}


@pytest.fixture(scope="module")
def right():
    problems = {"rigid": problem_of(RIGHT), "embedded": problem_of(RIGHT, EMBEDDED)}
    return fmu.compare_models({name: sampled(one) for name, one in problems.items()})


def test_the_difference_of_evidences_is_that_of_quadrature(wrong):
    problems, traces = wrong
    table = fmu.compare_models(traces).table
    for name, problem in problems.items():
        expected = log_evidence(problem)
        assert abs(table["log_evidence"][name] - expected) < 5 * table["error"][name] + 1e-3
    assert table["difference"].max() == 0.0
    assert table["probability"].sum() == pytest.approx(1.0)
    odds = np.log(table["probability"]["embedded"]) - table["difference"]["embedded"]
    assert odds == pytest.approx(-np.log1p(np.exp(table["difference"]["rigid"])))


def test_a_wrong_model_is_said_to_need_the_discrepancy(wrong):
    found = fmu.compare_models(wrong[1])
    assert found.table["probability"]["embedded"] > 0.999
    assert "times as probable under embedded as under rigid" in found.sentences[0]
    assert found.table["inside"]["embedded"] > found.table["inside"]["rigid"]
    assert found.table["sum_z2"]["rigid"] > 50 > 20 > found.table["sum_z2"]["embedded"]
    assert found.table["verdict"]["rigid"].startswith("contradicted")
    assert found.table["p"]["rigid"] < 1e-6 < 0.01 < found.table["p"]["embedded"]
    assert any("embedded predicts the modes best" in one for one in found.sentences)
    assert "embedded" in str(found)
    assert "<li>" in found._repr_html_()


def test_a_right_model_is_not(right):
    assert right.table["probability"]["rigid"] > 0.6
    assert "times as probable under rigid as under embedded" in right.sentences[0]
    assert "clearly better than rigid" not in " ".join(right.sentences).replace("not clearly", "")
    assert right.table["held_out"].tolist() == [5, 5]
    assert right.table["sum_z2"]["rigid"] < 20.5  # exceeded once in a thousand


def test_modes_left_out_are_counted_from_the_table_of_the_trace(wrong):
    _, traces = wrong
    table, found = fmu.leave_one_out(traces["rigid"]), fmu.compare_models(traces).table.loc["rigid"]
    z = ((table["measured"] - table["mean"]) / table["sd"]).to_numpy()
    assert found["sum_z2"] == pytest.approx(np.sum(z**2))
    assert found["elpd"] == pytest.approx(table["elpd"].sum())
    assert found["elpd_se"] == pytest.approx(np.sqrt(5) * np.std(table["elpd"], ddof=1))
    assert np.isnan(standard_error([1.0]))


def test_the_same_model_twice_makes_no_difference(wrong):
    traces = {"one": wrong[1]["rigid"], "two": wrong[1]["rigid"]}
    assert "do not differ by more than their errors" in fmu.compare_models(traces).sentences[0]


@pytest.mark.parametrize(
    ("other", "words"),
    [
        (lambda: problem_of(RIGHT), "different: frequencies"),
        (lambda: problem_of(WRONG, labels=("a", "b", "c", "d", "e")), "different: modes"),
        (lambda: problem_of(WRONG).using(["1", "2"]), "different: modes used in updating"),
        (lambda: problem_of(WRONG, kind="eigenvalue"), "different: unit of the errors"),
    ],
)
def test_models_of_other_data_are_refused(wrong, other, words):
    problem = other()
    trace = fmu.sample(problem, "mh", draws=10, warmup=10, chains=2, maxima=fmu.find_map(problem, starts=1))
    with pytest.raises(ValueError, match="must have the same data as rigid, or the evidences") as error:
        fmu.compare_models({"rigid": wrong[1]["rigid"], "other": trace})
    assert error.value.key == "models.other"
    assert words in str(error.value)
    require_same_data(wrong[1])


def test_models_of_other_frfs_are_refused():
    one, other = (
        fmu.sample(one, "mh", draws=5, warmup=5, chains=2, init="start", maxima=fmu.find_map(one, starts=1))
        for one in (measured_frfs.problem(seed=0), measured_frfs.problem(seed=1))
    )
    require_same_data({"one": one, "same": one})
    with pytest.raises(ValueError, match="different: values of FRFs used in updating"):
        require_same_data({"one": one, "other": other})
    without = one.filter(lambda node: node.name != "frfs")
    with pytest.raises(
        ValueError, match=r"different: FRFs and values of FRFs used in updating \(got \['2 x / 2 x'"
    ):
        require_same_data({"without": without, "one": one})


def test_a_problem_is_sampled(wrong, monkeypatch):
    """As by `fmu.sample`, from fewer starts and for fewer draws."""
    given = []

    def short(problem, **options):
        given.append(options)
        return fmu.sample(problem, draws=150, warmup=60, maxima=fmu.find_map(problem, starts=4), **options)

    monkeypatch.setattr("fmu.sampling.models.sample", short)
    found = fmu.compare_models({"rigid": wrong[0]["rigid"], "embedded": wrong[1]["embedded"]}, until_ess=50).table
    assert given == [{"until_ess": 50, "seed": 1}]
    assert found["converged"]["rigid"]
    known = fmu.compare_models(wrong[1]).table["log_evidence"]["rigid"]
    assert abs(found["log_evidence"]["rigid"] - known) < 5 * found["error"]["rigid"] + 0.05


def test_one_model_or_none_is_refused(wrong, monkeypatch):
    for models in ({}, {"rigid": wrong[1]["rigid"]}):
        with pytest.raises(ValueError, match=r"models: must be two or more \(got [01]\)"):
            fmu.compare_models(models)
    with pytest.raises(ValueError, match=r"models\.b: must be a trace"):
        compare_traces({"a": wrong[1]["rigid"], "b": "no trace"})
    monkeypatch.setattr("fmu.sampling.models.sample", lambda *_, **__: pytest.fail("it was sampled"))
    with pytest.raises(ValueError, match=r"models: must be two or more \(got 1\)"):
        fmu.compare_models({"rigid": wrong[0]["rigid"]})


def test_an_evidence_that_no_sampler_estimates_is_missing_with_its_reason(wrong):
    trace = fmu.sample(problem_of(WRONG), "mh", draws=20, warmup=20, init="prior", jumps=False)
    trace = trace.filter(lambda node: node.name != "maxima")
    found = fmu.compare_models({"rigid": trace, "embedded": wrong[1]["embedded"]})
    assert np.isnan(found.table["log_evidence"]["rigid"])
    assert np.isnan(found.table["probability"]["rigid"])
    assert f"rigid has no evidence: {NO_ESTIMATE}." in found.sentences
