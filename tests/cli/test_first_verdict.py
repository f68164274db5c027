"""The verdict is printed once the draws are there, before certificates, modes left out and pages."""

import click
import pytest

import fmu.analysis.certificate
import fmu.analysis.held_out.modes
import fmu.report.pages
from fmu.progress import displays
from tests.cli.runs import invoke, of, resume

DRAWN = ("Posterior maxima", "\nhmc\n", "\nhmc  not converged: ")


def announcing(monkeypatch, module, name, text):
    function = getattr(module, name)

    def announced(*arguments, **more):
        click.echo(text)
        return function(*arguments, **more)

    monkeypatch.setattr(module, name, announced)


@pytest.fixture
def _announced(monkeypatch):
    announcing(monkeypatch, fmu.analysis.certificate, "certify", "(certificate)")
    announcing(monkeypatch, fmu.analysis.held_out.modes, "with_left_out", "(modes left out)")
    monkeypatch.setattr(fmu.report.pages, "publish", lambda *_: click.echo("(pages)"))


def assert_in_order(output, *texts):
    places = [output.find(text) for text in texts]
    assert -1 not in places, texts[places.index(-1)]
    assert places == sorted(places)


@pytest.mark.usefixtures("folder", "_announced")
def test_the_verdict_comes_before_what_takes_further_solves():
    output = invoke("run", "two.toml", *of("hmc"), "--out", "out", "--progress", "none").output
    assert_in_order(output, *DRAWN, "(certificate)", "(modes left out)", "largest MCSE", "(pages)")
    assert output.count("not converged: ") == 1


@pytest.mark.usefixtures("folder", "_announced")
def test_with_several_samplers_each_has_its_verdict_before_the_next_begins():
    output = invoke("run", "two.toml", *of("mh", "hmc"), "--out", "out", "--progress", "none").output
    of_first = ("Posterior maxima", "\nmh\n", "\nmh  not converged", "(certificate)", "(modes left out)")
    assert_in_order(output, *of_first, "\nhmc\n", "\nhmc  not converged", "largest MCSE")
    assert output.rfind("mh   not converged") > output.find("largest MCSE")  # compared with the others, too


@pytest.mark.usefixtures("folder")
def test_a_run_stopped_while_modes_are_left_out_keeps_its_draws(monkeypatch):
    def stopped(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(fmu.analysis.held_out.modes, "with_left_out", stopped)
        result = invoke("run", "two.toml", *of("hmc"), "--out", "out", "--no-report", "--progress", "none")
    assert_in_order(result.output, *DRAWN, "To resume: fmu run --resume out")
    assert result.exit_code == 130
    monkeypatch.setattr("fmu.samplers.loop.group._GroupRunner.step", None)  # nothing is drawn again
    again = resume()
    assert again.exit_code == 0, again.output
    assert_in_order(again.output, *DRAWN, "Written to out")


@pytest.mark.usefixtures("folder")
def test_how_to_go_on_is_part_of_the_first_verdict(monkeypatch):
    announcing(monkeypatch, fmu.analysis.certificate, "certify", "(certificate)")
    length = ("--warmup", 10, "--chains", 2, "--starts", 2, "--max-solves", 30)
    output = invoke(
        "run", "two.toml", "--sampler", "mh", *length, "--out", "out", "--no-report", "--progress", "none"
    )
    assert_in_order(
        output.output, "--max-solves 30 reached before convergence: mh", "To continue:", "(certificate)"
    )


def test_bars_end_where_text_is_printed(monkeypatch):
    events = []

    class Bars:
        def __enter__(self):
            events.append("begin")
            return lambda phase, done, total, info: events.append(phase)

        def __exit__(self, *exception):
            events.append("end")

    monkeypatch.setattr(displays, "terminal_bars", Bars)
    with displays.SuccessiveBars() as report:
        report("draws", 1, 2, {})
        report.end()
        report.end()
        report("predictions", 1, 2, {})
    assert events == ["begin", "draws", "end", "begin", "predictions", "end"]
