import errno
import os
import subprocess
import sys

import arviz as az
import h5py
import numpy as np
import pytest
import xarray as xr

from fmu.analysis.trace.conversion import PRIOR_DRAWS, load_trace, save_trace, to_trace
from fmu.analysis.trace.netcdf import from_netcdf, to_netcdf

GROUPS = {
    "posterior",
    "warmup_posterior",
    "sample_stats",
    "warmup_sample_stats",
    "log_likelihood",
    "misfit",
    "posterior_predictive",
    "prior",
    "observed_data",
    "constant_data",
}


@pytest.fixture
def position():
    x = np.random.default_rng(2).uniform(-1, 1, (3, 40, 2))
    x[:, 1::2] = x[:, ::2]  # every other proposal was rejected
    return x


@pytest.fixture
def trace(make_result, problem, position):
    return to_trace(make_result(position, energy=1.5), problem)


def test_groups_dimensions_and_units(trace, position):
    assert set(trace.children) == GROUPS
    assert list(trace["posterior"].data_vars) == ["E1", "rho"]
    for group, draws in (("posterior", 40), ("warmup_posterior", 2)):
        assert trace[group]["rho"].dims == ("chain", "draw")
        assert trace[group]["rho"].shape == (3, draws)
        assert trace[group]["rho"].attrs["units"] == "kg/m³"
        np.testing.assert_array_equal(trace[group]["rho"], position[:, :draws, 1])
    assert set(trace["sample_stats"].data_vars) == {"lp", "accepted", "n_solves", "n_gradients", "energy"}
    assert trace["sample_stats"]["accepted"].dtype == bool
    assert trace["log_likelihood"]["frequency"].dims == ("chain", "draw", "mode")
    assert list(trace["log_likelihood"]["mode"].to_numpy()) == ["W1", "W2", "T1"]


def test_data_and_constants_are_the_problems(trace, problem):
    np.testing.assert_array_equal(trace["observed_data"]["frequency"], [101.0, 99.5, 102.0])
    constants = trace["constant_data"]
    for name in ("lower", "upper", "start"):
        np.testing.assert_array_equal(constants[name].sel(parameter=["E1", "rho"]), getattr(problem, name))
    np.testing.assert_array_equal(constants["beta"], [0.5, 1.0, 2.0])


def test_frequencies_and_likelihood_are_those_of_the_draws(trace, problem, position):
    points = position.reshape(-1, 2)
    frequency = trace["posterior_predictive"]["model_frequency"].to_numpy().reshape(-1, 3)
    np.testing.assert_allclose(frequency, problem.frequencies(points), rtol=1e-14)
    terms = trace["log_likelihood"]["frequency"].to_numpy().reshape(-1, 3)
    np.testing.assert_allclose(terms, problem.log_likelihood_terms(points), rtol=1e-12)


def test_repeated_draws_are_not_solved_again(make_result, problem, position):
    to_trace(make_result(position), problem)
    assert len(problem.model.given.asked) == position.shape[0] * position.shape[1] // 2


def test_repeated_draws_of_walkers_are_not_solved_again(make_result, problem):
    ensemble = np.random.default_rng(3).uniform(-1, 1, (2, 10, 4, 2))
    ensemble[:, 1::2] = ensemble[:, ::2]
    to_trace(make_result(ensemble.reshape(2, 40, 2), walkers=4), problem)
    assert len(problem.model.given.asked) == 2 * 5 * 4


def test_predictive_noise_has_the_sd_of_the_error_model(make_result, problem):
    # A chain that stands still: every draw still gets its own noise.
    trace = to_trace(make_result(np.zeros((2, 5000, 2))), problem)["posterior_predictive"]
    noise = (trace["frequency"] - trace["model_frequency"]).to_numpy().reshape(-1, 3)
    np.testing.assert_allclose(
        noise.std(axis=0), 1 / np.sqrt(2 * np.array([0.5, 1.0, 2.0])), rtol=5 / np.sqrt(2e4)
    )
    assert len(np.unique(noise)) == noise.size


def test_prior_draws_are_from_the_prior_inside_the_bounds(trace, make_result, problem, position):
    prior = trace["prior"]
    assert prior["E1"].shape == (1, PRIOR_DRAWS)
    assert float(abs(prior["E1"]).max()) < 4.0
    assert float(prior["rho"].std()) == pytest.approx(2.0, rel=5 / np.sqrt(2 * PRIOR_DRAWS))
    again = to_trace(make_result(position), problem)["prior"]
    np.testing.assert_array_equal(again["E1"], prior["E1"])
    other = to_trace(make_result(position, seed=6), problem)["prior"]
    assert not np.array_equal(other["E1"], prior["E1"])


def test_prior_draws_share_no_stream_with_the_chains(trace, problem):
    stored = set(trace["prior"]["E1"].to_numpy().ravel())
    for stream in [np.random.SeedSequence(5), *np.random.SeedSequence(5).spawn(16)]:
        drawn = problem.sample_prior(np.random.default_rng(stream), 10)[:, 0]
        assert not stored & set(drawn)


def test_plain_density_gives_the_groups_that_need_no_frequencies(make_trace, position):
    trace = make_trace(position)
    assert set(trace.children) == {
        "posterior",
        "warmup_posterior",
        "sample_stats",
        "warmup_sample_stats",
        "constant_data",
    }
    assert list(trace["posterior"].data_vars) == ["x0", "x1"]


def test_run_without_warm_up_keeps_its_empty_groups(make_result, problem, position, tmp_path):
    result = make_result(position, warmup=position[:, :0])
    result.warmup.stats.clear()
    trace = load_trace(save_trace(to_trace(result, problem), tmp_path / "t.nc"))
    assert trace["warmup_posterior"]["E1"].shape == (3, 0)
    assert trace.attrs["warmup_n_solves"] == 0


def test_arviz_reads_the_trace(trace):
    table = az.summary(trace)
    assert list(table.index) == ["E1", "rho"]


def test_round_trip_is_exact(trace, tmp_path):
    path = save_trace(trace, tmp_path / "hmc.nc")
    loaded = load_trace(path)
    assert loaded.identical(trace)
    assert loaded.attrs == trace.attrs
    for group in GROUPS:
        for name, variable in trace[group].data_vars.items():
            assert loaded[group][name].dtype == variable.dtype
    assert [p.name for p in tmp_path.iterdir()] == ["hmc.nc"]


def test_xarray_and_fmu_read_each_others_files(tmp_path):
    """Numbers of all kinds, truth values, text, nothing at all, and dimensions without coordinates."""
    first = xr.Dataset(
        {
            "b": (("mode", "other"), np.arange(6.0).reshape(2, 3), {"units": "Hz"}),
            "a": (("mode",), np.array([True, False])),
            "count": ((), np.int64(7)),
            "text": (("other",), np.array(["Young’s", "", "b"]), {"two": np.array([1, 2]), "one": 3}),
            "none": (("mode", "draw"), np.empty((2, 0))),
        },
        coords={"mode": ["1", "θ"], "unit": ("mode", ["Pa", ""]), "draw": np.arange(0)},
        attrs={"name": "π", "empty": "", "wall_s": 0.5, "complete": 1},
    )
    tree = xr.DataTree.from_dict({"/": xr.Dataset(attrs={"sampler": "mh"}), "/z": first, "/z/below": first})
    (tmp_path / "fmu.nc").write_bytes(to_netcdf(tree))
    tree.to_netcdf(tmp_path / "xarray.nc", engine="h5netcdf")
    by_xarray = xr.load_datatree(tmp_path / "fmu.nc", engine="h5netcdf")
    for found in (by_xarray, from_netcdf(tmp_path / "fmu.nc"), from_netcdf(tmp_path / "xarray.nc")):
        xr.testing.assert_identical(found, tree)
        for path in ("z", "z/below"):
            assert list(found[path].data_vars) == list(first.data_vars)
            assert {name: v.dtype.kind for name, v in found[path].variables.items()} == {
                name: v.dtype.kind for name, v in first.variables.items()
            }


def test_file_holds_no_python_objects(trace, tmp_path):
    save_trace(trace, tmp_path / "hmc.nc")
    opaque = []
    with h5py.File(tmp_path / "hmc.nc") as file:
        file.visititems(
            lambda name, item: (
                opaque.append(name) if isinstance(item, h5py.Dataset) and item.dtype.kind == "V" else None
            )
        )
    assert opaque == []


def test_failed_write_leaves_the_earlier_file(trace, tmp_path, monkeypatch):
    path = save_trace(trace, tmp_path / "hmc.nc")
    before = path.read_bytes()

    def full(descriptor):
        raise OSError(errno.ENOSPC, "no space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="no space left"):
        save_trace(trace, path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_reader_of_the_earlier_file_is_not_disturbed(trace, make_trace, tmp_path):
    path = save_trace(trace, tmp_path / "hmc.nc")
    before = path.read_bytes()
    with path.open("rb") as reader:
        save_trace(make_trace(np.zeros((2, 5, 2))), path)
        assert reader.read() == before
    assert list(load_trace(path)["posterior"].data_vars) == ["x0", "x1"]


def test_missing_trace(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"path: must be a trace .*no such file: .*absent\.nc"):
        load_trace(tmp_path / "absent.nc")


def test_text_and_damaged_files_are_refused(trace, tmp_path):
    text = tmp_path / "text.nc"
    text.write_text("hello")
    damaged = save_trace(trace, tmp_path / "damaged.nc")
    damaged.write_bytes(damaged.read_bytes()[:2000])
    for path in (text, damaged):
        with pytest.raises(ValueError, match="not a readable netCDF file"):
            load_trace(path)


def test_foreign_netcdf_is_refused(trace, tmp_path):
    path = tmp_path / "foreign.nc"
    xr.Dataset({"posterior": ("x", [1.0])}).to_netcdf(path, engine="h5netcdf")
    with pytest.raises(ValueError, match="it has no posterior, sample_stats, sampler, walkers, wall_s"):
        load_trace(path)
    del trace.attrs["sampler"]
    with pytest.raises(ValueError, match="it has no sampler"):
        load_trace(save_trace(trace, path))


@pytest.mark.skipif(os.name != "posix", reason="limits of POSIX")
def test_a_file_that_is_too_large_is_one_error(tmp_path):
    """Nothing else is said, at the end of the process neither; and what was there is there."""
    path = tmp_path / "t.nc"
    path.write_bytes(b"before")
    program = (
        "import resource, signal, sys\n"
        "import numpy as np, xarray as xr\n"
        "from fmu.analysis.trace.conversion import save_trace\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, resource.RLIM_INFINITY))\n"
        "trace = xr.DataTree(xr.Dataset({name: ('x', np.arange(2000.0)) for name in 'abc'}))\n"
        "try:\n    save_trace(trace, sys.argv[1])\n"
        "except OSError as error:\n    print(error)\n"
    )
    ended = subprocess.run([sys.executable, "-c", program, path], capture_output=True, text=True, timeout=120)
    assert (ended.returncode, ended.stderr) == (0, "")
    assert ended.stdout == f"[Errno 27] File too large: '{path}'\n"
    assert path.read_bytes() == b"before"
    assert [file.name for file in tmp_path.iterdir()] == ["t.nc"]
