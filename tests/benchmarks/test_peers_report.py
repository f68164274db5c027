"""The page of the peers: what it says follows from the figures of one run, and its picture has all rows."""

import json

import pytest

from tests.benchmarks.peers import figure, report

SAME = "same model, JAX"
# label, model, cost of an evaluation; ESS, evaluations and seconds of the draws (of the warm-up: half as many)
CONTENDERS = (
    ("mixture", "fmu", 1.0, 4000.0, 10_000, 1.5),
    ("hmc", "fmu", 2.0, 1000.0, 10_000, 2.0),
    ("mh", "fmu", 1.0, 400.0, 10_000, 1.0),
    ("emcee", "fmu", 1.0, 100.0, 10_000, 1.0),
    ("NumPyro NUTS", SAME, 1.5, 500.0, 20_000, 50.0),
    ("NumPyro NUTS, dense mass matrix", SAME, 1.5, 300.0, 30_000, 10.0),
    ("nutpie NUTS", "fmu", 2.0, 100.0, 30_000, 20.0),
    ("PINTS adaptive MH", "fmu", 1.0, 90.0, 10_000, 1.0),
    ("emcee, default moves", "fmu", 1.0, 450.0, 40_000, 1.0),
    ("NumPyro NUTS", "weak plane, JAX", 1.5, 500.0, 20_000, 500.0),
    ("emcee, default moves", "SciPy, 300 DOF", 1.0, 450.0, 40_000, 500.0),
    ("emcee, default moves", "SciPy, weak plane", 1.0, 450.0, 40_000, 50.0),
)
NEAR = {"cantilever-young": 0.08, "shear-10dof": 0.001}


def run(ess, evaluations, seconds):
    draws = {"cpu_s": seconds, "wall_s": seconds, "evaluations": evaluations}
    warmup = {name: value / 2 for name, value in draws.items()}
    return {"ess": ess, "rhat": 1.001, "warmup": warmup, "draws": draws, "mean": [0.0], "mcse": [0.1]}


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """Write page and picture of the contenders; return the page and the picture's names of bars by posterior."""
    drawn, folder = [], tmp_path_factory.mktemp("written")
    rows = [
        {"case": case, "label": label, "model": model, "unit": "gradient", "cost": cost, "prepared_s": 1.0}
        | {"runs": [run(*figures)]}
        for case in NEAR
        for label, model, cost, *figures in CONTENDERS
    ]
    result = {"versions": {}, "differences": {"a": {"b": 1e-9}}, "near_a_bound": NEAR, "rows": rows}
    (folder / "run.json").write_text(json.dumps(result))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(report, "draw", lambda *a: drawn.append(figure.draw(*a)))
        report.main(*(str(folder / name) for name in ("run.json", "page.md", "benchmarks/peers.png")))
    axes = drawn[0].axes[::2]
    bars = {a.get_title("left"): [tick.get_text() for tick in a.get_yticklabels()] for a in axes}
    return (folder / "page.md").read_text(), bars, folder


def test_the_picture_has_every_row_of_the_tables_and_is_where_the_page_says(written):
    page, bars, folder = written
    assert list(bars) == list(NEAR)
    for case, names in bars.items():
        table = page.split(f"### {case}")[1].split("\n\n")[1]
        listed = [line.split("|")[1].strip(" *") for line in table.splitlines()[2:]]
        assert listed == names[::-1]  # from below
        assert len(listed) == len(CONTENDERS)
    assert "![ESS per solve and per second](benchmarks/peers.png)" in page
    assert (folder / "benchmarks" / "peers.png").exists()


def test_ratios_are_those_to_the_best_of_every_nuts_on_the_same_model(written):
    page, *_ = written
    # per gradient 0.1 against 0.025 of the diagonal one; per second 500 against 30 of the dense one
    assert "| cantilever-young | 8 % | 4 × (4 ×) | 17 × (17 ×) |" in page
    assert (
        "per gradient and per second: 4 × and 17 × on cantilever-young, whose posteriors lie at bounds; 4 × and "
        "17 × on shear-10dof, whose posterior has no active bounds.**"
    ) in page


def test_per_solve_a_gradient_counts_as_what_it_costs(written):
    page, *_ = written
    assert "| **fmu hmc** | gradient | 2 | 0.1 | 0.05 | 0.033 | 500 | 330 | 1.001 | 0.0 |" in page
    assert "| NumPyro NUTS | gradient | 1.5 | 0.025 | 0.017 | 0.011 | 10 | 6.7 | 1.001 |" in page
    assert "fmu's HMC 2.0 (cantilever-young), 2.0 (shear-10dof)" in page
