"""The page of the peers: what it says follows from the figures of one run, and its picture has all rows."""

import json

import pytest

from tests.benchmarks.peers import figure, report
from tests.benchmarks.peers.target import Target
from tests.benchmarks.peers.whole_runs import page, runs
from tests.benchmarks.peers.whole_runs.rows import WholeRow

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
# whose, label, ESS, evaluations of the draws (before them: 5000), mean, log-evidence
WHOLE = (
    ("fmu", "mixture", 4000.0, 8000, 0.0, -28.33),
    ("fmu", "hmc", 4000.0, 80_000, 0.0, None),
    ("peer", "nautilus", 16_000.0, 59_000, 0.0, -28.32),
    ("peer", "nautilus, no networks", 20_000.0, 195_000, 0.0, -28.32),
    ("peer", "dynesty, dynamic", 4000.0, 65_000, 0.0, -28.3),
)
POSTERIOR = "cantilever-young, pairing by shape"
NEAR = {"cantilever-young": 0.08, "shear-10dof": 0.001}


def run(ess, evaluations, seconds):
    draws = {"cpu_s": seconds, "wall_s": seconds, "evaluations": evaluations}
    warmup = {name: value / 2 for name, value in draws.items()}
    return {"ess": ess, "rhat": 1.001, "warmup": warmup, "draws": draws, "mean": [0.0], "mcse": [0.1]}


def whole_run(ess, evaluations, mean, log_evidence, *, ended=True):
    def cost(n):
        return {"cpu_s": n / 10_000, "wall_s": n / 10_000, "evaluations": n}

    evidence = None if log_evidence is None else [log_evidence, 0.004]
    costs = {"search": cost(2000), "warmup": cost(3000), "draws": cost(evaluations)}
    return {"ess": ess, "mean": [mean, 0.0], "mcse": [0.01, 0.01], "evidence": evidence, "ended": ended} | costs


def whole_row(whose, label, *figures, **other):
    return {"posterior": POSTERIOR, "whose": whose, "label": label, "runs": [whole_run(*figures, **other)]}


def whole_page(*changed):
    """Return the page of the whole runs, some of them changed."""
    own = {row["label"]: row for row in changed}
    rows = [own.get(label, whole_row(whose, label, *figures)) for whose, label, *figures in WHOLE]
    return "\n".join(page.page([WholeRow.read(row) for row in rows]))


def line_of(text, name):
    return next(line for line in text.splitlines() if line.startswith(f"| {name} |"))


@pytest.fixture
def written(tmp_path, monkeypatch):
    """Write page and picture of the contenders; return the page and the picture's names of bars by posterior."""
    drawn = []
    monkeypatch.setattr(report, "draw", lambda *a: drawn.append(figure.draw(*a)))
    rows = [
        {"case": case, "label": label, "model": model, "unit": "gradient", "cost": cost, "prepared_s": 1.0}
        | {"runs": [run(*figures)]}
        for case in NEAR
        for label, model, cost, *figures in CONTENDERS
    ]
    result = {"versions": {}, "differences": {"a": {"b": 1e-9}}, "near_a_bound": NEAR, "rows": rows}
    result["whole"] = [whole_row(*one) for one in WHOLE]
    (tmp_path / "run.json").write_text(json.dumps(result))
    report.main(*(str(tmp_path / name) for name in ("run.json", "page.md", "benchmarks/peers.png")))
    *axes, last = drawn[0].axes[::2]
    assert last.get_title("left") == "from nothing to 4000 effective draws"
    assert len(last.lines) == len(WHOLE)
    bars = {a.get_title("left"): [tick.get_text() for tick in a.get_yticklabels()] for a in axes}
    return (tmp_path / "page.md").read_text(), bars, tmp_path


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


def test_the_goals_of_the_mixture_are_judged_against_the_best_nautilus_of_the_same_posterior():
    # 4000 in 8000 after warm-up, in 13000 with all; nautilus 16000 in 64000
    text = whole_page()
    assert f"| {POSTERIOR} | 0.5 | ≥ 0.40 | yes | 0.31 | ≥ 0.25 | yes | 0.25 |" in text
    assert "| 13 000 for 4 000 | 64 000 for 16 000 | 0.43 |" in text  # 5000 + 16000/0.5
    slower = whole_row("fmu", "mixture", 4000.0, 12_000, 0.0, -28.33)
    assert f"| {POSTERIOR} | 0.33 | ≥ 0.40 | **no** | 0.24 | ≥ 0.25 | **no** |" in whole_page(slower)
    better = whole_row("peer", "nautilus", 16_000.0, 35_000, 0.0, -28.32)
    assert f"| {POSTERIOR} | 0.5 | ≥ 0.40 | yes | 0.31 | ≥ 0.4 | **no** | 0.4 |" in whole_page(better)


@pytest.mark.parametrize(
    ("figures", "ended", "doubt"),
    [
        ((4000.0, 8000, 0.1, -28.33), True, "its means are off"),
        ((4000.0, 8000, 0.0, -28.5), True, "its log-evidence is off"),
        ((4000.0, 8000, 0.0, -28.33), False, "its verdict is not good"),
    ],
)
def test_a_sampler_that_is_fast_and_wrong_is_shown_as_wrong(figures, ended, doubt):
    assert line_of(whole_page(), "**fmu mixture**").endswith("| yes |")
    wrong = whole_row("fmu", "mixture", *figures, ended=ended)
    assert line_of(whole_page(wrong), "**fmu mixture**").endswith(f"| **no**: {doubt} |")


def test_a_peer_that_is_cut_off_is_neither_right_nor_the_reference():
    cut = whole_row("peer", "nautilus, no networks", 20_000.0, 299_000, 0.5, -28.32, ended=False)
    text = whole_page(cut)
    assert "**no**: not at an end after" in line_of(text, "nautilus, no networks")
    assert "| reference | yes |" in line_of(text, "nautilus")
    assert line_of(text, "**fmu mixture**").endswith("| yes |")


def test_a_whole_run_counts_search_warm_up_and_gradients(monkeypatch):
    monkeypatch.setattr(runs, "ENOUGH", 400)
    target = Target.load("shear-2dof", "index")
    meter = runs.Meter(target)
    theta = target.starts(1, 7)
    target.problem.log_prob(theta)
    assert meter.read().evaluations == 7
    target.problem.log_prob_and_grad(theta)
    assert meter.read().evaluations == round(7 * meter.gradient)
    run = runs.fmu_whole(target, "mixture")(1)
    assert min(part.evaluations for part in (run.search, run.warmup, run.draws)) > 1000
    assert run.ended
    assert run.ess > 400
    assert run.evidence[0] == pytest.approx(-2.78867, abs=5 * run.evidence[1])  # quadrature: results/evidence.md
