"""Tables ``[[discrepancy]]`` of problem files."""

import numpy as np
import pytest

import fmu
from fmu.posterior.discrepancy.embedded import Discrepancy

MODEL = fmu.cases.path("shear-2dof").read_text()


def load(folder, table):
    """Return the built-in building of two storeys with a table before its first one."""
    path = folder / "problem.toml"
    head, tables = MODEL.split("\n[", 1)
    path.write_text(f"{head}\n{table}\n[{tables}")
    return fmu.load(path)


def test_a_table_is_the_object_of_the_same_settings(tmp_path):
    plain = fmu.cases.load("shear-2dof")
    name = plain.names[0]
    table = f'[[discrepancy]]\nkind = "embedded"\ngroups = ["{name}"]\nprior_sd = 0.2\nname = "scatter"\n'
    problem = load(tmp_path, table)
    assert problem.names == (*plain.names, "scatter")
    theta = np.array([[*plain.start, 0.1]])
    settings = Discrepancy(groups=(name,), prior_sd=0.2, name="scatter")
    made = fmu.UpdatingProblem(
        plain.model.structure, plain.data, plain.parameters, pairing="index", discrepancy=settings
    )
    assert made.log_prob(theta) == pytest.approx(problem.log_prob(theta), abs=1e-4)


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ('kind = "modes"', "discrepancy.1.kind"),
        ('kind = "embedded"\ntau = -1.0', "discrepancy.1.tau"),
        ('kind = "embedded"\ngroups = ["roof"]', "discrepancy.groups"),
    ],
)
def test_mistakes_are_reported_at_their_key(tmp_path, table, message):
    with pytest.raises(fmu.ConfigurationError, match=message):
        load(tmp_path, f"[[discrepancy]]\n{table}\n")
