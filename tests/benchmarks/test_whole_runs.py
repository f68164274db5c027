"""The page of the whole runs: what is wrong is shown as wrong, and everything that a run costs counts."""

import json

import pytest

from tests.benchmarks.peers.target import Target
from tests.benchmarks.peers.whole_runs import figure, page, runs
from tests.benchmarks.peers.whole_runs.rows import WholeRow

# whose, label, ESS, evaluations of the draws (before them: 5000), mean, log-evidence
WHOLE = (
    ("fmu", "mixture", 4000.0, 8000, 0.0, -28.33),
    ("fmu", "hmc", 4000.0, 80_000, 0.0, None),
    ("peer", "nautilus", 16_000.0, 59_000, 0.0, -28.32),
    ("peer", "nautilus, no networks", 20_000.0, 195_000, 0.0, -28.32),
    ("peer", "dynesty, dynamic", 4000.0, 65_000, 0.0, -28.3),
)
POSTERIOR = "cantilever-young, pairing by shape"


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
    return "\n".join(page.page([WholeRow.read(row) for row in rows], {}))


def line_of(text, name):
    return next(line for line in text.splitlines() if line.startswith(f"| {name} |"))


def test_page_and_picture_have_every_contender(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(page, "draw", lambda *a: drawn.append(figure.draw(*a)))
    kept = {"versions": {"dynesty": "3.1.0"}, "rows": [whole_row(*one) for one in WHOLE]}
    (tmp_path / "run.json").write_text(json.dumps(kept))
    page.main(*(str(tmp_path / name) for name in ("run.json", "whole-runs.md", "benchmarks/whole-runs.png")))
    text = (tmp_path / "whole-runs.md").read_text()
    assert "![Whole runs](benchmarks/whole-runs.png)" in text
    assert "Versions: dynesty 3.1.0." in text
    assert (tmp_path / "benchmarks" / "whole-runs.png").exists()
    assert [len(axes.lines) for axes in drawn[0].axes] == [len(WHOLE)] * 2
    for whose, label, *_ in WHOLE:
        assert line_of(text, f"**fmu {label}**" if whose == "fmu" else label)


def test_the_goals_of_the_mixture_are_judged_against_the_best_nautilus_of_the_same_posterior():
    # 4000 in 8000 after warm-up, in 13000 with all; nautilus 16000 in 64000
    text = whole_page()
    assert f"| {POSTERIOR} | 0.5 | ≥ 0.4 | yes | 0.31 | ≥ 0.25 | yes | 0.25 |" in text
    assert "| 13 000 for 4 000 | 64 000 for 16 000 | 0.43 |" in text  # 5000 + 16000/0.5
    slower = whole_row("fmu", "mixture", 4000.0, 12_000, 0.0, -28.33)
    assert f"| {POSTERIOR} | 0.33 | ≥ 0.4 | **no** | 0.24 | ≥ 0.25 | **no** |" in whole_page(slower)
    better = whole_row("peer", "nautilus", 16_000.0, 35_000, 0.0, -28.32)
    assert f"| {POSTERIOR} | 0.5 | ≥ 0.4 | yes | 0.31 | ≥ 0.4 | **no** | 0.4 |" in whole_page(better)


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
    assert f"| {POSTERIOR} | 0.5 | ≥ 0.4 | yes | 0.31 | ≥ 0.25 | yes | 0.25 |" in text
    both = whole_page(cut, whole_row("peer", "nautilus", 16_000.0, 59_000, 0.0, -28.32, ended=False))
    assert "| 0.31 | ≥ 0.25 | yes | not at an end | 13 000 for 4 000 | — | — |" in both
    assert line_of(text, "**fmu mixture**").endswith("| yes |")


@pytest.mark.validate
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
