"""The page of the peers: wrong samplers are shown as wrong, and all costs of a run are counted."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from tests.benchmarks.peers import figure, page
from tests.benchmarks.peers.contenders import FMU, PEER
from tests.benchmarks.peers.posteriors import Target
from tests.benchmarks.peers.rows import Row
from tests.benchmarks.peers.run import Cost, Run

# label, whose, ESS, evaluations of the draws (before them: 5000), log-evidence
CONTENDERS = (
    ("mixture", FMU, 1000.0, 2000, -28.33),
    ("hmc", FMU, 1000.0, 20_000, None),
    ("emcee", FMU, 1000.0, 200_000, None),
    ("emcee, moves of fmu's", PEER, 1000.0, 200_000, None),
    ("nutpie NUTS", PEER, 2000.0, 50_000, None),
    ("nautilus", PEER, 4000.0, 65_000, -28.32),
)

WRAPPING = 1.04


def cost(n):
    return Cost(cpu_s=n / 10_000, evaluations=n)


def row(label, whose, ess, evaluations, evidence):
    evidence = None if evidence is None else (evidence, 0.004)
    before = {} if evidence and whose == PEER else {"search": cost(2000), "warmup": cost(3000)}
    rhat = np.nan if evidence and whose == PEER else 1.001
    return Row(
        whose,
        label,
        (Run(ess, [0.0, 0.0], [0.01, 0.01], cost(evaluations), rhat=rhat, evidence=evidence, **before),),
    )


def rows(**changed):
    """Return the rows, the runs of some labels changed."""
    found = [row(*one) for one in CONTENDERS]
    return [
        replace(one, runs=tuple(replace(run, **changed.get(one.label, {})) for run in one.runs)) for one in found
    ]


def text(**changed):
    target = Target("garteur", "shape", SimpleNamespace(ndim=11))
    return page.page(target, rows(**changed), WRAPPING, "6 of 6 runs", {"emcee": "3.1.6"})


def line_of(text, name):
    return next(line for line in text.splitlines() if line.startswith(f"| {name} |"))


@pytest.mark.usefixtures("quick_figures")
def test_page_and_picture_have_every_contender(tmp_path):
    drawn = figure.draw(rows(), str(tmp_path / "peers.png"))
    assert [len(axes.patches) for axes in drawn.axes] == [len(CONTENDERS)] * 2
    assert [bar.get_hatch() for bar in drawn.axes[0].patches] == [None] * len(CONTENDERS)
    assert (tmp_path / "peers.png").exists()
    for label, whose, *_ in CONTENDERS:
        assert line_of(text(), f"**fmu {label}**" if whose == FMU else label).endswith("| yes |")


def test_in_all_counts_search_and_warm_up_and_takes_the_draws_in_proportion():
    # nutpie: 2000 in 50 000 after 5000; 1000 need half of the draws. nautilus cannot stop earlier: 1000 in 65 000
    assert "| 0.04 | 0.033 | 400 | 333 |" in line_of(text(), "nutpie NUTS")
    assert "| 0.062 | 0.015 | 615 | 154 |" in line_of(text(), "nautilus")
    assert "| 0.5 | 0.14 | 5000 | 1429 |" in line_of(text(), "**fmu mixture**")


def test_the_first_lines_say_whether_a_peer_is_ahead_and_by_how_much():
    assert "? **No peer with a right result is ahead" in " ".join(text().splitlines()[2:4])
    behind = " ".join(text(mixture={"draws": cost(95_000)}, hmc={"draws": cost(95_000)}).splitlines()[2:4])
    assert "? **A peer is ahead over a whole run: nutpie NUTS gives 3.3 times as many" in behind
    assert "effective draws per evaluation as fmu" in behind  # 1000 in 100 000 against 1000 in 30 000


def test_what_was_wanted_is_judged():
    # 1000 in 7000 against 1000 in 30 000
    in_all = "ESS per evaluation, in all"
    assert line_of(text(), in_all).endswith("| fmu mixture: 0.14 | nutpie NUTS: 0.033 | 4.3 × | 2 × | yes |")
    assert line_of(text(mixture={"draws": cost(15_000)}), in_all).endswith("| 1.5 × | 2 × | **no** |")
    assert "takes 1.04 times as long" in text()
    assert "wanted: at most 1.05; met" in text()
    assert "1.06 times" in page.overhead(1.06)
    assert "**missed**" in page.overhead(1.06)


@pytest.mark.parametrize(
    ("changed", "doubt"),
    [
        ({"mean": [0.1, 0.0]}, "its means are wrong"),
        ({"evidence": (-28.5, 0.004)}, "its log-evidence is wrong"),
        ({"ended": False}, "its verdict is not good"),
        ({"rhat": 1.2}, "its chains disagree"),
    ],
)
def test_a_sampler_that_is_fast_and_wrong_is_shown_as_wrong_and_not_compared(changed, doubt):
    wrong = text(mixture=changed)
    assert line_of(wrong, "**fmu mixture**").endswith(f"| **no**: {doubt} |")
    assert "fmu mixture:" not in wrong
    assert "fmu hmc:" in wrong


def test_a_peer_that_ran_out_of_its_budget_is_neither_right_nor_the_reference():
    spent = {"ended": False, "ess": np.nan, "mean": [np.nan] * 2, "mcse": [np.nan] * 2, "evidence": None}
    cut = text(nautilus=spent)
    assert "not finished after 65 000 evaluations" in line_of(cut, "nautilus")
    assert "| reference | yes |" in line_of(cut, "nutpie NUTS")


def test_the_reference_is_the_peer_with_whom_others_agree_and_not_the_one_with_most_draws():
    off = {"mean": [0.1, 0.0], "ess": 90_000.0}
    found = text(**{"emcee, moves of fmu's": off})
    assert line_of(found, "emcee, moves of fmu's").endswith("| **no**: its means are wrong |")
    assert "| reference | yes |" in line_of(found, "nautilus")


def test_a_peer_with_a_log_evidence_is_not_the_reference_where_it_is_off():
    off = text(nautilus={"mean": [0.1, 0.0], "evidence": (-35.0, 0.004)})
    assert line_of(off, "nautilus").endswith("| **no**: its means are wrong |")
    assert "| reference | yes |" in line_of(off, "nutpie NUTS")
    assert line_of(off, "**fmu mixture**").endswith("| yes |")  # nothing right is known about the log-evidence
