"""fmu run, broken off and resumed: what is drawn is bit for bit what it would have been."""

from contextlib import contextmanager

import pytest

import fmu
from fmu.runs.run_directory import RunDirectory
from fmu.samplers.mixture.mixture import MixtureSampler
from tests.cli.conftest import searched_once
from tests.cli.runs import SAMPLERS, SECOND, Cut, assert_refused, assert_same, cut, of, problem_in, resume, run
from tests.runs.keeping import at_keep


@pytest.mark.validate
def test_broken_off_again_and_again(folder, whole_of_all, at_keep):
    """Four samplers, after every seventh part that is kept."""
    at_keep(7, cut, again=True)
    ends = 0
    with pytest.raises(Cut):
        run(*of(*SAMPLERS))
    while True:
        ends += 1
        try:
            result = resume()
        except Cut:
            continue
        break
    assert result.exit_code == 0, result.output
    assert ends > 2
    for name in SAMPLERS:
        assert_same(name, folder / "out", whole_of_all)
    assert not (folder / "out" / "checkpoints").exists()
    assert {path.name for path in (folder / "out").iterdir()} == {path.name for path in whole_of_all.iterdir()}


@pytest.mark.validate
def test_a_group_of_chains_a_worker(folder):
    """Two processes draw what one does, and go on with what one has left."""
    groups = ("--groups", 2, "--chains", 4)
    assert run(*of("hmc"), *groups).exit_code == 0
    (folder / "out").rename(folder / "one")
    with pytest.MonkeyPatch.context() as patch:
        at_keep(patch, 7, cut)
        with pytest.raises(Cut):
            run(*of("hmc"), *groups)
    result = resume("--workers", 2)
    assert result.exit_code == 0, result.output
    assert_same("hmc", folder / "out", folder / "one")
    assert fmu.load_trace(folder / "out" / "hmc.nc").attrs["groups"] == 2


OPEN = ("--sampler", "mixture", "--chains", 2, "--starts", 2)
SELDOM = ("--keep-draws", 1000)


@contextmanager
def judged_soon():
    """Runs are first judged after few draws, and no mode is left out, which takes longer than they do."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(MixtureSampler, "first", (60, 20))
        patch.setattr("fmu.analysis.held_out.modes.with_left_out", lambda trace, problem: trace)
        yield


@pytest.fixture
def _judged_soon():
    with judged_soon():
        yield


@pytest.fixture(scope="module")
def converged(tmp_path_factory):
    """A run until it has converged that nothing happened to."""
    folder = problem_in(tmp_path_factory.mktemp("converged"))
    with pytest.MonkeyPatch.context() as patch, searched_once(), judged_soon():
        patch.chdir(folder)
        assert run(*SELDOM, length=OPEN).exit_code == 0
    return folder / "out"


@pytest.mark.validate
@pytest.mark.usefixtures("_judged_soon")
def test_until_it_has_converged(folder, converged, at_keep):
    """Broken off in the extension."""
    assert fmu.load_trace(converged / "mixture.nc")["posterior"].sizes["draw"] > 160
    at_keep(5, cut)  # the first are of warm-up, and of 20, 40, 80 and 160 draws
    with pytest.raises(Cut):
        run(*SELDOM, length=OPEN)
    assert resume().exit_code == 0
    assert_same("mixture", folder / "out", converged)


@pytest.mark.usefixtures("_judged_soon")
def test_a_run_that_ended_at_its_limit_goes_on_with_a_larger_one(folder, converged):
    """How many draws are enough is decided from the draws alone."""
    assert run(*SELDOM, "--max-solves", 500, length=OPEN).exit_code == 1
    assert fmu.load_trace("out/mixture.nc").attrs["limit"] == "500 solves"
    again = resume()
    assert again.exit_code == 1
    assert "To continue: fmu run --resume out --max-solves 5000" in again.stdout
    assert resume("--max-solves", 100000).exit_code == 0
    assert_same("mixture", folder / "out", converged)
    assert not (folder / "out" / "checkpoints").exists()


@pytest.mark.usefixtures("no_verdicts")
def test_the_problem_is_that_of_the_beginning(folder, whole, at_keep):
    """The file may change meanwhile; the files that it names must not."""
    at_keep(4, cut)
    with pytest.raises(Cut):
        run(*of("mh"))
    (folder / "two.toml").write_text("something else")
    (folder / "k2.csv").write_text("1.0,-1.0\n-1.0,1.1\n")
    assert_refused(resume(), "checkpoint", "another run")
    (folder / "k2.csv").write_text(SECOND)
    assert resume().exit_code == 0
    assert_same("mh", folder / "out", whole)


@pytest.mark.usefixtures("no_verdicts")
def test_one_run_at_a_time(folder, whole, at_keep):
    at_keep(3, cut)
    with pytest.raises(Cut):
        run(*of("mh"))
    with RunDirectory(folder / "out"):
        assert_refused(resume(), "another fmu run is running in out")
        assert_refused(run("--overwrite", *of("slice")), "another fmu run is running in out")
    assert resume().exit_code == 0
    assert_same("mh", folder / "out", whole)


@pytest.mark.usefixtures("no_verdicts")
def test_another_run_instead(folder, whole, at_keep):
    at_keep(4, cut)
    with pytest.raises(Cut):
        run(*of("mh"), "--seed", 7)
    assert_refused(run(*of("mh")), "resume it with fmu run --resume out", "--overwrite")
    assert run(*of("mh"), "--overwrite").exit_code == 0
    assert_same("mh", folder / "out", whole)
