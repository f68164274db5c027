"""fmu run, stopped by a signal: every end is told, and resumed to what it would have been."""

import signal

import pytest

import fmu
from fmu.runs.run_directory import RunDirectory
from tests.cli.runs import QUIET, assert_same, invoke, of, resume, run


def test_a_signal_stops_with_what_was_drawn(folder, whole, at_keep):
    at_keep(3, lambda: signal.raise_signal(signal.SIGINT))
    handlers = [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)]
    stopped = run(*of("mh"))
    assert [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)] == handlers
    assert stopped.exit_code == 130, stopped.output
    assert "converged" not in stopped.stdout  # the maxima were told, and no verdict
    *_, last = stopped.stderr.splitlines()
    assert last == "Stopped: mh after 6 of 15 draws. To resume: fmu run --resume out"
    assert_usable(folder / "out", 6)  # a step after it was kept
    result = resume()
    assert result.exit_code == 0, result.output
    assert_same("mh", folder / "out", whole)


def assert_usable(directory, draws):
    """A trace of so few draws can be worked with, and says what it is."""
    partial = fmu.load_trace(directory / "mh.nc")
    assert partial["posterior"].sizes["draw"] == draws
    assert partial.attrs["complete"] == 0
    compared = invoke("compare", directory)
    assert compared.exit_code == 0, compared.output
    assert "not converged" in compared.stdout


@pytest.mark.usefixtures("no_verdicts")
def test_a_signal_in_warm_up(folder, whole, at_keep):
    at_keep(1, lambda: signal.raise_signal(signal.SIGTERM))
    stopped = run(*of("hmc"), "--keep-draws", 3)
    assert stopped.exit_code == 130
    assert stopped.stderr.splitlines()[-1] == "Stopped: hmc in warm-up. To resume: fmu run --resume out"
    assert not (folder / "out" / "hmc.nc").exists()
    assert resume().exit_code == 0
    assert_same("hmc", folder / "out", whole)


@pytest.mark.usefixtures("no_verdicts")
def test_the_second_signal_stops_at_once(folder, whole, at_keep):
    at_keep(3, lambda: [signal.raise_signal(signal.SIGINT) for _ in range(2)])
    stopped = run(*of("mh"))
    assert stopped.exit_code == 130
    assert stopped.stderr.splitlines()[-1] == "Stopped: mh after 5 of 15 draws. To resume: fmu run --resume out"
    assert resume().exit_code == 0
    assert_same("mh", folder / "out", whole)


@pytest.mark.usefixtures("no_verdicts")
def test_a_stop_in_the_search_for_maxima(folder, whole, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("fmu.analysis.maxima.search.find_map", interrupted)
        stopped = run(*of("mh"))
    assert stopped.exit_code == 130
    assert stopped.stderr.splitlines()[-1] == "Stopped. To resume: fmu run --resume out"
    assert resume().exit_code == 0
    assert_same("mh", folder / "out", whole)


@pytest.mark.usefixtures("no_verdicts")
def test_a_stop_at_the_very_end_of_a_sampler_begins_no_other(folder, whole, monkeypatch):
    def ended(directory, sampler, problem, finished=RunDirectory.finish_sampler):
        finished(directory, sampler, problem)
        signal.raise_signal(signal.SIGINT)

    with monkeypatch.context() as patch:
        patch.setattr(RunDirectory, "finish_sampler", ended)
        stopped = invoke("run", "two.toml", *of("mh", "hmc"), "--out", "out", *QUIET)
    assert stopped.exit_code == 130
    assert "Stopped. To resume: fmu run --resume out" in stopped.stderr
    assert resume().exit_code == 0
    for name in ("mh", "hmc"):
        assert_same(name, folder / "out", whole)


@pytest.mark.usefixtures("no_verdicts")
def test_a_stop_with_the_last_draw_is_obeyed(folder, whole, at_keep):
    at_keep(5, lambda: signal.raise_signal(signal.SIGTERM))
    stopped = run(*of("mh"))
    assert stopped.exit_code == 130, stopped.output
    assert not (folder / "out" / "mh.nc").exists()
    assert resume().exit_code == 0
    assert_same("mh", folder / "out", whole)
