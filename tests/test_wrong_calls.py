"""No wrong call of the public API ends in the words of Python or a library, and none is accepted in silence."""

import warnings
from collections.abc import Mapping, Sequence  # noqa: F401
from itertools import islice

import numpy as np
import pytest

import fmu
from fmu.arguments import check_arguments
from fmu.surrogates import learning
from tests import wrong_calls
from tests.pictures import without_pictures
from tests.wrong_calls import Call, may_be_accepted, outcome

LEAST = 800


@pytest.fixture(scope="module", params=[3, pytest.param(1, marks=pytest.mark.validate)], ids=["a third", "all"])
def outcomes(request, tmp_path_factory):
    """How wrong calls end; by default, each argument has a third of the wrong values, and the next one others."""
    assert len(wrong_calls.WRONG) % request.param or request.param == 1
    folder = tmp_path_factory.mktemp("wrong")
    with pytest.MonkeyPatch.context() as patch, warnings.catch_warnings(), without_pictures():
        warnings.simplefilter("ignore")
        patch.chdir(folder)
        patch.setattr(learning, "SurrogateModel", wrong_calls.stop)  # its arguments are checked before
        every = islice(wrong_calls.wrong_calls(folder), 0, None, request.param)
        found = {(call.name, name, key): (outcome(call, name, key), call) for call, name, key in every}
        return {
            (of, name, key): (said, said == "accepted" and may_be_accepted(call, name, key))
            for (of, name, key), (said, call) in found.items()
        }


def test_every_refusal_is_a_sentence_of_fmu(outcomes):
    other = {call: said for call, (said, _) in outcomes.items() if said not in ("refused", "accepted")}
    assert other == {}
    assert sum(said == "refused" for said, _ in outcomes.values()) > LEAST


def test_what_is_accepted_is_listed_by_rule(outcomes):
    assert {call for call, (said, may) in outcomes.items() if said == "accepted" and not may} == set()


def test_every_public_name_is_called(outcomes):
    called = {name.partition(".")[0] for name, _, _ in outcomes}
    assert set(fmu.__all__) - called == {
        "StoppedRun",
        "Uniform",
        "__version__",
    }  # raised, not called; no arguments


LISTED = {
    "model_sd": lambda: fmu.FrequencyErrors(model_sd="x"),
    "use": lambda: fmu.ModalData([1.0, 2.0], use="ab"),
    "softness": lambda: fmu.UpdatingProblem(**_posed(), softness=-1),
    "mass": lambda: fmu.PointMass(1, -1.0),
    "weights": lambda: fmu.MixtureSampler(weights="x!"),
    "offset": lambda: fmu.RigidArm(1, (0, 0)),
    "start": lambda: fmu.Parameter("k", None),
    "method": lambda: fmu.evidence(wrong_calls.material()["trace"], "x"),
    "chains": lambda: fmu.sample(wrong_calls.material()["problem"], chains=10**9),
    "workers": lambda: fmu.engine("tcp://head:8786"),
}


def _posed():
    made = wrong_calls.material()
    return {key: made[key] for key in ("model", "data")} | {
        "parameters": [made["parameter"]], "pairing": "index", "error": made["errors"]
    }  # fmt: skip


@pytest.mark.parametrize("name", LISTED)
def test_is_refused(name):
    with pytest.raises(ValueError, match=rf"^{name}: must .*\(got .*\)"):
        LISTED[name]()


def test_a_file_in_place_of_what_is_in_it():
    with pytest.raises(
        ValueError, match=r"^problem: .* \(got 'a.toml'\); load it first with fmu.load\('a.toml'\)"
    ):
        fmu.sample("a.toml")
    with pytest.raises(ValueError, match=r"^trace: .*; load it first with fmu.load_trace\('run/mh.nc'\)"):
        fmu.evidence("run/mh.nc")


def test_a_door_without_its_check_is_noticed():
    """The generator can fail: the same door is a fault without its check, and none with it."""

    def area(width: float) -> float:
        return width**2 if width != 0.0 else width.length

    for door, faults in ((area, True), (check_arguments(area), False)):
        found = [outcome(Call("area", door, {"width": 1.0}), "width", key) for key in ("None", "x", "[]", "0")]
        assert any(said not in ("refused", "accepted") for said in found[:3]) == faults
    assert outcome(Call("area", check_arguments(area), {"width": 1.0}), "width", "0").startswith("AttributeError")
    assert outcome(Call("id", lambda width: width, {"width": 1.0}), "width", "x") == "accepted"
    assert not may_be_accepted(Call("area", area, {}), "width", "x")


@pytest.mark.parametrize(
    ("rule", "right", "wrong"),
    [
        ("int", (3, np.int64(3)), (3.0, True, "3", np.float64(3))),
        ("float", (3, 0.5, np.float32(0.5)), (np.nan, np.inf, True, 10**400)),
        ("Positive | None", (1, None), (0, -1.0)),
        ("Sequence[str]", (["a"], ("a", "b"), np.array(["a"])), ("ab", [1], {"a": 1}, None)),
        ("tuple[float, float]", ((1, 2), [1.0, 2.0]), ((1,), (1, "x"), 3.0)),
        ("Mapping[str, Positive]", ({"a": 1.0}, {}), ({"a": 0.0}, {1: 1.0}, [("a", 1.0)])),
        ("ArrayLike", (1.0, [1, 2], np.eye(2)), ("1", [None], [True], [[1], [1, 2]], 1j)),
        ("str | os.PathLike[str]", ("a", wrong_calls.Path("a")), ("", "a\0", 1)),
        ("xr.DataTree | None", (None,), ("a.nc", {})),
    ],
)
def test_rules(rule, right, wrong):
    def door(value):
        return value

    door.__annotations__["value"] = rule
    checked = check_arguments(door)
    for value in right:
        assert checked(value) is value
    for value in wrong:
        with pytest.raises(ValueError, match=r"^value"):
            checked(value)
