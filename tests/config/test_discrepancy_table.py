"""Tables ``[[discrepancy]]`` of problem files."""

import pytest

import fmu

MODEL = fmu.cases.path("shear-2dof").read_text()


def load(folder, table, text=MODEL):
    """Return the problem of a file with a table before its first one."""
    path = folder / "problem.toml"
    head, tables = text.split("\n[", 1)
    path.write_text(f"{head}\n{table}\n[{tables}")
    return fmu.load(path)


@pytest.mark.parametrize(
    "settings",
    [
        {"kind": "embedded", "groups": ("k1",), "prior_sd": 0.2, "name": "scatter"},
        {"kind": "embedded", "tau": 0.05},
        {"kind": "modes", "sd": 0.02},
        {"kind": "modes", "correlation": 0.5},
        {"kind": "embedded", "correlation": "inferred"},
    ],
)
def test_a_table_is_the_object_of_the_same_settings(tmp_path, settings):
    plain = fmu.cases.load("shear-2dof")
    settings = {key: (plain.names[0],) if key == "groups" else value for key, value in settings.items()}
    keys = [f"{key} = {list(value) if isinstance(value, tuple) else value!r}" for key, value in settings.items()]
    problem = load(tmp_path, "\n".join(["[[discrepancy]]", *keys]).replace("'", '"'))
    made = fmu.UpdatingProblem(
        plain.model.structure,
        plain.data,
        plain.parameters,
        pairing="index",
        error=fmu.FrequencyErrors("eigenvalue", sd=0.0625),
        discrepancy=fmu.Discrepancy(**settings),
    )
    assert problem.names == made.names
    assert problem.log_prob(problem.start) == pytest.approx(made.log_prob(made.start), abs=1e-4)
    assert problem.log_prob(problem.start) != pytest.approx(plain.log_prob(plain.start), abs=1e-2)


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ('kind = "mode"', "discrepancy.0.kind"),
        ('kind = "embedded"\ntau = -1.0', "discrepancy.0.tau"),
        ('kind = "modes"\ncorrelation = 1.0', 'discrepancy.correlation: must be less than 1 with kind = "modes"'),
        ('kind = "embedded"\ncorrelation = "common"', "discrepancy.0.correlation"),
        ('kind = "modes"\ntau = 0.1', 'discrepancy.tau: must not be given with kind = "modes"'),
        ('kind = "embedded"\ngroups = ["roof"]', "discrepancy.groups: must be of"),
    ],
)
def test_mistakes_are_reported_at_their_key(tmp_path, table, message):
    with pytest.raises(fmu.config.ConfigurationError, match=message):
        load(tmp_path, f"[[discrepancy]]\n{table}\n")
