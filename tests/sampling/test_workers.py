"""The same draws, bit for bit, whoever computes them and whoever dies over it."""

import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest

import fmu
from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.parameters import Parameter
from fmu.posterior.priors.base import Normal
from fmu.posterior.problem import UpdatingProblem
from tests.linear import LinearModel

SETTINGS = {"draws": 30, "warmup": 40, "chains": 4, "groups": 4, "seed": 3}


class LinearProblem(UpdatingProblem):
    """Two parameters, three frequencies; in another process it may die, once, on the way."""

    def __init__(self, flag: Path | None = None, pause_s: float = 0.0) -> None:
        parameters = [Parameter("a", start=0.5, prior=Normal(1.0)), Parameter("b", start=0.0, prior=Normal(2.0))]
        super().__init__(LinearModel(), ModalData([101.0, 99.5, 102.0]), parameters, name="linear")
        self.flag, self.pause_s, self.home, self.asked = flag, pause_s, os.getpid(), 0

    def log_prob_and_grad(self, theta):
        self.asked += 1
        time.sleep(self.pause_s)
        if os.getpid() != self.home and self.flag is not None and self.asked > 150:
            try:
                self.flag.touch(exist_ok=False)
            except FileExistsError:
                pass
            else:
                os.kill(os.getpid(), signal.SIGKILL)
        return super().log_prob_and_grad(theta)


def assert_same(one, other):
    for group in ("posterior", "warmup_posterior", "sample_stats", "warmup_sample_stats", "posterior_predictive"):
        assert one[group].identical(other[group])
    assert one.attrs["configuration_hash"] == other.attrs["configuration_hash"]
    assert one.attrs["learnt"] == other.attrs["learnt"]


@pytest.fixture(scope="module")
def alone():
    return fmu.sample(LinearProblem(), "hmc", **SETTINGS)


@pytest.fixture(scope="module")
def processes():
    with fmu.engine(2) as engine:
        yield engine


def test_processes(alone, processes):
    assert_same(fmu.sample(LinearProblem(), "hmc", workers=processes, **SETTINGS), alone)


def test_a_process_killed_midway(alone, processes, tmp_path):
    trace = fmu.sample(LinearProblem(tmp_path / "died"), "hmc", workers=processes, **SETTINGS)
    assert (tmp_path / "died").exists()
    assert_same(trace, alone)


@pytest.mark.validate
def test_ensembles_are_groups(processes):
    settings = {"draws": 30, "warmup": 10, "chains": 3, "seed": 2}
    sampler = fmu.Ensemble(walkers=8)
    here = fmu.sample(LinearProblem(), sampler, **settings)
    assert_same(fmu.sample(LinearProblem(), sampler, workers=processes, **settings), here)


def test_another_number_of_groups_gives_other_draws_of_the_same_posterior(alone):
    other = fmu.sample(LinearProblem(), "hmc", **SETTINGS | {"groups": 2})
    assert not other["posterior"].identical(alone["posterior"])
    assert other.attrs["configuration_hash"] != alone.attrs["configuration_hash"]
    one, two = (np.asarray(trace["posterior"]["a"]) for trace in (alone, other))
    assert abs(one.mean() - two.mean()) < 0.5 * one.std()


def test_progress_comes_from_the_workers_group_by_group(processes):
    seen = []
    settings = SETTINGS | {"draws": 20, "warmup": 20, "groups": 2, "workers": processes}

    def watch(phase, done, total, info):
        seen.append((phase, done, total, info["group"]))

    fmu.sample(LinearProblem(pause_s=0.002), "hmc", progress=watch, **settings)
    assert {group for *_, group in seen} == {"1/2", "2/2"}
    assert ("warmup", 20, 20, "1/2") in seen
    assert ("draws", 20, 20, "2/2") in seen


def test_failures_of_workers_are_counted_against_the_limit(processes):
    """A model that fails in half of the plane, and chains that keep asking it there."""

    class Failing(LinearModel):
        def frequencies(self, theta):
            f = super().frequencies(theta)
            return np.where(theta[:, :1] > 0.4, np.nan, f)

    problem = LinearProblem()
    problem = UpdatingProblem.reduced(Failing(), problem.data, problem.parameters)
    walk = fmu.MetropolisHastings(fmu.RandomWalk(1.0))
    start = np.zeros((4, 2))
    with pytest.raises(RuntimeError, match=r"solves failed .* more than the limit of 10 %; most often: "):
        fmu.sample(
            problem, walk, draws=500, init=start, warmup=0, groups=2, workers=processes, max_failure_rate=0.1
        )
