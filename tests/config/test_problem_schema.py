"""The schema that editors get: a schema itself, true of every file that is right, false of broken ones."""

import tomllib

import pytest

from fmu import cases
from fmu.config.parameters import Target
from fmu.config.problem import DIALECT, schema
from fmu.config.template import KINDS, template

jsonschema = pytest.importorskip("jsonschema")

FILES = {name: cases.path(name).read_text(encoding="utf-8") for name in cases.names()}
FILES |= {kind: template(kind) for kind in KINDS}


@pytest.fixture(scope="module")
def validator():
    return jsonschema.Draft202012Validator(schema())


def test_it_is_a_schema():
    jsonschema.Draft202012Validator.check_schema(schema())
    assert schema()["$schema"] == DIALECT
    assert schema()["title"]


@pytest.mark.parametrize("name", FILES)
def test_every_file_of_the_package_is_valid(validator, name):
    assert [error.message for error in validator.iter_errors(tomllib.loads(FILES[name]))] == []


@pytest.mark.parametrize(
    ("broken", "words"),
    [
        (lambda file: file.pop("measurement"), "not valid under any of the given schemas"),
        (lambda file: file.update(colour="red"), "'colour' was unexpected"),
        (lambda file: file["measurement"].update(frequencies=["high"]), "'high'"),
        (lambda file: file["model"].update(type="shell"), "shell"),
        (lambda file: file["model"]["members"][0].update({"elements": 0}), "0"),
        (lambda file: file["parameters"][0].update(start=None), "None"),
    ],
)
def test_a_broken_file_is_not(validator, broken, words):
    file = tomllib.loads(FILES["frame"])
    broken(file)
    assert any(words in str(error) for error in validator.iter_errors(file))


def test_keys_are_described_and_none_can_be_null():
    text = str(schema())
    assert "'null'" not in text
    tables = {name: table for name, table in schema()["$defs"].items() if table["type"] == "object"}
    assert [name for name, table in tables.items() if not table.get("description")] == []
    member = tables["Member"]
    assert {"from", "to"} <= set(member["required"])
    for name in ("MeasurementTable", "ParameterTable"):
        keys = {key: value for key, value in tables[name]["properties"].items() if "description" not in value}
        assert set(keys) <= set(Target.model_fields)
    assert schema()["properties"]["pairing"]["description"].startswith("How computed modes")
