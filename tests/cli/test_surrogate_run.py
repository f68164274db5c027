"""``fmu run`` of a slow function: a surrogate by itself, its certificate told, its solves never repeated."""

import copy
import json
import warnings

import pytest
from click.testing import CliRunner

import fmu
from fmu.cli import main
from fmu.fem.surrogate import process
from fmu.numbers import whole
from fmu.surrogates import learning
from fmu.surrogates.learning import SurrogateWarning
from tests.pictures import without_pictures

SOURCE = """
import time
from pathlib import Path
import numpy as np

calls = Path(__file__).with_name("calls")


def storeys(theta):
    with calls.open("a") as file:
        file.write("x")
    time.sleep({seconds})
    k1, k2 = theta
    m1, m2 = 16e3, 12e3
    total, product = (k1 + k2) / m1 + k2 / m2, k1 * k2 / (m1 * m2)
    upper = 0.5 * (total + np.sqrt(total**2 - 4 * product))
    return np.sqrt([product / upper, upper]) / (2 * np.pi)
"""
PROBLEM = """
name = "storeys"
[model]
type = "python"
function = "slow:storeys"
[measurement]
frequencies = [4.65, 13.5]
sd = [0.02, 0.06]
[[parameters]]
name = "k1"
start = 5e7
lower = 4e7
upper = 9e7
[[parameters]]
name = "k2"
start = 3e7
lower = 2e7
upper = 6e7
"""
LENGTH = ("--warmup", "100", "--draws", "50", "--starts", "8", "--progress", "none")


def written(folder, seconds):
    (folder / "slow.py").write_text(SOURCE.format(seconds=seconds))
    (folder / "storeys.toml").write_text(PROBLEM)
    return folder


def run(*arguments):
    return CliRunner().invoke(main, ["run", *map(str, arguments)])


@pytest.fixture(scope="module", autouse=True)
def _fitted_once():
    """Fit Gaussian processes to the same solves once: the runs here learn from the same ones."""
    fitted, fit = {}, process._fit

    def fit_once(x, z, kernel, search):
        begun_at = kernel and (kernel.theta.tobytes(), kernel.bounds.tobytes())
        key = (x.tobytes(), z.tobytes(), begun_at, search)
        if key not in fitted:
            fitted[key] = fit(x, z, kernel, search)
        return copy.deepcopy(fitted[key])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(process, "_fit", fit_once)
        yield


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = written(tmp_path_factory.mktemp("slow"), 0.055)
    with without_pictures():
        done = run(folder / "storeys.toml", "--out", folder / "a", *LENGTH)
    assert done.exit_code == 0, done.output
    return folder, done


def test_it_says_what_it_does_and_what_it_is_worth(finished):
    _, done = finished
    assert "Gaussian processes learn from about 28 solves" in done.stderr
    assert "--no-surrogate" in done.stderr
    assert "Certificate of the surrogate" in done.stdout
    assert "no posterior mean is off by more than" in done.stdout


def test_the_trace_and_the_report_have_the_certificate(finished):
    folder, _ = finished
    attrs = fmu.load_trace(folder / "a" / "mixture.nc").attrs
    assert attrs["certificate_shift"] <= attrs["certificate_shift_tolerance"] == 0.05
    assert attrs["surrogate_solves"] == attrs["surrogate_design"] + attrs["certificate_draws"]
    page = (folder / "a" / "report" / "index.html").read_text()
    assert "Certificate of the surrogate" in page
    assert "solves from which the surrogate was learnt" in page


def test_the_decision_is_kept(finished):
    folder, _ = finished
    assert json.loads((folder / "a" / "run.json").read_text())["orders"]["surrogate"] is True


def test_another_run_solves_nothing_again_and_draws_the_same(finished):
    folder, _ = finished
    trace = fmu.load_trace(folder / "a" / "mixture.nc")
    calls = len((folder / "calls").read_text())
    # besides the solves, the time of one was measured, after the first call
    assert calls == trace.attrs["surrogate_solves"] + 1
    done = run(folder / "storeys.toml", "--out", folder / "b", "--surrogate", "--no-report", *LENGTH)
    assert done.exit_code == 0, done.output
    assert len((folder / "calls").read_text()) == calls + 2  # at the start: to compare, and to measure the time
    again = fmu.load_trace(folder / "b" / "mixture.nc")
    assert again.posterior.equals(trace.posterior)


def test_a_surrogate_that_is_allowed_more_solves_goes_on_and_what_it_gave_is_drawn_anew(finished):
    folder, _ = finished
    few = ("--max-solves", "22", "--surrogate", "--no-report", *LENGTH[:2], *LENGTH[4:])
    with warnings.catch_warnings():
        warnings.simplefilter("default", SurrogateWarning)
        done = run(folder / "storeys.toml", "--out", folder / "c", *few)
    assert done.exit_code == 1
    assert "Note: the surrogate misses its tolerance after 22 solves" in done.stderr
    assert f"To learn from more solves: fmu run --resume {folder / 'c'} --max-solves 44" in done.stdout
    calls = len((folder / "calls").read_text())
    done = run("--resume", folder / "c", "--max-solves", "44", "--no-report", "--progress", "none")
    assert done.exit_code == 0, done.output
    assert "the draws begin anew" in done.stderr
    assert len((folder / "calls").read_text()) == calls + 2  # all is stored, but the start is solved in every run
    first, more = (fmu.load_trace(folder / name / "mixture.nc").attrs for name in ("a", "c"))
    assert more["surrogate_solves"] == first["surrogate_solves"] > 22


def test_a_fast_function_is_called_itself(tmp_path):
    written(tmp_path, 0.0)
    short = ("--warmup", "20", "--draws", "10", "--starts", "2", "--progress", "none", "--no-report")
    done = run(tmp_path / "storeys.toml", "--out", tmp_path / "a", *short)
    assert done.exit_code == 0, done.output
    assert "Gaussian" not in done.output
    assert "surrogate_solves" not in fmu.load_trace(tmp_path / "a" / "mixture.nc").attrs
    assert json.loads((tmp_path / "a" / "run.json").read_text())["orders"]["surrogate"] is False


def test_an_option_that_needs_a_surrogate_leaves_nothing_behind_where_there_is_none(tmp_path):
    reasons = {
        "--surrogate": "a model with matrices has a reduced model",
        "--exact": "this model has no surrogate",
    }
    arguments = ("shear-2dof", "--out", tmp_path / "a", "--no-report", "--draws", "4", "--warmup", "4")
    for option in reasons:
        assert run(*arguments[:4], option).exit_code == 2
        assert not (tmp_path / "a" / "checkpoints").exists()
    assert run(*arguments, "--starts", "2").exit_code == 0
    before = (tmp_path / "a" / "run.json").read_text()
    for option, reason in reasons.items():
        done = run(*arguments[:4], option, "--overwrite")
        assert done.exit_code == 2
        assert reason in " ".join(done.stderr.split())
        assert (tmp_path / "a" / "run.json").read_text() == before


ROUGH = SOURCE.replace("return np", "return (1 + 5e-4 * np.sin(1e9 * np.sin(1e3 * k1 / k2))) * np").format(
    seconds=0
)
"""A function whose answers scatter: no surrogate of it keeps the tolerance."""
EXACT = ("--exact", "--surrogate", "--starts", "8", "--progress", "none")


@pytest.fixture(scope="module")
def exact(tmp_path_factory):
    folder = written(tmp_path_factory.mktemp("exact"), 0)
    (folder / "slow.py").write_text(ROUGH)
    (folder / "storeys.toml").write_text(PROBLEM.replace("[4.65, 13.5]", "[5.7, 12.8]"))
    with warnings.catch_warnings(), pytest.MonkeyPatch.context() as patched, without_pictures():
        warnings.simplefilter("ignore", SurrogateWarning)  # the tolerance is missed
        patched.setattr(learning, "most_solves", lambda problem: 22)
        return folder, run(folder / "storeys.toml", "--out", folder / "a", *EXACT)


def test_exact_draws_do_not_depend_on_the_certificate(exact):
    folder, done = exact
    assert done.exit_code == 0, done.output
    attrs = fmu.load_trace(folder / "a" / "mixture.nc").attrs
    assert attrs["certificate_shift"] > attrs["certificate_shift_tolerance"]
    assert "mixture  converged" in done.stdout


def test_exact_draws_are_announced_and_told(exact):
    folder, done = exact
    assert "Then about 500 of its draws, or more where it is poor, are solved, and accepted or" in done.stderr
    attrs = fmu.load_trace(folder / "a" / "mixture.nc").attrs
    accepted, proposals = (whole(attrs[f"second_stage_{name}"]) for name in ("accepted", "proposals"))
    told = f"{accepted} of {proposals} draws of the surrogate were accepted"
    assert told in done.stdout
    page = (folder / "a" / "report" / "index.html").read_text()
    assert page.count(f"{told} after a solve of the model itself") == 2  # at the top, and beside the certificate


def test_exact_draws_need_a_surrogate_and_no_number_of_draws(tmp_path):
    written(tmp_path, 0.0)
    for options, said in (
        (("--no-surrogate",), "--exact is for the draws of a surrogate"),
        (("--draws", "50"), "--exact solves as many draws as converge"),
        ((), "this model has no surrogate"),
    ):
        done = run(tmp_path / "storeys.toml", "--exact", "--out", tmp_path / "a", "--progress", "none", *options)
        assert done.exit_code == 2
        assert said in " ".join(done.stderr.replace("│", " ").split())
