"""Names that mean something elsewhere go through a whole run; those that cannot are refused before it."""

import json

import numpy as np
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
dofs = [{dofs}]
{terms}
[measurement]
frequencies = {frequencies}
labels = {labels}
sd = 0.1
{parameters}"""
TERM = """
[[model.{kind}]]
matrix = {matrix}
powers = {{ {name} = 1 }}
"""
PARAMETER = """
[[parameters]]
name = {name}
unit = {unit}
start = 1.1
lower = 0.5
upper = 2.0
"""
NAMES = ("$$", r"$\undefined$", "share", '<b>"it\'s, θ₁ a|b" 50%_')
UNITS = ('href="data:image/png;base64,A"', "data:image/png;base64,AAAA", r"$\undefined$ </text>", "|")
LABELS = ("$ $ |", "parameter")
TITLE = '$x$ <!-- " <title>'


def write(folder, names=("a", "b", "c", "d"), units=("",) * 4, labels=("1", "2"), title="t"):
    """Storeys above each other, as many as measured modes, of which each stiffness and mass is a parameter."""
    n, terms = len(labels), ""
    for k, name in enumerate(names):
        kind, value, of = ("stiffness", 3e7, k) if k < n else ("mass", 16e3, k - n)
        ends = np.eye(n)[of]
        if kind == "stiffness" and of:
            ends[of - 1] = -1.0
        matrix = (value * np.outer(ends, ends)).tolist()
        terms += TERM.format(kind=kind, matrix=matrix, name=json.dumps(name))
    text = FILE.format(
        title=json.dumps(title),
        dofs=", ".join(f'["floor {k + 1}", "x"]' for k in range(n)),
        terms=terms,
        frequencies=[4.4, 10.7],
        labels=json.dumps(labels),
        parameters="".join(
            PARAMETER.format(name=json.dumps(name), unit=json.dumps(unit))
            for name, unit in zip(names, units, strict=False)
        ),
    )
    path = folder / "problem.toml"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.usefixtures("quick_figures")
def test_names_that_mean_something_elsewhere(tmp_path):
    """In HTML, in the mathematics of Matplotlib, in Markdown, and in the tables that fmu writes."""
    path, out = write(tmp_path, NAMES, UNITS, LABELS, TITLE), tmp_path / "run"
    length = ["--draws", "12", "--warmup", "10", "--chains", "2", "--starts", "4"]
    done = CliRunner().invoke(main, ["run", str(path), *length, "--out", str(out)])
    assert done.exit_code == 0, done.output
    trace = fmu.load_trace(out / "mixture.nc")
    assert tuple(fmu.summary(trace).index) == NAMES
    assert tuple(pd.read_csv(out / "summary-mixture.csv", index_col=0, na_filter=False).index) == NAMES
    found = pd.read_csv(out / "map.csv", index_col=0)
    assert found.columns.is_unique
    best = fmu.find_map(fmu.load(path), starts=4)[0].theta
    for name, value in zip(NAMES, best, strict=True):
        assert found[f"{name}_" if name == "share" else name][1] == value
    page = Parsed((out / "report" / "index.html").read_text(encoding="utf-8"))
    assert page.foreign_scripts == []
    for name in (*NAMES, *UNITS, *LABELS, TITLE):
        assert name in page.text
    done = CliRunner().invoke(main, ["export", str(out)])
    assert done.exit_code == 0, done.output
    assert fmu.load(out / "export" / "updated.toml").names == NAMES


@pytest.mark.parametrize("name", ["chain", "draw", ".", "..", " a", "a ", "a\u202eb", "a\u00a0b", "a\x7fb"])
def test_names_that_no_trace_can_keep(name, tmp_path):
    with pytest.raises(ValueError, match=r"parameters\.0\.name: must ") as refused:
        fmu.load(write(tmp_path, (name, *"bcd")))
    assert f"(got {name!r})" in str(refused.value)
    with pytest.raises(ValueError, match=r"^name: must "):
        fmu.Parameter(name, start=1.0, lower=0.0, upper=2.0)


def test_all_of_them_are_told_at_once(tmp_path):
    with pytest.raises(ValueError, match="2 errors") as refused:
        fmu.load(write(tmp_path, ("chain", "draw", "c", "d")))
    assert "parameters.0.name: must not be 'chain', 'draw'" in str(refused.value)
    assert "parameters.1.name: must not be 'chain', 'draw'" in str(refused.value)


def test_a_density_whose_names_no_trace_can_keep_is_not_sampled():
    class Named:
        ndim, names, lower, upper = 1, ("draw",), [-1.0], [1.0]

        def log_prob(self, x):
            raise AssertionError("is not asked")

    with pytest.raises(ValueError, match=r"^name: must not be .*\(got 'draw'\)"):
        fmu.sample(Named())
