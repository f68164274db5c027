import dataclasses
import hashlib
import importlib.metadata
import json

import numpy as np
import pytest

from fmu.analysis.trace.provenance import attributes, canonical_json, configuration, configuration_hash


def test_canonical_json_does_not_depend_on_order_or_container():
    first = {"b": (1, 2.5), "a": {"y": np.float64(0.1), "x": np.arange(2)}}
    second = {"a": {"x": [0, 1], "y": 0.1}, "b": [1, 2.5]}
    assert canonical_json(first) == canonical_json(second) == '{"a":{"x":[0,1],"y":0.1},"b":[1,2.5]}'


def test_hash_is_the_sha256_of_the_canonical_json():
    assert configuration_hash({"b": 1, "a": [1.5]}) == hashlib.sha256(b'{"a":[1.5],"b":1}').hexdigest()


def test_only_plain_data_can_be_configured():
    with pytest.raises(TypeError, match="got object"):
        canonical_json({"a": object()})


@pytest.fixture
def result(make_result):
    return make_result(np.zeros((2, 4, 2)))


@pytest.mark.parametrize(
    "change",
    [
        {"seed": 6},
        {"settings": {"scale": 0.2}},
        {"sampler": "slice"},
        {"draws": 5},
        {"warmup_draws": 3},
        {"chains": 3},
        {"walkers": 2},
        {"init": "start"},
    ],
    ids=lambda change: next(iter(change)),
)
def test_everything_that_determines_the_draws_changes_the_hash(result, problem, change):
    changed = dataclasses.replace(result, **change)
    assert configuration_hash(configuration(changed, problem)) != configuration_hash(
        configuration(result, problem)
    )


def test_hash_knows_the_problem_and_the_start(result, problem, plain):
    hashes = {
        configuration_hash(configuration(result, problem)),
        configuration_hash(configuration(result, plain)),
        configuration_hash(configuration(result, problem, np.zeros((2, 2)))),
        configuration_hash(configuration(result, problem, np.ones((2, 2)))),
    }
    assert len(hashes) == 4


def test_time_does_not_change_the_hash(result, problem):
    slower = dataclasses.replace(result, wall_s=99.0)
    assert configuration(slower, problem) == configuration(result, problem)


def test_attributes_are_plain_and_count_the_warm_up_apart(result, problem):
    attrs = attributes(result, problem)
    assert all(isinstance(value, str | int | float) for value in attrs.values())
    assert (attrs["n_solves"], attrs["n_gradients"]) == (2 * 4 * 3, 2 * 4 * 2)
    assert (attrs["warmup_n_solves"], attrs["warmup_n_gradients"]) == (2 * 2 * 3, 2 * 2 * 2)
    assert (attrs["problem"], attrs["sampler"], attrs["seed"], attrs["walkers"]) == ("linear", "mh", 5, 1)
    assert (attrs["draws"], attrs["warmup"], attrs["chains"], attrs["init"]) == (4, 2, 2, "prior")
    assert (attrs["wall_s"], attrs["warmup_wall_s"]) == (2.0, 0.5)
    assert json.loads(attrs["settings"]) == {"scale": 0.1}
    assert attrs["configuration_hash"] == hashlib.sha256(attrs["configuration"].encode()).hexdigest()
    versions = json.loads(attrs["versions"])
    assert set(versions) == {"python", "numpy", "scipy", "emcee", "arviz", "fmu"}
    assert versions["numpy"] == np.__version__
    assert versions["emcee"] == importlib.metadata.version("emcee")
