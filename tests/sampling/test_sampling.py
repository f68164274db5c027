import json
import subprocess
import sys

import numpy as np
import pytest

import fmu
from fmu import samplers
from fmu.analysis.convergence import effective
from fmu.analysis.trace.reading import parameter_draws
from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.parameters import Parameter
from fmu.posterior.priors.base import Normal
from fmu.posterior.problem import UpdatingProblem
from fmu.progress.phases import solves
from fmu.runs.maxima import keep_maxima, kept_maxima
from fmu.sampling import SAMPLERS
from tests.linear import SLOPES, LinearModel

SIGMA = np.sqrt(0.5)  # β = 1
OF_ONE_TEST = [name for name in SAMPLERS if name != "gibbs"]  # which samples populations over several tests


def linear():
    parameters = [Parameter("a", start=0.5, prior=Normal(1.0)), Parameter("b", start=0.0, prior=Normal(2.0))]
    return UpdatingProblem(LinearModel(), ModalData([101.0, 99.5, 102.0]), parameters, name="linear")


@pytest.fixture(scope="module")
def problem():
    """Return a problem that keeps its maxima, so that they are searched for once."""
    return linear()


def exact_posterior():
    precision = SLOPES.T @ SLOPES / SIGMA**2 + np.diag([1.0, 0.25])
    mean = np.linalg.solve(precision, SLOPES.T @ (np.array([101.0, 99.5, 102.0]) - 100) / SIGMA**2)
    return mean, np.sqrt(np.diag(np.linalg.inv(precision)))


@pytest.mark.parametrize(
    ("name", "settings", "draws"),
    [
        pytest.param(
            "mh", samplers.MetropolisHastings(samplers.RandomWalk(0.15)), 3000, marks=pytest.mark.validate
        ),
        pytest.param("slice", samplers.Slice(), 2000, marks=pytest.mark.validate),
        ("hmc", samplers.HamiltonianMonteCarlo(step_size=0.1, n_steps=6), 300),
        pytest.param("emcee", samplers.Ensemble(walkers=12), 500, marks=pytest.mark.validate),
    ],
)
def test_posterior_of_a_linear_model(problem, name, settings, draws):
    trace = fmu.sample(problem, settings, draws=draws, warmup=200, seed=3)
    table = fmu.summary(trace)
    mean, sd = exact_posterior()
    assert table["ess_bulk"].min() > 200
    assert np.all(np.abs(table["mean"] - mean) < 5 * table["mcse_mean"])
    np.testing.assert_allclose(table["sd"], sd, rtol=5 / np.sqrt(2 * table["ess_bulk"].min()))
    assert trace.attrs["sampler"] == name


@pytest.mark.parametrize("name", OF_ONE_TEST)
def test_cost_in_the_trace_is_what_the_model_was_asked(name):
    problem = linear()
    maxima = fmu.find_map(problem)
    searched = len(problem.model.given.asked)
    trace = fmu.sample(problem, name, draws=30, warmup=20, seed=3, init="prior", maxima=maxima)
    walkers = trace.attrs["walkers"]
    assert trace["posterior"].sizes == {"chain": 4, "draw": 30 * walkers}
    assert trace["warmup_posterior"].sizes == {"chain": 4, "draw": 20 * walkers}
    path = trace["posterior"].to_dataset().to_array().to_numpy().reshape(2, 4, 30, walkers)
    distinct = 4 * walkers + np.any(path[:, :, 1:] != path[:, :, :-1], axis=0).sum()
    sampling = trace.attrs["n_solves"] + trace.attrs["warmup_n_solves"]
    beside = 5  # before and after updating and at the maximum; derivatives before it and at the maximum
    for_timing = len(problem.model.given.asked) - searched - sampling - distinct - beside
    gradients = trace.attrs["n_gradients"]  # the mixture takes a few, or none in so short a run
    assert (gradients > 0) == (name == "hmc") or name == "mixture"
    assert for_timing in ([2 * 4 * pairs for pairs in range(5, 51)] if gradients else [0])


@pytest.mark.parametrize("name", OF_ONE_TEST)
def test_log_probability_of_the_draws_is_stored(problem, name):
    trace = fmu.sample(problem, name, draws=20, warmup=0, seed=4)
    theta = np.stack([trace["posterior"][p] for p in ("a", "b")], axis=-1).reshape(-1, 2)
    np.testing.assert_allclose(trace["sample_stats"]["lp"].to_numpy().ravel(), problem.log_prob(theta), rtol=1e-12)
    terms = trace["log_likelihood"]["frequency"].sum("mode").to_numpy().ravel()
    np.testing.assert_allclose(terms, problem.log_likelihood(theta), rtol=1e-12)


def test_same_seed_gives_the_same_draws_and_hash(problem):
    first, again, other = (fmu.sample(problem, "hmc", draws=20, warmup=10, seed=s) for s in (7, 7, 8))
    for group in ("posterior", "warmup_posterior", "prior", "posterior_predictive", "sample_stats"):
        assert first[group].identical(again[group])
    assert first.attrs["configuration_hash"] == again.attrs["configuration_hash"]
    assert not first["posterior"].identical(other["posterior"])
    assert first.attrs["configuration_hash"] != other.attrs["configuration_hash"]


def test_settings_objects_are_samplers_and_enter_the_hash(problem):
    default = fmu.sample(problem, "hmc", draws=5, warmup=0)
    same = fmu.sample(problem, fmu.HamiltonianMonteCarlo(), draws=5, warmup=0)
    paper = fmu.sample(problem, fmu.HamiltonianMonteCarlo(gradient="central-difference"), draws=5, warmup=0)
    assert same.attrs["configuration_hash"] == default.attrs["configuration_hash"]
    assert paper.attrs["configuration_hash"] != default.attrs["configuration_hash"]
    assert json.loads(paper.attrs["settings"])["gradient"] == "central-difference"


def test_given_starts_enter_the_hash(problem):
    starts = [[0.1, 0.2], [0.3, 0.4]]
    first = fmu.sample(problem, "mh", draws=5, warmup=0, chains=2, init=starts)
    again = fmu.sample(problem, "mh", draws=5, warmup=0, chains=2, init=np.array(starts))
    other = fmu.sample(problem, "mh", draws=5, warmup=0, chains=2, init=np.array(starts) + 0.1)
    assert first.attrs["configuration_hash"] == again.attrs["configuration_hash"]
    assert first.attrs["configuration_hash"] != other.attrs["configuration_hash"]
    assert first.attrs["init"] == "array"


def test_sampling_on_is_bitwise_the_longer_run(problem):
    """Looked at after 10 and 20 draws, too few to predict from; the ESS asked for is out of reach."""
    phases = []
    grown = fmu.sample(
        problem, "hmc", draws=10, warmup=30, seed=7, until_ess=1e6, max_draws=130,
        progress=lambda phase, done, total, info: info.get("lp") and phases.append((phase, done, total)),
    )  # fmt: skip
    whole = fmu.sample(problem, "hmc", draws=130, warmup=30, seed=7, maxima=fmu.find_map(problem))
    for group in ("posterior", "warmup_posterior", "posterior_predictive", "sample_stats", "maxima"):
        assert grown[group].identical(whole[group])
    assert grown.attrs["configuration_hash"] == whole.attrs["configuration_hash"]
    assert grown.attrs["n_solves"] == whole.attrs["n_solves"]
    assert [phases[k] for k in (29, 39, 40, 49)] == [
        ("warmup", 30, 30),
        ("draws", 10, 10),
        ("draws", 11, 20),
        ("draws", 20, 20),
    ]
    assert phases[-1] == ("draws", 130, 130)


@pytest.mark.parametrize(("name", "draws"), [("hmc", 50), pytest.param("mh", 500, marks=pytest.mark.validate)])
def test_sampling_stops_when_there_is_enough(problem, name, draws):
    """Doubling would come to up to twice the ESS asked for."""
    trace = fmu.sample(problem, name, draws=draws, warmup=200, seed=1, until_ess=700)
    assert 700 <= fmu.summary(trace)[["ess_bulk", "ess_tail"]].min().min() <= 1.25 * 700
    assert fmu.diagnose(trace).converged


def test_enough_draws_of_chains_that_disagree_are_not_enough(problem):
    """One chain can reach any ESS, and is never called converged."""
    trace = fmu.sample(problem, "hmc", draws=100, warmup=100, chains=1, seed=1, until_ess=20, max_draws=300)
    assert trace["posterior"].sizes["draw"] == 300
    assert fmu.summary(trace)["ess_bulk"].min() > 20


def test_a_plain_density_can_be_sampled_on():
    class Plain:
        ndim, lower, upper = 2, np.full(2, -np.inf), np.full(2, np.inf)

        def log_prob(self, theta):
            return -0.5 * np.sum(theta**2, axis=-1)

        def log_prob_and_grad(self, theta):
            return self.log_prob(theta), -theta

    start = np.random.default_rng(0).standard_normal((4, 2))
    trace = fmu.sample(Plain(), "hmc", draws=50, warmup=200, init=start, until_ess=500)
    found = fmu.diagnose(trace)
    assert found.state == "converged locally"
    (remark,) = found.remarks
    assert remark.startswith("64 starts around its start led to 1 maximum, but without bounds or a prior")
    Plain.lower, Plain.upper = np.full(2, -9.0), np.full(2, 9.0)
    bounded = fmu.diagnose(fmu.sample(Plain(), "hmc", draws=50, warmup=200, init=start, until_ess=500))
    assert bounded.state == "converged"
    assert bounded.remarks == ("64 starts within the bounds led to 1 maximum",)


def test_a_plain_density_starts_from_its_prior():
    class Plain:
        ndim, lower, upper = 2, np.zeros(2), np.ones(2)

        def log_prob(self, theta):
            return np.zeros(np.shape(theta)[:-1])

        def sample_prior(self, rng, n):
            return rng.uniform(size=(n, 2))

    default, prior = (fmu.sample(Plain(), "mh", draws=3, warmup=0, init=i) for i in ("maxima", "prior"))
    assert default["posterior"].identical(prior["posterior"])
    assert default.attrs["init"] == "prior"


def test_without_an_ess_the_draws_are_what_was_asked_for(problem):
    trace = fmu.sample(problem, "mh", draws=7, warmup=3)
    assert trace["posterior"].sizes["draw"] == 7


@pytest.mark.parametrize(("init", "is_known"), [("maxima", True), ("prior", False), ("start", False)])
def test_hmc_begins_with_the_curvature_only_at_the_maxima(problem, init, is_known):
    """From elsewhere its trajectories would be too short to get to the maxima."""
    trace = fmu.sample(problem, "hmc", draws=4, warmup=4, init=init, jumps=False)
    settings = json.loads(trace.attrs["configuration"])["sampler"]["settings"]
    assert (settings["first_mass"] is not None) == is_known


def test_chains_start_at_the_maxima_which_the_trace_keeps(problem):
    maxima = fmu.find_map(problem)
    searched, given = (fmu.sample(problem, "mh", draws=7, warmup=3, maxima=m) for m in (None, maxima))
    assert searched.attrs["init"] == given.attrs["init"] == "maxima"
    assert searched["posterior"].identical(given["posterior"])
    assert searched["maxima"].identical(given["maxima"])
    assert json.loads(given.attrs["configuration"])["run"]["init"] == {"maxima": maxima.hash}
    other = fmu.sample(problem, "mh", draws=7, warmup=3, maxima=fmu.find_map(problem, seed=2))
    assert other.attrs["configuration_hash"] != given.attrs["configuration_hash"]
    from_prior = fmu.sample(problem, "mh", draws=7, warmup=3, init="prior")
    assert from_prior.attrs["init"] == "prior"
    assert from_prior["maxima"].identical(given["maxima"])  # whatever the chains start at


def test_maxima_are_kept_with_a_checkpoint(problem, tmp_path, monkeypatch):
    """A run that goes on starts where it did, on a machine whose search would end elsewhere in the last digit."""
    settings = {"draws": 9, "warmup": 3, "seed": 2, "checkpoint": tmp_path / "kept"}
    first = fmu.sample(problem, "mh", **settings)

    def searched_again(*_):
        raise AssertionError("the maxima are kept")

    with monkeypatch.context() as patch:
        patch.setattr("fmu.analysis.maxima.search.find_map", searched_again)
        assert fmu.sample(problem, "mh", **settings)["posterior"].identical(first["posterior"])
    with pytest.raises(ValueError, match=r"contains another run: run\.init\.maxima"):
        fmu.sample(problem, "mh", **settings, maxima=fmu.find_map(problem, seed=2))


def test_maxima_kept_of_another_posterior_are_not_taken(problem, tmp_path):
    elsewhere = UpdatingProblem.reduced(
        problem.model, ModalData([104.0, 98.0, 106.0]), problem.parameters, name="linear"
    )
    keep_maxima(tmp_path, fmu.find_map(elsewhere), elsewhere)
    assert kept_maxima(tmp_path, problem) is None
    assert kept_maxima(tmp_path, elsewhere) is not None
    trace = fmu.sample(problem, "mh", draws=3, warmup=3, checkpoint=tmp_path)
    assert trace["maxima"].identical(fmu.sample(problem, "mh", draws=3, warmup=3)["maxima"])


def test_progress_is_reported(problem):
    seen = []
    fmu.sample(
        problem, "mh", draws=3, warmup=2, progress=lambda phase, done, total, info: seen.append((done, total))
    )
    assert seen == [(1, 2), (2, 2), (1, 3), (2, 3), (3, 3)]


def test_the_last_report_has_the_numbers_of_the_verdict(problem, monkeypatch):
    """The running numbers of a long run are approximate, and up to a fiftieth of the run old."""
    for name in ("MOST_RANKED", "MOST_BATCHES"):
        monkeypatch.setattr(effective, name, 40)  # so that 150 draws are a long run
    seen = []
    trace = fmu.sample(problem, "hmc", draws=150, warmup=50, progress=lambda *report: seen.append(report))
    phase, done, total, info = seen[-1]
    assert (phase, done, total) == ("draws", 150, 150)
    table = fmu.summary(trace)
    running = effective.live_diagnostics(parameter_draws(trace))
    assert (running["rhat"], running["ess"]) != (info["rhat"], info["ess"])
    assert (info["rhat"], info["ess"]) == (table["rhat"].max(), table["ess_bulk"].min())


def test_names_are_those_of_the_samplers():
    assert [samplers.make_sampler(name).name for name in SAMPLERS] == list(SAMPLERS)
    with pytest.raises(ValueError, match=", ".join(SAMPLERS)):
        samplers.make_sampler("nuts")


@pytest.mark.parametrize("sampler", ["nuts", 3, ""])
def test_unknown_sampler(problem, sampler):
    with pytest.raises(ValueError, match=rf"sampler: must be one of mh, slice, hmc, emcee.*\(got {sampler!r}\)"):
        fmu.sample(problem, sampler)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"draws": 0}, r"draws: .* \(got 0\)"),
        ({"warmup": -1}, r"warmup: .* \(got -1\)"),
        ({"chains": 0}, r"chains: .* \(got 0\)"),
        ({"init": "middle"}, "init: .*'middle'"),
        ({"until_ess": 0}, r"until_ess: must be a positive finite number or None \(got 0\)"),
        ({"until_ess": 10, "max_draws": 999}, r"max_draws: must be a whole number of at least 1000 \(got 999\)"),
        ({"max_draws": 9999}, r"max_draws: needs until_ess, .* \(got 9999\)"),
        ({"init": [[0.0, np.inf]] * 4}, "init: "),
    ],
)
def test_bad_arguments_name_parameter_and_value(problem, settings, message):
    with pytest.raises(ValueError, match=message):
        fmu.sample(problem, "mh", **settings)


def test_public_names_exist_and_are_listed():
    for name in fmu.__all__:
        assert getattr(fmu, name) is not None
        assert name in dir(fmu)
    assert fmu.__version__.count(".") == 2
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = fmu.nothing


def test_import_brings_in_nothing_heavy():
    code = (
        "import fmu, sys; print(*{'numpy', 'scipy', 'pandas', 'xarray', 'arviz', 'matplotlib'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""


class WithoutGradient:
    """A density that tells its values alone."""

    ndim, lower, upper = 2, -np.ones(2), np.ones(2)

    def log_prob(self, theta):
        return -np.sum(theta**2, axis=1)


def test_the_sampler_follows_from_what_the_model_offers(problem):
    def frequencies(theta):
        return 100.0 + SLOPES @ theta

    def with_gradient(theta):
        return {"frequencies": frequencies(theta), "gradient": SLOPES}

    parameters = [Parameter("a", 0.5, -3.0, 3.0), Parameter("b", 0.0, -3.0, 3.0)]
    data = ModalData([101.0, 99.5, 102.0])
    names = {}
    for function in (frequencies, with_gradient):
        posed = UpdatingProblem(fmu.BlackBoxModel(function, 2), data, parameters, beta=1.0)
        names[function] = fmu.sample(posed, draws=5, warmup=5, init="start").attrs["sampler"]
    assert names == {frequencies: "mixture", with_gradient: "mixture"}
    assert fmu.sample(problem, draws=5, warmup=5).attrs["sampler"] == "mixture"
    start = np.zeros((4, 2))
    assert fmu.sample(WithoutGradient(), draws=5, warmup=5, init=start).attrs["sampler"] == "mixture"


def test_a_function_is_not_called_again_for_its_draws():
    """And what it is called for is counted."""
    called = []

    def frequencies(theta):
        called.append(theta)
        return 100.0 + SLOPES @ theta

    parameters = [Parameter("a", 0.5, -3.0, 3.0), Parameter("b", 0.0, -3.0, 3.0)]
    posed = UpdatingProblem(
        fmu.BlackBoxModel(frequencies, 2), ModalData([101.0, 99.5, 102.0]), parameters, beta=1.0
    )
    fmu.find_map(posed)
    called.clear()
    before = solves()
    attrs = fmu.sample(posed, draws=50, warmup=20, seed=1, init="prior").attrs
    assert len(called) == solves() - before
    assert len(called) <= attrs["n_solves"] + attrs["warmup_n_solves"] + attrs["after_n_solves"]
    # before updating and at the mean, and four for the derivatives before it
    assert attrs["after_n_solves"] <= 6


@pytest.fixture(scope="module")
def shear():
    return fmu.cases.load("shear-2dof")


@pytest.mark.parametrize(
    ("settings", "is_measured"),
    [
        (samplers.HamiltonianMonteCarlo(), True),
        (samplers.HamiltonianMonteCarlo(gradient="central-difference"), False),
        (samplers.MetropolisHastings(), False),
    ],
)
def test_what_an_exact_gradient_costs_is_measured(shear, settings, is_measured):
    """Those of differences are solves that are counted."""
    trace = fmu.sample(shear, settings, draws=4, warmup=4, init="prior")
    assert ("gradient_cost" in trace.attrs) == is_measured
    if is_measured:
        assert 1.0 < trace.attrs["gradient_cost"] < 20.0


def test_a_function_gives_value_and_gradient_in_one_call(problem):
    model = fmu.BlackBoxModel(lambda theta: (100.0 + SLOPES @ theta, None, SLOPES), 2)
    by_function = UpdatingProblem(model, problem.data, problem.parameters)
    trace = fmu.sample(by_function, "hmc", draws=4, warmup=4, init="prior")
    assert trace.attrs["n_gradients"] > 0
    assert "gradient_cost" not in trace.attrs


@pytest.mark.parametrize(("sampler", "most"), [("mh", 300), ("hmc", 3000), ("slice", 600), ("emcee", 2500)])
def test_a_limit_of_solves_shortens_warm_up_and_first_draws(problem, sampler, most):
    """The verdict says so. A trajectory or a bracket takes more or less than usual."""
    trace = fmu.sample(problem, sampler, warmup=400, until_ess=1e6, max_solves=most, seed=3, init="prior")
    used = trace.attrs["warmup_n_solves"] + trace.attrs["n_solves"]
    assert 0.6 * most < used < 1.2 * most
    warmup = trace["warmup_posterior"].sizes["draw"] // trace.attrs["walkers"]
    assert 5 < warmup < 400
    assert f"solves, which shortened its warm-up from 400 to {warmup} steps" in str(fmu.diagnose(trace))


def test_a_limit_of_solves_says_what_took_more(problem):
    """No shorter run is possible than one step of every walker."""
    trace = fmu.sample(problem, "emcee", warmup=0, until_ess=400, max_solves=100, seed=3, init="prior")
    assert f"its limit of 100 solves: the warm-up took 0 and 1 draws {trace.attrs['n_solves']}" in str(
        fmu.diagnose(trace)
    )


def test_a_limit_of_solves_leaves_a_run_alone_that_fits(problem):
    trace = fmu.sample(problem, "mixture", draws=50, warmup=100, until_ess=10_000, max_solves=3000, seed=3)
    total = sum(int(trace[name]["n_solves"].sum()) for name in ("warmup_sample_stats", "sample_stats"))
    assert trace["warmup_posterior"].sizes["draw"] == 100
    assert 0.9 * 3000 < total <= 3000 + 100
    assert "its limit of 3 000 solves\n" in str(fmu.diagnose(trace))


def test_a_run_with_a_shortened_warm_up_goes_on_with_a_higher_limit(problem, tmp_path):
    asked = {"warmup": 400, "until_ess": 1e6, "seed": 3, "init": "prior", "checkpoint": tmp_path}
    short = fmu.sample(problem, "mh", **asked, max_solves=300)
    longer = fmu.sample(problem, "mh", **asked, max_solves=900)
    assert longer.attrs["warmup"] == short.attrs["warmup"] < 400
    kept = short["posterior"].sizes["draw"]
    for name, values in short["posterior"].items():
        np.testing.assert_array_equal(longer["posterior"][name][:, :kept], values)
    assert longer["posterior"].sizes["draw"] > kept
    with pytest.raises(ValueError, match=r"contains another run: run\.warmup 400 there, 500 here"):
        fmu.sample(problem, "mh", **asked | {"warmup": 500}, max_solves=900)


def test_a_plain_density_starts_at_its_best_maximum_where_another_one_would_catch_its_chains():
    """The wide maximum, where the prior's draws are, has a millionth of the probability."""

    class Plain:
        ndim, lower, upper = 2, np.full(2, -3.0), np.full(2, 3.0)

        def log_prob(self, theta):
            narrow = 16.6 - 50.0 * np.sum((theta - 2.0) ** 2, axis=-1)
            return np.logaddexp(narrow, -3.1 * np.sum((theta + 1.0) ** 2, axis=-1))

        def sample_prior(self, rng, n):
            return rng.uniform(-3.0, 3.0, (n, 2))

    trace = fmu.sample(Plain(), "mixture", draws=200, seed=1)
    assert trace.attrs["init"] == "maxima"
    assert all(float(draws.mean()) > 1.9 for draws in trace["posterior"].data_vars.values())
