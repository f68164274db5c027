"""Runs of plain emcee, converted: summary beside emcee's own numbers, files of all kinds, what is refused."""

from types import SimpleNamespace

import emcee
import h5py
import numpy as np
import pytest

import fmu
from fmu.analysis.maxima.search import find_map

WALKERS = 12


def gaussian(theta):
    """A correlated Gaussian of two parameters, and its components as blobs."""
    return np.column_stack([-0.5 * (theta[:, 0] ** 2 + (theta[:, 1] - 0.6 * theta[:, 0]) ** 2 / 0.64), theta])


def log_prob(theta):
    return gaussian(theta)[:, 0]


def sampled(function, steps, *, seed=1, backend=None, ndim=2, spread=1.0, **options):
    """Run plain emcee on a vectorised log-probability."""
    thin_by = options.pop("thin_by", 1)
    options = {"vectorize": True} | options
    sampler = emcee.EnsembleSampler(WALKERS, ndim, function, backend=backend, **options)
    sampler.random_state = np.random.RandomState(seed).get_state()
    sampler.run_mcmc(spread * np.random.default_rng(seed).standard_normal((WALKERS, ndim)), steps, thin_by=thin_by)
    return sampler


@pytest.fixture(scope="module")
def long():
    """A run of some 300 autocorrelation times."""
    return sampled(gaussian, 2700, moves=emcee.moves.DEMove())


def assert_emcees_numbers(trace, sampler, **options):
    """Fail unless mean and sd are those of emcee's flat chain, and ESS is draws over emcee's own time."""
    flat = sampler.get_chain(flat=True, **options)
    table = fmu.summary(trace)
    np.testing.assert_allclose(table["mean"], flat.mean(axis=0), rtol=1e-12)
    np.testing.assert_allclose(table["sd"], flat.std(axis=0, ddof=1), rtol=1e-12)
    kept = sampler.get_chain(**options)
    time = emcee.autocorr.integrated_time(kept, tol=0)
    np.testing.assert_array_equal(trace["emcee"]["autocorrelation_time"][0], time)
    np.testing.assert_allclose(table["ess_emcee"], len(flat) / time, rtol=1e-12)
    # fmu's time is about the mean of the ensemble, emcee's about that of each walker: its autocovariance is lower
    # by variance · time/steps at all of the 5 times · 2 lags of its window
    lower = 10.0 * time / len(kept)
    assert lower.max() < 0.04, "long enough for the difference to be small"
    np.testing.assert_allclose(table["ess_bulk"], (1.0 - lower) * len(flat) / time, rtol=0.02)


def test_a_plain_sampler(long):
    trace = fmu.from_emcee(long, discard=200)
    assert_emcees_numbers(trace, long, discard=200)
    assert list(fmu.summary(trace).index) == ["x0", "x1"]
    assert trace.attrs["walkers"] == WALKERS
    chain = long.get_chain(discard=200)
    np.testing.assert_array_equal(trace["posterior"]["x1"][0, 5 * WALKERS + 3], chain[5, 3, 1], "step-major")
    np.testing.assert_array_equal(trace["sample_stats"]["lp"][0], long.get_log_prob(discard=200, flat=True))
    np.testing.assert_array_equal(trace["blobs"]["blobs"][0], long.get_blobs(discard=200, flat=True))


def test_acceptance_discard_and_evaluations_are_kept(long):
    trace = fmu.from_emcee(long, discard=200)
    np.testing.assert_array_equal(trace["emcee"]["acceptance_fraction"][0], long.acceptance_fraction)
    assert int(trace["emcee"]["discard"][0]) == 200
    moved = trace["sample_stats"]["accepted"].sum() + trace["warmup_sample_stats"]["accepted"].sum()
    assert int(moved) == long.backend.accepted.sum()
    assert trace.attrs["warmup_n_solves"] == WALKERS * 201, "the start was evaluated too"
    assert trace.attrs["n_solves"] == WALKERS * 2500
    table = fmu.compare({"emcee": trace})
    assert table["accept_rate"].iloc[0] == pytest.approx(long.acceptance_fraction.mean(), rel=0.01)


def test_the_verdict_on_one_ensemble_rests_on_times_and_walkers_and_says_what_it_cannot_exclude(long):
    trace = fmu.from_emcee(long, discard=200)
    found = fmu.diagnose(trace)
    assert found.converged
    assert found.remarks == (
        "one ensemble: separate modes cannot be excluded; run 4 ensembles from spread starts, such as "
        "problem.walkers(n, seed), and give fmu.from_emcee the list of them",
    )
    short = fmu.diagnose(fmu.from_emcee(long, discard=2500))
    assert not short.converged
    assert "autocorrelation times long; 50 are needed" in short.reasons[0]
    assert "steps are needed: continue with sampler.run_mcmc(None, " in short.reasons[0]
    assert "R-hat is nan" not in str(short)


def test_four_ensembles_are_judged_like_fmus_own(long):
    runs = [long, *(sampled(gaussian, 900, seed=k, moves=emcee.moves.DEMove()) for k in (2, 3, 4))]
    trace = fmu.from_emcee(runs, names=["a", "b"], discard=[700, 100, 100, 100])
    assert trace["posterior"].sizes["chain"] == 4
    found = fmu.diagnose(trace)
    assert found.converged
    assert not found.few
    assert fmu.summary(trace)["rhat"].max() < 1.01


def test_an_ensemble_divided_between_two_modes_has_not_converged():
    """emcee's own time does not show it: the mean of each walker is taken off, and no walker ever crosses."""

    def two(theta):
        return np.logaddexp(*(-0.5 * np.sum((theta - c) ** 2, axis=1) / 0.01 for c in (-3.0, 3.0)))

    sampler = emcee.EnsembleSampler(WALKERS, 2, two, vectorize=True, moves=emcee.moves.GaussianMove(0.02))
    sampler.random_state = np.random.RandomState(1).get_state()
    start = np.where(np.arange(WALKERS)[:, None] % 2, -3.0, 3.0)
    sampler.run_mcmc(start + 0.1 * np.random.default_rng(1).standard_normal((WALKERS, 2)), 3000)
    assert 3000 / emcee.autocorr.integrated_time(sampler.get_chain(), tol=0).max() > 50
    found = fmu.diagnose(fmu.from_emcee(sampler))
    assert "walkers stay in separate places" in found.verdict
    assert "problem.walkers(n, seed)" in found.verdict


@pytest.mark.parametrize("written", ["at once", "resumed", "interrupted", "in steps of three"])
def test_hdf_files(tmp_path, written):
    path = tmp_path / "chain.h5"
    backend = emcee.backends.HDFBackend(path)
    backend.reset(WALKERS, 2)
    thin_by = 3 if written == "in steps of three" else 1
    first = 30 if written == "resumed" else 50
    sampled(gaussian, first, backend=backend, thin_by=thin_by)
    if written == "resumed":
        again = emcee.EnsembleSampler(
            WALKERS, 2, gaussian, vectorize=True, backend=emcee.backends.HDFBackend(path)
        )
        again.run_mcmc(None if again.iteration == 0 else again.get_last_sample(), 20)
    if written == "interrupted":  # room for more steps than were made, as a killed process leaves it
        backend.grow(30, np.zeros((WALKERS, 2)))
        with h5py.File(path) as file:
            assert len(file["mcmc"]["chain"]) == 80
    reader = emcee.backends.HDFBackend(path, read_only=True)
    for source in (path, str(path), reader) if written == "at once" else (path,):
        trace = fmu.from_emcee(source, discard=10, thin=4, thin_by=thin_by)
        flat = reader.get_chain(discard=10, thin=4, flat=True)
        table = fmu.summary(trace)
        np.testing.assert_allclose(table["mean"], flat.mean(axis=0), rtol=1e-12)
        np.testing.assert_allclose(table["sd"], flat.std(axis=0, ddof=1), rtol=1e-12)
        solves = trace.attrs["n_solves"] + trace.attrs["warmup_n_solves"]
        assert solves == WALKERS * (50 * thin_by + 1)
        assert trace.attrs["warmup_n_solves"] == WALKERS * (10 * thin_by + 1)
        fractions = reader.accepted / 50
        np.testing.assert_array_equal(trace["emcee"]["acceptance_fraction"][0], fractions)
        assert not np.isnan(trace["posterior"]["x0"]).any()
    if written == "in steps of three":
        assert float(trace["sample_stats"]["accepted"].mean()) == pytest.approx(fractions.mean())


def test_steps_that_were_not_stored_are_noticed():
    sampler = sampled(log_prob, 200, thin_by=5)
    with pytest.warns(UserWarning, match="thin_by: must be that of run_mcmc"):
        trace = fmu.from_emcee(sampler)
    assert float(trace["sample_stats"]["accepted"].mean()) == pytest.approx(sampler.acceptance_fraction.mean())


def test_unequal_ensembles_are_aligned_at_their_ends():
    runs = [sampled(log_prob, 80, seed=1), sampled(log_prob, 120, seed=2)]
    trace = fmu.from_emcee(runs, discard=[20, 30])
    assert (trace.attrs["draws"], trace.attrs["warmup"]) == (60, 20)
    for k, run in enumerate(runs):
        np.testing.assert_array_equal(trace["posterior"]["x1"][k], run.get_chain()[-60:, :, 1].ravel())
    assert trace["emcee"]["discard"].values.tolist() == [20, 60]
    assert trace.attrs["n_solves"] + trace.attrs["warmup_n_solves"] == WALKERS * (80 + 120 + 2)


def test_named_blobs(tmp_path):
    dtype = [("sum", float), ("pair", float, 2)]

    def function(theta):
        return [(v, t.sum(), t) for v, t in zip(log_prob(theta), theta, strict=True)]

    sampler = sampled(function, 30, blobs_dtype=dtype)
    trace = fmu.from_emcee(sampler, discard=10)
    flat = sampler.get_chain(discard=10, flat=True)
    np.testing.assert_allclose(trace["blobs"]["sum"][0], flat.sum(axis=1))
    np.testing.assert_array_equal(trace["blobs"]["pair"][0], flat)
    fmu.save_trace(trace, tmp_path / "emcee.nc")
    np.testing.assert_array_equal(fmu.load_trace(tmp_path / "emcee.nc")["blobs"]["pair"][0], flat)
    columns = fmu.from_emcee(sampled(gaussian, 30), blob_names=["left", "right"])
    assert set(columns["blobs"].data_vars) == {"left", "right"}
    with pytest.raises(ValueError, match=r"blob_names: must be one, or one for each of 2 columns \(got 3\)"):
        fmu.from_emcee(sampled(gaussian, 30), blob_names=["a", "b", "c"])


def test_frequencies_as_blobs_are_not_solved_again(problem, monkeypatch):
    def function(theta):
        return np.column_stack([problem.log_prob(theta), problem.frequencies(theta)])

    sampler = sampled(function, 60, spread=0.3)
    plain = fmu.from_emcee(sampled(problem.log_prob, 60, spread=0.3), problem, discard=10)
    solved = []
    frequencies = problem.frequencies
    monkeypatch.setattr(problem, "frequencies", lambda theta: solved.append(len(theta)) or frequencies(theta))
    trace = fmu.from_emcee(sampler, problem, discard=10)
    assert sum(solved) == 5 + 2, "those that are checked, start and mean"
    assert "blobs" not in trace.children
    for name, variable in plain["posterior_predictive"].data_vars.items():
        np.testing.assert_allclose(trace["posterior_predictive"][name], variable, rtol=1e-12)
    np.testing.assert_allclose(trace["log_likelihood"]["frequency"], plain["log_likelihood"]["frequency"])


def test_a_problem_gives_names_units_groups_and_maxima(problem):
    sampler = sampled(problem.log_prob, 60, spread=0.3)
    trace = fmu.from_emcee(sampler.backend, problem, discard=10, maxima=find_map(problem))
    assert tuple(fmu.summary(trace).index) == problem.names
    assert trace["posterior"]["E1"].attrs["units"] == "Pa"
    assert {"prior", "observed_data", "misfit", "maxima", "identifiability"} <= set(trace.children)
    assert fmu.diagnose(trace).searched


def test_another_log_probability_is_refused_with_both_values(problem):
    def another(theta):  # with a prior of one's own
        return problem.log_prob(theta) - 0.5 * theta[:, 0] ** 2

    sampler = sampled(another, 30, spread=0.3)
    with pytest.raises(ValueError, match=r"problem: must have the stored log-probabilities; at draw") as caught:
        fmu.from_emcee(sampler, problem)
    at = int(str(caught.value).split("at draw ")[1].split()[0])
    stored = float(sampler.get_log_prob(flat=True)[at])
    computed = problem.log_prob(sampler.get_chain(flat=True)[at])
    assert f"at draw {at} {stored!r} is stored (got {computed!r} of the problem)" in str(caught.value)
    trace = fmu.from_emcee(sampler, names=problem.names)
    assert list(fmu.summary(trace).index) == list(problem.names)


def test_the_samplers_own_names_are_used(problem):
    def of_names(theta):
        return -0.5 * (theta["a"] ** 2 + theta["b"] ** 2)

    sampler = sampled(of_names, 10, vectorize=False, parameter_names=["a", "b"])
    assert list(fmu.summary(fmu.from_emcee(sampler)).index) == ["a", "b"]
    assert list(fmu.summary(fmu.from_emcee(sampler, names=["c", "d"])).index) == ["c", "d"]

    def of_groups(theta):
        return -0.5 * (theta["E"] ** 2).sum()

    grouped = sampled(of_groups, 10, vectorize=False, parameter_names={"E": [0, 1]})
    assert list(fmu.summary(fmu.from_emcee(grouped)).index) == ["E[0]", "E[1]"]
    with pytest.raises(
        ValueError, match=r"of the sampler: must be those of the problem, \['E1', 'rho'\] \(got \['a'"
    ):
        fmu.from_emcee(sampler, problem)


def test_what_is_refused(long):
    class Unfinished(emcee.EnsembleSampler):
        pass

    new = Unfinished(WALKERS, 2, log_prob, vectorize=True)
    with pytest.raises(ValueError, match=r"at least one stored step \(got none in this Unfinished\)"):
        fmu.from_emcee(new)
    with pytest.raises(TypeError, match=r"source: must be an emcee.EnsembleSampler, .* \(got SimpleNamespace\)"):
        fmu.from_emcee(SimpleNamespace())
    with pytest.raises(ValueError, match="source: must hold at least one ensemble"):
        fmu.from_emcee([])
    with pytest.raises(ValueError, match=r"discard: must leave at least 1 of 2700 stored steps .* \(got 2700\)"):
        fmu.from_emcee(long, discard=2700)
    with pytest.raises(ValueError, match=r"discard: must be one number, or one for each of 1 ensembles \(got 2\)"):
        fmu.from_emcee(long, discard=[1, 2])
    with pytest.raises(ValueError, match="thin: must be a whole number of at least 1"):
        fmu.from_emcee(long, thin=0)
    with pytest.raises(ValueError, match=r"names: must have 2 parameters, as the stored chain \(got 1"):
        fmu.from_emcee(long, names=["a"])
    with pytest.raises(ValueError, match=r"names: must differ from each other"):
        fmu.from_emcee(long, names=["a", "a"])
    other = emcee.EnsembleSampler(2 * WALKERS, 2, gaussian, vectorize=True)
    other.run_mcmc(np.random.default_rng(1).standard_normal((2 * WALKERS, 2)), 3)
    with pytest.raises(ValueError, match=r"\(12, 2\) \(got \(24, 2\) of ensemble 1\)"):
        fmu.from_emcee([long, other])


def test_files_that_are_none(tmp_path):
    path = tmp_path / "chain.h5"
    with pytest.raises(FileNotFoundError, match="no such file"):
        fmu.from_emcee(path)
    path.write_bytes(b"\x89HDF\r\n")
    with pytest.raises(ValueError, match=r"source: must be a readable file of emcee's HDFBackend"):
        fmu.from_emcee(path)
    h5py.File(path, "w").close()
    with pytest.raises(ValueError, match=r"hdf_name: must be a run in .*; it is empty \(got 'mcmc'\)"):
        fmu.from_emcee(path)
    backend = emcee.backends.HDFBackend(path, name="first")
    backend.reset(WALKERS, 2)
    with pytest.raises(ValueError, match=r"it holds first \(got 'mcmc'\)"):
        fmu.from_emcee(path)
    with pytest.raises(ValueError, match=r"at least one stored step \(got none in .*chain.h5\)"):
        fmu.from_emcee(path, hdf_name="first")
    sampled(log_prob, 20, backend=backend)
    assert fmu.from_emcee(path, hdf_name="first").attrs["draws"] == 20
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match=r"source: must be .*chain.h5"):
        fmu.from_emcee(path, hdf_name="first")


@pytest.mark.usefixtures("no_pictures")
def test_a_report_of_an_imported_run(tmp_path, long):
    fmu.save_trace(fmu.from_emcee(long, discard=200), tmp_path / "emcee.nc")
    page = fmu.write_report(tmp_path).read_text(encoding="utf-8")
    assert "one ensemble: separate modes cannot be excluded" in page
    assert "Everything that determines the draws" not in page, "the seed is not known"
