"""The cache of reduced bases: what is not exactly what was stored is trained again."""

import os

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from threadpoolctl import threadpool_info, threadpool_limits

from fmu.engines.blas import single_thread
from fmu.fem.reduced import cache as basis_cache
from fmu.fem.reduced.cache import load_basis, store_basis

STATE = {"basis0": np.arange(6.0).reshape(2, 3), "trusted0": np.array(2.0)}
KEY = {"problem": {"name": "beam", "start": 1.5}, "tolerances": [1e-6]}


@pytest.fixture
def directory(tmp_path, monkeypatch):
    monkeypatch.setenv("FMU_CACHE_DIR", str(tmp_path / "bases"))
    return tmp_path / "bases"


def stored(directory):
    (path,) = directory.iterdir()
    return path


def test_what_is_stored_comes_back(directory):
    assert load_basis(KEY) is None
    store_basis(KEY, STATE)
    found = load_basis({"tolerances": [1e-6], "problem": {"start": 1.5, "name": "beam"}})
    assert set(found) == set(STATE)
    for name, array in STATE.items():
        assert_array_equal(found[name], array)
    assert load_basis(KEY | {"tolerances": [1e-5]}) is None
    assert [p.suffix for p in directory.iterdir()] == [".npz"]  # nothing half-written left behind


def test_torn_tampered_and_foreign_files_are_passed_over(directory):
    store_basis(KEY, STATE)
    path = stored(directory)
    content = path.read_bytes()
    for wrong in (b"", content[:20], content[:-1], content[:40] + b"x" + content[41:], b"not a basis" * 50):
        path.write_bytes(wrong)
        assert load_basis(KEY) is None
    store_basis(KEY, STATE)
    assert load_basis(KEY) is not None


def test_pickles_are_never_read(directory):
    store_basis(KEY, {"basis0": np.array([{"a": 1}], dtype=object)})
    assert load_basis(KEY) is None


def test_another_version_is_another_key(directory, monkeypatch):
    store_basis(KEY, STATE)
    monkeypatch.setattr(basis_cache, "_VERSION", -1)
    assert load_basis(KEY) is None


def test_an_empty_variable_means_no_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("FMU_CACHE_DIR", "")
    monkeypatch.chdir(tmp_path)
    store_basis(KEY, STATE)
    assert load_basis(KEY) is None
    assert os.listdir(tmp_path) == []


def test_a_cache_that_cannot_be_written_is_passed_over(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("FMU_CACHE_DIR", str(tmp_path / "file" / "bases"))
    store_basis(KEY, STATE)
    assert load_basis(KEY) is None


def blas_threads():
    return [pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"]


def test_blas_threads_are_given_back():
    with threadpool_limits(2):
        before = blas_threads()
        with single_thread():
            assert set(blas_threads()) == {1}
        assert blas_threads() == before
