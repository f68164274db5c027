"""Functions called in workers: the same answers, gradients and failures as here; a crash is one more reason."""

import os
import pickle
import signal
import sys

import numpy as np
from numpy.testing import assert_array_equal

import fmu
from fmu.engines import remote
from fmu.fem.programs import solves
from tests.shear_building import storey

K = np.array([storey(0, 2), storey(1, 2)])
HERE = os.getpid()


def frequencies(theta):
    """Fail where the lower storey is soft, in the model or in its answer."""
    if theta[0] < 160.0:
        raise RuntimeError(f"does not converge at {theta[0]:.1f}")
    if theta[0] < 200.0:
        return [np.nan, 1.0]
    return np.sqrt(np.linalg.eigvalsh(np.tensordot(theta, K, 1))) / (2 * np.pi)


def where(theta):
    return [float(os.getpid())]


def deadly(theta):
    if theta[0] == 0.0:
        os.kill(os.getpid(), signal.SIGSEGV)
    return theta


def problem(model):
    parameters = [fmu.Parameter(name, 300.0, 100.0, 600.0) for name in ("k1", "k2")]
    return fmu.UpdatingProblem.reduced(model, fmu.ModalData([1.7, 4.5]), parameters, beta=2.0)


def test_answers_gradients_and_failures_are_those_of_this_process(engine):
    here, there = (fmu.BlackBoxModel(frequencies, 2) for _ in range(2))
    theta = np.random.default_rng(1).uniform(100.0, 600.0, (30, 2))
    value, gradient = problem(here).log_prob_and_grad(theta)
    spread = problem(there)
    with there.spread_over(engine) as model:
        assert model is there
        assert_array_equal(spread.log_prob_and_grad(theta)[0], value)
        assert_array_equal(spread.log_prob_and_grad(theta)[1], gradient)
    assert np.isfinite(gradient).any()
    assert {reason.split(" ")[0] for _, reason in there.reasons} == {"RuntimeError:", "frequencies:"}
    assert [(tuple(t), reason) for t, reason in there.reasons[: len(here.reasons)]] == [
        (tuple(t), reason) for t, reason in here.reasons
    ]


def test_calls_are_made_in_workers_while_the_block_lasts(engine):
    model = fmu.BlackBoxModel(where, 1)
    theta = np.linspace(0.0, 1.0, 20)[:, None]
    with model.spread_over(engine):
        pids = {float(answer.frequencies[0]) for answer in model.answers(theta)}
        assert {answer.frequencies[0] for answer in model.answers(theta[:1] + 2.0)} == {HERE}
        assert {answer.frequencies[0] for answer in model.answers(theta)} == pids  # remembered
    assert HERE not in pids
    assert {answer.frequencies[0] for answer in model.answers(theta + 3.0)} == {HERE}


def test_a_batched_function_has_all_theta_in_one_call(engine):
    model = fmu.BlackBoxModel(lambda theta: np.full((len(theta), 1), len(theta)), 1, batched=True)
    with model.spread_over(engine):
        assert [answer.frequencies.tolist() for answer in model.answers(np.arange(3.0)[:, None])] == [[3.0]] * 3


def test_a_theta_that_kills_its_process_has_failed(engine, monkeypatch):
    for module in (remote, solves):
        monkeypatch.setattr(module, "MAX_DEATHS", 1)
    model = fmu.BlackBoxModel(deadly, 1)
    with model.spread_over(engine):
        answers = model.answers(np.array([[1.0], [0.0], [2.0], [3.0]]))
    assert [None if answer is None else answer.frequencies.tolist() for answer in answers] == [[1], None, [2], [3]]
    [(theta, reason)] = model.reasons
    assert_array_equal(theta, [0.0])
    assert reason == "the process that called it died 1 times (SIGSEGV)"


def test_neither_the_engine_nor_what_failed_travels(engine):
    model = fmu.BlackBoxModel(frequencies, 2)
    with model.spread_over(engine):
        model.answers(np.array([[100.0, 100.0], [110.0, 100.0]]))
        copy = pickle.loads(pickle.dumps(model))
    assert len(model.reasons) == 2
    assert copy.reasons == []
    assert len(copy.answers(np.array([[300.0, 100.0], [300.0, 200.0]]))) == 2


def test_a_program_has_one_thread_in_a_worker_and_those_of_the_user_without(tmp_path, monkeypatch, engine):
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    code = "import os; print('f', os.environ.get('OMP_NUM_THREADS', 9))"
    (tmp_path / "deck.in").write_text("{k1} {k2}")
    model = fmu.CommandModel(
        ["k1", "k2"], "deck.in", [sys.executable, "-c", code],
        frequencies=fmu.FoundFrequencies("output.txt", r"f (\S+)"), folder=tmp_path,
    )  # fmt: skip
    (here,) = model.answers(np.array([[1.0, 1.0]]))
    assert here.frequencies == 9.0
    with model.spread_over(engine):
        there = model.answers(np.array([[1.0, 2.0], [1.0, 3.0]]))
    assert [answer.frequencies.tolist() for answer in there] == [[1.0], [1.0]]
