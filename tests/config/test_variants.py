"""Problem files with another discrepancy of the model."""

import tomllib
from typing import get_args

import numpy as np
import pytest

import fmu
from fmu.config.discrepancy import DiscrepancyTable
from fmu.config.variants import VARIANTS, with_discrepancy
from tests.cli.runs import PROBLEM, SECOND

BETA = PROBLEM.replace("sd = 0.3", "beta = [2.0, 8.0]  # trust")


def loaded(text, folder):
    (folder / "two.toml").write_text(text)
    (folder / "k2.csv").write_text(SECOND)
    return fmu.load(folder / "two.toml")


def test_every_kind_of_discrepancy_is_a_variant():
    kinds = set(get_args(DiscrepancyTable.model_fields["kind"].annotation))
    assert {one.keys["kind"] for one in VARIANTS.values() if one.keys} == kinds
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


def test_every_discrepancy_of_the_same_kind_stays(tmp_path):
    """Two scatters, one of them in common, as the guide advises; tables that then differ in name alone are one."""
    common = '[[discrepancy]]\nkind = "embedded"\ncorrelation = 1.0\nname = "in common"\n'
    errors = '[[discrepancy]]\nkind = "modes"\ncorrelation = 0.5\nname = "other"\n'
    text = f"{with_discrepancy(PROBLEM, 'embedded')}\n{common}\n{errors}\n" + errors.replace("other", "more")
    names = loaded(with_discrepancy(text, "embedded"), tmp_path).names
    assert names[-2:] == ("tau", "in common")
    found = tomllib.loads(with_discrepancy(text, "embedded-by-group"))["discrepancy"]
    of_common = {"kind": "embedded", "correlation": 1.0, "name": "in common", "by": "group"}
    assert found == [{"kind": "embedded", "by": "group"}, of_common]
    found = tomllib.loads(with_discrepancy(text, "inferred"))["discrepancy"]
    assert found == [{"kind": "modes", "correlation": 0.0, "name": "other"}]


def test_an_inferred_error_is_the_same_share_of_every_frequency(tmp_path):
    without, inferred = (loaded(one, tmp_path) for one in (BETA, with_discrepancy(BETA, "inferred")))
    assert len(inferred.names) == len(without.names) + 1
    theta = without.start * 1.01
    computed, f, sd = without.frequencies(theta), np.asarray(without.data.frequencies_hz), np.array([0.5, 0.25])
    total = np.sqrt(sd**2 + (0.02 * f) ** 2)
    expected = np.sum(-0.5 * ((computed - f) / total) ** 2 - np.log(total) - 0.5 * np.log(2 * np.pi))
    assert inferred.log_likelihood(np.append(theta, 0.02)) == pytest.approx(expected, rel=1e-9)


def test_errors_in_common_have_a_correlation(tmp_path):
    names = loaded(with_discrepancy(PROBLEM, "modes"), tmp_path).names
    assert len(names) == len(loaded(with_discrepancy(PROBLEM, "inferred"), tmp_path).names) + 1


@pytest.mark.parametrize(
    "known", ["", "correlation = 0.0\n", "correlation = 0.3\n", "sd = 0.02\ncorrelation = 0.0\n"]
)
def test_errors_are_correlated_or_not_whatever_the_file_says(tmp_path, known):
    """A correlation of 0 in the file stayed, and a model was compared with itself."""
    text = f'{PROBLEM}\n[[discrepancy]]\nkind = "modes"\n{known}'
    one, other = (loaded(with_discrepancy(text, name), tmp_path).names for name in ("inferred", "modes"))
    assert other == (*one, "model error correlation")
    assert ("model error" in one) == ("sd" not in known)  # a standard deviation of the file stays
