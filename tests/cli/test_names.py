"""Names that mean something elsewhere go through a whole run; those that cannot are refused before it."""

import json

import pandas as pd
import pytest
from click.testing import CliRunner

import fmu
from fmu.cli import main
from tests.report.parsed import Parsed

FILE = """
name = {title}
pairing = "index"
[model]
type = "matrices"
dofs = [["floor 1", "x"], ["floor 2", "x"]]
[[model.stiffness]]
matrix = [[29.7e6, 0.0], [0.0, 0.0]]
powers = {{ {one} = 1 }}
[[model.stiffness]]
matrix = [[29.7e6, -29.7e6], [-29.7e6, 29.7e6]]
powers = {{ {two} = 1 }}
[[model.mass]]
matrix = [[16.5e3, 0.0], [0.0, 16.1e3]]
[measurement]
frequencies = [4.4, 10.7]
labels = [{label}, "2"]
sd = 0.1
[[parameters]]
name = {one}
unit = {unit}
start = 1.3
lower = 0.1
upper = 3.0
[[parameters]]
name = {two}
start = 0.8
lower = 0.1
upper = 3.0
"""


def write(folder, one="a", two="b", label="1", unit="", title="t"):
    names = {"one": one, "two": two, "label": label, "unit": unit, "title": title}
    path = folder / "problem.toml"
    path.write_text(FILE.format(**{key: json.dumps(name) for key, name in names.items()}), encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("one", "two", "label", "unit", "title"),
    [
        ("$$", r"$\undefined$", "$ $", 'href="data:image/png;base64,A"', "$x$ <!--"),
        ("E wing, θ₁ 50%_", "a|b", "|", "data:image/png;base64,AAAA", '"'),
        ("share", '<b>"it\'s"', "parameter", r"$\undefined$ </text>", "<title>"),
    ],
)  # fmt: skip
def test_names_that_mean_something_elsewhere(one, two, label, unit, title, tmp_path):
    path, out = write(tmp_path, one, two, label, unit, title), tmp_path / "run"
    length = ["--draws", "30", "--warmup", "20", "--chains", "2", "--starts", "4"]
    done = CliRunner().invoke(main, ["run", str(path), *length, "--out", str(out)])
    assert done.exit_code == 0, done.output
    trace = fmu.load_trace(out / "hmc.nc")
    assert list(fmu.summary(trace).index) == [one, two]
    assert pd.read_csv(out / "summary-hmc.csv", index_col=0, na_filter=False).index.tolist() == [one, two]
    found = pd.read_csv(out / "map.csv", index_col=0)
    assert found.columns.is_unique
    assert found[f"{one}_" if one == "share" else one][1] == fmu.find_map(fmu.load(path), starts=4)[0].theta[0]
    page = Parsed((out / "report" / "hmc.html").read_text(encoding="utf-8"))
    assert not page.all("script")
    for name in (one, two, label, unit, title):
        assert name in page.text
    done = CliRunner().invoke(main, ["export", str(out)])
    assert done.exit_code == 0, done.output
    assert fmu.load(out / "export" / "updated.toml").names == (one, two)


@pytest.mark.parametrize("name", ["chain", "draw", ".", "..", " a", "a ", "a\u202eb", "a\u00a0b", "a\x7fb"])
def test_names_that_no_trace_can_keep(name, tmp_path):
    with pytest.raises(ValueError, match=r"parameters\.0\.name: must ") as refused:
        fmu.load(write(tmp_path, name))
    assert f"(got {name!r})" in str(refused.value)
    with pytest.raises(ValueError, match=r"^name: must "):
        fmu.Parameter(name, start=1.0, lower=0.0, upper=2.0)


def test_all_of_them_are_told_at_once(tmp_path):
    with pytest.raises(ValueError, match="2 errors") as refused:
        fmu.load(write(tmp_path, "chain", "draw"))
    assert "parameters.0.name: must not be 'chain', 'draw'" in str(refused.value)
    assert "parameters.1.name: must not be 'chain', 'draw'" in str(refused.value)


def test_a_density_whose_names_no_trace_can_keep_is_not_sampled():
    class Named:
        ndim, names, lower, upper = 1, ("draw",), [-1.0], [1.0]

        def log_prob(self, x):
            raise AssertionError("is not asked")

    with pytest.raises(ValueError, match=r"^name: must not be .*\(got 'draw'\)"):
        fmu.sample(Named())
