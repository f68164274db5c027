import math

import numpy as np
import pytest

from fmu.runs import identity
from fmu.runs.identity import FILE, Identity

CONFIGURATION = {"problem": {"name": "beam", "lower": [0.0, -math.inf]}, "run": {"seed": 1, "groups": None}}


def of(**run):
    return Identity.of({**CONFIGURATION, "run": {**CONFIGURATION["run"], **run}})


@pytest.fixture
def kept(tmp_path):
    of().write(tmp_path)
    return tmp_path


def test_it_comes_back(kept):
    assert Identity.read(kept) == of()
    assert Identity.read(kept).hash == of().hash
    of().check(kept)


def test_none(tmp_path):
    assert Identity.read(tmp_path) is None
    of().check(tmp_path)


def test_numpy_and_nan_are_the_numbers_that_they_hold(tmp_path):
    of(start=np.array([[1.5, math.nan]]), seed=np.int64(1)).write(tmp_path)
    of(start=[[1.5, math.nan]]).check(tmp_path)
    assert of(start=np.array([1.5])).hash == of(start=(1.5,)).hash


@pytest.mark.parametrize(
    ("run", "message"),
    [
        ({"seed": 2}, "contains another run: run.seed 1 there, 2 here$"),
        ({"groups": 2}, "contains another run: run.groups null there, 2 here$"),
        ({"init": [[1.0]]}, r"contains another run: run.init null there, \[\[1.0\]\] here$"),
        ({f"x{k}": k for k in range(5)}, "run.x0 null there, 0 here; .*; run.x2 null there, 2 here, and 2 more$"),
        ({"init": list(range(100))}, r"run.init null there, \[0, 1, .*… here$"),
    ],
)
def test_what_differs_is_named(kept, run, message):
    with pytest.raises(ValueError, match=message) as error:
        of(**run).check(kept)
    assert str(error.value).startswith(f"checkpoint: {kept} ")
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < len(str(kept)) + 250


def test_what_differs_deep_down_is_named(tmp_path):
    one, other = ({"model": {"parts": [{"E": 1.0}, {"E": E}], "n": 3}} for E in (2.0, 2.5))
    Identity.of(one).write(tmp_path)
    with pytest.raises(ValueError, match=r"contains another run: model.parts.1.E 2.0 there, 2.5 here$"):
        Identity.of(other).check(tmp_path)


@pytest.mark.parametrize("package", ["fmu", "numpy", "scipy", "emcee"])
def test_other_versions_are_refused(kept, monkeypatch, package):
    now = identity.versions()
    monkeypatch.setattr(identity, "versions", lambda: now | {package: "99.9"})
    message = (
        f"was written with {package} {now[package]} and can be resumed .* that version only .installed: 99.9.$"
    )
    with pytest.raises(ValueError, match=message):
        of().check(kept)
    assert of().hash != Identity.read(kept).hash


def test_a_version_that_draws_do_not_depend_on_does_not_matter(kept, monkeypatch):
    now = identity.versions()
    monkeypatch.setattr(identity, "versions", lambda: now | {"arviz": "99.9", "python": "99.9"})
    of().check(kept)
    assert of().hash == Identity.read(kept).hash


@pytest.mark.parametrize("damage", [lambda c: b"", lambda c: c[:-1], lambda c: c[:-3] + b"#" + c[-2:]])
def test_a_damaged_file_says_nothing(kept, damage):
    path = kept / FILE
    path.write_bytes(damage(path.read_bytes()))
    of(seed=2).check(kept)
