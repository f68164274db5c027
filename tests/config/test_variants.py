"""Problem files with another discrepancy of the model."""

import tomllib
from typing import get_args

import numpy as np
import pytest

import fmu
from fmu.config.discrepancy import DiscrepancyTable
from fmu.config.variants import INFERRED_SD, NOISE, VARIANTS, with_discrepancy
from tests.cli.runs import PROBLEM, SECOND

BETA = PROBLEM.replace("sd = 0.3", "beta = [2.0, 8.0]  # trust")
HALF_NORMAL = {"distribution": "half-normal", "sd": INFERRED_SD}


def loaded(text, folder):
    (folder / "two.toml").write_text(text)
    (folder / "k2.csv").write_text(SECOND)
    return fmu.load(folder / "two.toml")


def test_every_kind_of_discrepancy_is_a_variant():
    kinds = set(get_args(DiscrepancyTable.model_fields["kind"].annotation))
    assert {one.kind for one in VARIANTS.values()} - {""} == kinds
    assert next(iter(VARIANTS)) == "none"


@pytest.mark.parametrize("text", [PROBLEM, BETA])
def test_the_file_keeps_all_but_its_discrepancy(text):
    before = tomllib.loads(text)
    embedded = with_discrepancy(text, "embedded")
    assert embedded.startswith(text)
    assert tomllib.loads(embedded) == before | {"discrepancy": [{"kind": "embedded", "by": "common"}]}
    grouped = tomllib.loads(with_discrepancy(embedded, "embedded-by-group"))
    assert grouped == before | {"discrepancy": [{"kind": "embedded", "by": "group"}]}
    assert tomllib.loads(with_discrepancy(embedded, "none")) == before


def test_a_discrepancy_of_the_same_kind_keeps_its_prior():
    text = with_discrepancy(PROBLEM, "embedded").replace('kind = "embedded"', 'kind = "embedded"\nprior_sd = 0.3')
    found = tomllib.loads(with_discrepancy(text, "embedded-by-group"))["discrepancy"]
    assert found == [{"kind": "embedded", "prior_sd": 0.3, "by": "group"}]


@pytest.mark.parametrize("text", [PROBLEM, BETA])
def test_an_inferred_sd_of_zero_is_the_density_without(text, tmp_path):
    without, inferred = (loaded(one, tmp_path) for one in (text, with_discrepancy(text, "inferred")))
    assert inferred.names == (*without.names, NOISE)
    assert inferred.parameters[-1].prior.as_dict() == HALF_NORMAL | {"at": 0.0}
    theta = without.start * 1.01
    at = np.append(theta, 1e-12)
    assert inferred.log_likelihood(at) == pytest.approx(without.log_likelihood(theta), rel=1e-9)
    f, sd = np.asarray(without.data.frequencies_hz), np.array([0.3, 0.3] if text == PROBLEM else [0.5, 0.25])
    total, r = np.sqrt(sd**2 + (0.02 * f) ** 2), without.frequencies(theta) - f
    expected = np.sum(-0.5 * (r / total) ** 2 - np.log(total) - 0.5 * np.log(2 * np.pi))
    assert inferred.log_likelihood(np.append(theta, 0.02)) == pytest.approx(expected, rel=1e-12)


def test_an_inferred_sd_joins_the_errors_of_the_file():
    text = PROBLEM + '[[error]]\nof = "frequencies"\nkind = "absolute"\nsd = 0.2\n'
    found = tomllib.loads(with_discrepancy(text, "inferred"))
    assert found["error"] == [{"of": "frequencies", "kind": "absolute", "sd": 0.2, "discrepancy": NOISE}]
    assert found["noise"][0]["prior"]["sd"] == pytest.approx(INFERRED_SD * 7.5)
    again = with_discrepancy(with_discrepancy(text, "inferred"), "inferred")
    assert tomllib.loads(again) == found


def test_files_without_suitable_errors_are_refused():
    for text, words in (
        ('error = "modal-residual"\n' + PROBLEM, r"error: must be of frequencies .* \(got 'modal-residual'\)"),
        (PROBLEM + '[[error]]\nof = "shapes"\nsd = 0.1\n', "error: must be of frequencies"),
        (BETA.replace("frequencies = [4.1, 10.9]", 'csv = "modes.csv"'), "measurement.frequencies: must be given"),
    ):
        with pytest.raises(ValueError, match=words):
            with_discrepancy(text, "inferred")
