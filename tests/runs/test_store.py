import os
import re
import shutil
import sys
import warnings
from contextlib import contextmanager
from functools import cache

import h5py
import numpy as np
import pytest

import fmu
from fmu.runs import Checkpoint
from fmu.runs.identity import Identity
from fmu.runs.store import (
    LEDGER,
    CheckpointWarning,
    OtherArithmeticWarning,
    Store,
    numbered_files,
    read_state,
)
from fmu.samplers import Ensemble, HamiltonianMonteCarlo, MetropolisHastings, MixtureSampler, Run, Slice, Tempering
from tests.runs.watched import STEPS, Watched
from tests.samplers.targets import CorrelatedGaussian
from tests.samplers.tempered_targets import LinearGaussian

WARMUP, DRAWS, HALF = 40, 60, 30
SAMPLERS = {
    "mh": MetropolisHastings(),
    "slice": Slice(),
    "hmc": HamiltonianMonteCarlo(),
    "mixture": MixtureSampler(),
    "emcee": Ensemble(walkers=12),
    "tempering": Tempering("mh", rungs=6),
}
IDENTITY = Identity.of({"run": {"seed": 1}})


def ran(directory, draws=DRAWS, *, sampler="mh", density=None, identity=IDENTITY, checkpoint=None, **more):
    """The result of a run that is kept in a directory, if one is given."""
    density = density or (LinearGaussian() if sampler == "tempering" else CorrelatedGaussian())
    settings = {"warmup": WARMUP, "chains": 2, "seed": 1, "init": "prior"} | more
    if directory is None:
        return Run(density, SAMPLERS[sampler], **settings).extend(draws)
    where = checkpoint or Checkpoint(directory, draws=STEPS)
    names = [f"x{k}" for k in range(density.ndim)]
    with Store(where, identity, names, [""] * density.ndim) as store:
        return Run(density, SAMPLERS[sampler], checkpointer=store, **settings).extend(draws)


@cache
def uninterrupted(sampler):
    return ran(None, sampler=sampler)


def assert_same(one, other):
    for phase in ("warmup", "posterior"):
        a, b = getattr(one, phase), getattr(other, phase)
        assert (a.position.dtype, a.position.tobytes()) == (b.position.dtype, b.position.tobytes())
        assert a.stats.keys() == b.stats.keys()
        for name in a.stats:
            assert (a.stats[name].dtype, a.stats[name].tobytes()) == (b.stats[name].dtype, b.stats[name].tobytes())
    assert one.learnt == other.learnt


class Killed(BaseException):
    pass


@contextmanager
def damage(*expected):
    """Demand these warnings, in this order, and no others."""
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        yield
    assert len(seen) == len(expected)
    for warning, pattern in zip(seen, expected, strict=True):
        assert issubclass(warning.category, CheckpointWarning)
        assert re.search(pattern, str(warning.message)), str(warning.message)


def killed_at(phase, step):
    def progress(now, done, total, info):
        if (now, done) == (phase, step):
            raise Killed

    return progress


@pytest.fixture(scope="module")
def whole():
    return uninterrupted("mh")


@pytest.fixture(scope="module")
def half_way(tmp_path_factory):
    directory = tmp_path_factory.mktemp("half")
    ran(directory, HALF)
    return directory


@pytest.fixture
def half(half_way, tmp_path):
    """A run that has come half way, of a test's own."""
    directory = tmp_path / "run"
    shutil.copytree(half_way, directory)
    return directory


def files(directory, kind):
    return sorted((directory / "group-1").glob(f"{kind}-*"))


def flip(path, where):
    content = bytearray(path.read_bytes())
    content[int(where * (len(content) - 1))] ^= 0x10
    path.write_bytes(content)


class TestGoingOn:
    # before anything is kept there is nothing of a sampler to come back
    @pytest.mark.parametrize(
        ("phase", "step", "sampler"),
        [("warmup", 3, "mh"), *((*at, name) for at in (("warmup", 27), ("draws", 35)) for name in SAMPLERS)],
    )
    def test_bitwise_after_a_kill(self, tmp_path, sampler, phase, step):
        with pytest.raises(Killed):
            ran(tmp_path, sampler=sampler, progress=killed_at(phase, step))
        assert_same(ran(tmp_path, sampler=sampler), uninterrupted(sampler))

    def test_killed_again_and_again(self, tmp_path, whole):
        deaths = 0
        for phase, steps in (("warmup", WARMUP), ("draws", DRAWS)):
            for step in range(7, steps, 11):
                try:
                    ran(tmp_path, progress=killed_at(phase, step))
                except Killed:
                    deaths += 1
        assert deaths == 8
        assert_same(ran(tmp_path), whole)

    def test_what_is_kept_is_not_drawn_again(self, tmp_path):
        with pytest.raises(Killed):
            ran(tmp_path, progress=killed_at("draws", 37))
        seen = []
        ran(tmp_path, progress=lambda *call: seen.append(call[:2]))
        assert seen[0] == ("draws", 31)
        assert len(seen) == 30
        seen.clear()
        ran(tmp_path, progress=lambda *call: seen.append(call))
        assert not seen

    def test_more_draws_and_fewer(self, half, whole):
        assert_same(ran(half, 80), ran(None, 80))
        assert_same(ran(half, HALF), ran(None, HALF))
        assert_same(ran(half), whole)

    def test_groups_are_kept_apart(self, tmp_path):
        more = {"groups": 2, "chains": 4}
        with pytest.raises(Killed):
            ran(tmp_path, progress=killed_at("draws", 15), **more)
        assert sorted(path.name for path in tmp_path.glob("group-*")) == ["group-1", "group-2"]
        shutil.rmtree(tmp_path / "group-2")
        assert_same(ran(tmp_path, **more), ran(None, **more))

    def test_without_warmup(self, tmp_path):
        ran(tmp_path, 15, warmup=0)
        assert_same(ran(tmp_path, warmup=0), ran(None, warmup=0))

    def test_a_step_at_a_time(self, tmp_path):
        """No part takes longer than is allowed to be lost."""
        every = {"checkpoint": Checkpoint(tmp_path, seconds=0.0), "warmup": 5}
        with pytest.raises(Killed):
            ran(tmp_path, progress=killed_at("draws", 8), **every)
        assert len(files(tmp_path, "steps")) == 5 + 7
        assert_same(ran(tmp_path, 10, **every), ran(None, 10, warmup=5))

    def test_time_counts_from_the_last_time(self, tmp_path):
        density = Watched()
        density.delay = 0.01
        ran(tmp_path, density=density, init=[density.mean] * 2, checkpoint=Checkpoint(tmp_path, seconds=0.1))
        steps = [segment.steps for segment in read_state(files(tmp_path, "state")[-1]).segments]
        assert sum(steps) == WARMUP + DRAWS
        assert 1 < max(steps) <= 10

    def test_the_cost_is_counted_once(self, tmp_path, whole):
        with pytest.raises(Killed):
            ran(tmp_path, progress=killed_at("warmup", 5))
        again = ran(tmp_path)
        assert again.warmup.stats["n_solves"].sum() == whole.warmup.stats["n_solves"].sum()

    def test_other_density(self, half):
        density = CorrelatedGaussian()
        density.mean = density.mean + 0.01
        with pytest.raises(ValueError, match=r"checkpoint: must be of the same posterior .at the position"):
            ran(half, density=density)


class TestFiles:
    def test_draws_are_plain_hdf5(self, half, whole):
        paths = files(half, "steps")
        assert [path.name for path in paths] == [f"steps-{k:06d}.h5" for k in range(1, 8)]
        position = []
        for path in paths[4:]:
            with h5py.File(path) as file:
                position.append(file["position"][()])
                assert file["stats/lp"].shape == (2, STEPS, 1)
        np.testing.assert_array_equal(
            np.concatenate(position, axis=1)[:, :, 0], whole.posterior.position[:, :HALF]
        )

    def test_states_say_what_there_is(self, half):
        newest = read_state(files(half, "state")[-1])
        spans = [(segment.phase, segment.first, segment.steps) for segment in newest.segments]
        assert spans == [
            *(("warmup", k, STEPS) for k in range(0, WARMUP, STEPS)),
            *(("draws", k, STEPS) for k in range(0, HALF, STEPS)),
        ]
        assert newest.group_state.done == {"warmup": WARMUP, "draws": HALF}
        assert newest.configuration == IDENTITY.hash
        assert [number for number, _ in numbered_files(half / "group-1", "state")] == [6, 7]

    def test_no_pickle(self, half):
        for path in half.rglob("*"):
            if path.is_file():
                assert b"pickle" not in path.read_bytes()

    def test_files_do_not_change_once_written(self, half):
        before = {path: path.read_bytes() for path in files(half, "steps")}
        ran(half)
        assert all(path.read_bytes() == content for path, content in before.items())


class TestDamage:
    @pytest.mark.parametrize("where", [0.0, 0.003, 0.5, 1.0])
    def test_a_byte_of_the_newest_state(self, half, whole, where):
        flip(files(half, "state")[-1], where)
        with pytest.warns(
            CheckpointWarning, match=r"state-000007 is damaged .*: the group resumes from the state"
        ):
            again = ran(half)
        assert_same(again, whole)

    @pytest.mark.parametrize("keep", [0.0, 0.5, 0.999])
    @pytest.mark.parametrize("kind", ["state", "steps"])
    def test_truncated(self, half, whole, kind, keep):
        path = files(half, kind)[-1]
        content = path.read_bytes()
        path.write_bytes(content[: int(keep * len(content))])
        with pytest.warns(CheckpointWarning, match="state-000007 is damaged"):
            again = ran(half)
        assert_same(again, whole)

    def test_a_byte_of_the_newest_segment(self, half, whole):
        flip(files(half, "steps")[-1], 0.5)
        with pytest.warns(
            CheckpointWarning, match="the checksum of steps-000007.h5 is wrong.*resumes from the state"
        ):
            again = ran(half)
        assert_same(again, whole)

    def test_a_segment_is_gone(self, half, whole):
        files(half, "steps")[-1].unlink()
        with pytest.warns(CheckpointWarning, match=r"steps-000007.h5 cannot be read: No such file"):
            again = ran(half)
        assert_same(again, whole)

    def test_a_segment_that_all_states_need(self, half, whole):
        flip(files(half, "steps")[0], 0.5)
        with damage("checksum of steps-000001.h5 is wrong.*resumes", "checksum of steps-000001.h5.*starts again"):
            again = ran(half)
        assert_same(again, whole)

    def test_all_states(self, half, whole):
        for path in files(half, "state"):
            flip(path, 0.5)
        with damage("state-000007 is damaged.*resumes", "state-000006 is damaged.*starts again"):
            again = ran(half)
        assert_same(again, whole)

    def test_no_state(self, half, whole):
        for path in files(half, "state"):
            path.unlink()
        assert_same(ran(half), whole)

    def test_a_directory_in_place_of_a_state(self, half, whole):
        newest = files(half, "state")[-1]
        newest.unlink()
        newest.mkdir()
        with pytest.warns(CheckpointWarning, match="state-000007 is damaged"):
            read = ran(half, HALF)
        np.testing.assert_array_equal(read.posterior.position, whole.posterior.position[:, :HALF])

    def test_once_damaged_there_are_two_intact_states_again(self, half, whole):
        """The damaged one does not count as the one before: another misfortune may come."""
        flip(files(half, "state")[-1], 0.5)
        with pytest.warns(CheckpointWarning), pytest.raises(Killed):
            ran(half, progress=killed_at("draws", 31))
        assert [number for number, _ in numbered_files(half / "group-1", "state")] == [6, 8]
        flip(files(half, "state")[-1], 0.5)
        with pytest.warns(CheckpointWarning, match="resumes from the state before it"):
            again = ran(half)
        assert_same(again, whole)

    def test_of_one_group_only(self, tmp_path):
        more = {"groups": 2, "chains": 4}
        ran(tmp_path, HALF, **more)
        for path in (tmp_path / "group-2").glob("state-*"):
            flip(path, 0.5)
        seen = []
        with damage("group-2/state-000007 is damaged.*resumes", "group-2/state-000006 is damaged.*starts again"):
            again = ran(tmp_path, progress=lambda *call: seen.append((call[3]["group"], *call[:2])), **more)
        assert_same(again, ran(None, **more))
        assert next(call for call in seen if call[0] == "1/2") == ("1/2", "draws", HALF + 1)
        assert next(call for call in seen if call[0] == "2/2") == ("2/2", "warmup", 1)

    def test_leftovers_of_a_killed_write(self, half, whole):
        folder = half / "group-1"
        leftovers = [
            folder / ".state-000008.4711.part",
            folder / ".steps-000008.h5.4711.part",
            half / ".run.1.part",
        ]
        for path in (*leftovers, folder / "steps-000008.h5", folder / "steps-000042.h5", folder / "state-x"):
            path.write_bytes(b"half of it")
        assert_same(ran(half), whole)
        assert not any(path.exists() for path in leftovers)


class TestIdentity:
    def test_another_run(self, half, whole):
        with pytest.raises(ValueError, match=r"contains another run: run\.seed 1 there, 2 here$"):
            ran(half, identity=Identity.of({"run": {"seed": 2}}))
        assert_same(ran(half), whole)

    @pytest.mark.parametrize("damage", [lambda path: flip(path, 0.9), lambda path: path.unlink()])
    def test_the_file_is_damaged_or_gone(self, half, whole, damage):
        """Every state knows its run too: nothing foreign is gone on with, and nothing is lost to it."""
        damage(half / "run")
        with pytest.raises(ValueError, match=r"checkpoint: .*state-000007 belongs to another run"):
            ran(half, identity=Identity.of({"run": {"seed": 2}}))
        assert_same(ran(half), whole)
        with pytest.raises(ValueError, match=r"contains another run: run\.seed 1 there"):
            ran(half, identity=Identity.of({"run": {"seed": 2}}))

    def test_a_call_that_fails_leaves_the_directory_to_another(self, tmp_path):
        problem = CorrelatedGaussian()
        for wrong in ({"warmup": -1}, {"init": [[np.inf] * 5] * 4}, {"workers": 0}):
            with pytest.raises(ValueError, match=f"{next(iter(wrong))}: "):
                fmu.sample(problem, "mh", checkpoint=tmp_path, **{"draws": 5, "warmup": 5} | wrong)
        trace = fmu.sample(problem, "mh", draws=5, warmup=5, checkpoint=tmp_path)
        assert trace["posterior"].identical(fmu.sample(problem, "mh", draws=5, warmup=5)["posterior"])

    @pytest.mark.parametrize("numbers", [{"draws": 0}, {"draws": 2.5}, {"seconds": -1.0}, {"seconds": np.nan}])
    def test_bad_numbers(self, tmp_path, numbers):
        with pytest.raises(ValueError, match=rf"^{next(iter(numbers))}: must .*\(got"):
            Checkpoint(tmp_path, **numbers)

    def test_states_of_an_earlier_version_are_refused(self, half):
        newest = files(half, "state")[-1]
        newest.write_bytes(newest.read_bytes().replace(b"fmu state 3", b"fmu state 2", 1))
        with pytest.raises(ValueError, match="state-000007 was written by an earlier version"):
            ran(half)


class TestDirectory:
    def test_below_a_file(self, tmp_path):
        (tmp_path / "file").write_text("")
        with pytest.raises(OSError, match="file"):
            ran(tmp_path / "file" / "run")
        with pytest.raises(OSError, match="file"):
            ran(tmp_path / "file")

    def test_one_run_at_a_time(self, half):
        def again(*call):
            with pytest.raises(ValueError, match=rf"checkpoint: another run is running in {half}$"):
                ran(half)
            raise Killed

        with pytest.raises(Killed):
            ran(half, progress=again)
        ran(half)

    def test_made_where_there_is_none(self, tmp_path):
        ran(tmp_path / "a" / "b", 5)
        assert (tmp_path / "a" / "b" / "run").is_file()


class TestFailures:
    def test_they_survive(self, tmp_path):
        more = {"init": [Watched().mean] * 2}
        whole, again = tmp_path / "whole", tmp_path / "again"
        result = ran(whole, density=Watched(), **more)
        with pytest.raises(Killed):
            ran(again, density=Watched(), progress=killed_at("draws", 25), **more)
        early = (again / LEDGER).read_text()
        ran(again, density=Watched(), **more)
        ledger = (again / LEDGER).read_text()
        assert ledger == (whole / LEDGER).read_text()
        assert ledger.startswith(early)
        rows = ledger.splitlines()
        assert rows[0] == "task,phase,step,x0,x1,x2,x3,x4,reason"
        failed = sum(int(phase.stats["n_nonfinite"].sum()) for phase in (result.warmup, result.posterior))
        assert len(rows) - 1 == failed > len(early.splitlines()) > 1
        assert all(row.endswith(r",too far\0 \udcff") for row in rows[1:])
        assert all(float(row.split(",")[3]) > Watched().mean[0] + 0.8 for row in rows[1:])

    def test_those_that_no_statistic_counts_too(self, tmp_path):
        """Tempering draws from the prior, where a solve may fail as well."""

        class Hollow(LinearGaussian):
            def __init__(self):
                super().__init__()
                self.failed = []

            take_failures = Watched.take_failures

            def likelihood(self, theta):
                value, slope = super().likelihood(theta)
                bad = theta[:, 0] > 3.0
                self.failed += [fmu.posterior.failures.Failure(point.copy(), "far") for point in theta[bad]]
                return np.where(bad, -np.inf, value), slope

        ran(tmp_path, sampler="tempering", density=Hollow())
        before = (tmp_path / LEDGER).read_text()
        assert before.count(",far\n") > 3
        (tmp_path / LEDGER).unlink()
        ran(tmp_path, sampler="tempering", density=Hollow())
        assert (tmp_path / LEDGER).read_text() == before


@pytest.mark.skipif(sys.platform != "linux", reason="open files are listed in /proc")
def test_nothing_stays_open(tmp_path):
    ran(tmp_path, 10)
    before = len(os.listdir("/proc/self/fd"))
    for draws in (20, 30):
        ran(tmp_path, draws)
    assert len(os.listdir("/proc/self/fd")) == before


def test_another_kind_of_cpu_is_told(tmp_path, whole, monkeypatch):
    with pytest.raises(Killed):
        ran(tmp_path, progress=killed_at("draws", 35))
    monkeypatch.setattr("fmu.runs.store.arithmetic", lambda: "abacus")
    with pytest.warns(OtherArithmeticWarning, match=r"another kind of CPU or BLAS \(.*; here abacus\)"):
        assert_same(ran(tmp_path), whole)
